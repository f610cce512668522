"""Run `cloudrc mission drive`: drive the robot with the keys of a terminal.

A terminal sends a key again and again while it is held, but never tells that it is released. A key
therefore counts as released when it has not come again for a short time. A thread repeats the
request to drive and reads the state, so that no key waits for a slow API.
"""

from __future__ import annotations

import curses
import select
import sys
import threading
import time
from contextlib import suppress
from math import dist
from textwrap import wrap
from typing import Any

from cloudrc.cli.client import Api
from cloudrc.cli.output import escape, print_line
from cloudrc.errors import BadInputError, CloudrcError

SPEED = 0.5
"""Speed along each axis while its key is held [m/s]."""
FIRST_HOLD, NEXT_HOLD = 0.5, 0.3
"""Time for which a key counts as held after its first press, and after each repetition [s]. Most
terminals repeat a key first after 0.2 to 0.5 s, and then at least 10 times a second."""
PERIOD = 0.1
"""Time between two requests [s]."""
KEYS = {
    **{curses.KEY_UP: (0, SPEED), curses.KEY_DOWN: (0, -SPEED)},
    **{curses.KEY_LEFT: (1, SPEED), curses.KEY_RIGHT: (1, -SPEED)},
    **{ord("w"): (2, SPEED), ord("s"): (2, -SPEED)},
}
"""Key -> its axis and its velocity along this axis [m/s]."""
HELP = (
    "arrows: x and y, w and s: up and down, space: stop moving, h: hold, q: quit",
    "X (capital): emergency stop, the robot falls",
)


class Pilot:
    """Turns keys into requests, and shows the state of the robot."""

    def __init__(self, api: Api) -> None:
        self._api, self._state, self._refused = api, dict[str, Any](), ""
        self._held: dict[int, tuple[float, float]] = {}  # axis -> velocity [m/s], end of the hold
        self._over, self._changed = threading.Event(), threading.Event()
        self._place: tuple[float, list[float]] | None = None  # newest time [s] and position [m]
        self._speed = 0.0  # [m/s]

    def run(self, screen: curses.window) -> None:
        """Handle keys until the user quits; then let go."""
        curses.curs_set(0)
        screen.timeout(50)
        thread = threading.Thread(target=self._repeat)
        thread.start()
        try:
            while (key := screen.getch()) != ord("q") and not _is_gone():
                self._press(key)
                self._draw(screen)
        finally:
            self._held = {}
            self._over.set()
            self._changed.set()
            thread.join()

    @property
    def velocity(self) -> list[float]:
        """The velocity that the held keys ask for [m/s]."""
        now, held = time.monotonic(), self._held
        return [held[n][0] if n in held and now < held[n][1] else 0.0 for n in range(3)]

    def _press(self, key: int) -> None:
        before = self.velocity
        if key in KEYS:
            axis, speed = KEYS[key]
            lasts = NEXT_HOLD if before[axis] == speed else FIRST_HOLD
            self._held = {**self._held, axis: (speed, time.monotonic() + lasts)}
        elif key in (ord(" "), ord("h"), ord("X")):
            self._held = {}
        if self.velocity != before:
            self._changed.set()
        if key in (ord("h"), ord("X")):
            self._ask("/v1/hold" if key == ord("h") else "/v1/estop")

    def _ask(self, path: str, body: dict[str, Any] | None = None) -> None:
        try:
            self._api.post(path, body)
        except CloudrcError as error:
            self._refused = escape(str(error))

    def _repeat(self) -> None:
        """Repeat the request to drive while a key is held, then ask for rest; read the state."""
        moving, read_at = False, 0.0
        while not self._over.is_set() or moving:
            velocity = self.velocity
            if any(velocity) or moving:
                moving = any(velocity)
                self._ask("/v1/drive", {"velocity_mps": velocity})
            if time.monotonic() >= read_at:
                read_at = time.monotonic() + 2 * PERIOD
                self._read()
            self._changed.wait(PERIOD)
            self._changed.clear()

    def _read(self) -> None:
        try:
            self._state = self._api.get("/v1/state")
        except CloudrcError as error:
            self._state, self._refused = {}, escape(str(error))
        seen = self._state.get("seen")
        if seen and None not in seen["position_m"]:
            before, self._place = self._place, (time.monotonic(), seen["position_m"])
            if before is not None:
                self._speed = dist(before[1], self._place[1]) / (self._place[0] - before[0])

    def _draw(self, screen: curses.window) -> None:
        screen.erase()
        height, width = screen.getmaxyx()
        indent = " " * 12
        shown = [wrap(line, width - 1, subsequent_indent=indent) or [""] for line in self._lines()]
        for row, line in enumerate([part for parts in shown for part in parts][:height]):
            with suppress(curses.error):  # the window was made smaller
                screen.addnstr(row, 0, line, width - 1, curses.A_BOLD if row == 0 else 0)
        screen.refresh()

    def _lines(self) -> list[str]:
        """Return the lines to show."""
        mission, seen = self._state.get("mission"), self._state.get("seen")
        lines = [f"cloudrc mission drive   {self._api.place or self._api.url}", ""]
        if seen is None:
            lines.append("no telemetry from the robot")
        else:
            place = ", ".join("?" if at is None else f"{at:6.2f}" for at in seen["position_m"])
            asked = ", ".join(f"{speed:.1f}" for speed in self.velocity)
            rtt = "unknown" if seen["rtt_s"] is None else f"{seen['rtt_s'] * 1e3:.0f} ms"
            lines += [
                f"position    ({place}) m, seen {seen['age_s']:.1f} s ago",
                f"speed       {self._speed:.2f} m/s, asked ({asked}) m/s",
                f"guard       {seen['guard']}: {seen['cause']}",
                f"round trip  {rtt}",
                f"next        {seen['next_step']}",
            ]
        what = f"{mission['id']} ({mission['name']}) {mission['state']}" if mission else "none"
        lines += [f"mission     {what}", f"refused     {self._refused or 'nothing'}", "", *HELP]
        return [escape(line) for line in lines]


def _is_gone() -> bool:
    """Return whether the terminal was closed; without a session of its own no signal tells it."""
    terminal = select.poll()
    terminal.register(sys.stdin)
    return any(events & select.POLLHUP for _, events in terminal.poll(0))


def drive(api: Api) -> int:
    """Let the user drive until q; raise BadInputError without a terminal."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise BadInputError("mission drive needs a terminal; from a program use POST /v1/drive")
    try:
        curses.wrapper(Pilot(api).run)
    except curses.error as error:
        raise BadInputError(f"mission drive: {error}; set TERM, for example to xterm") from None
    print_line("let go; what the robot does next: cloudrc mission status")
    return 0
