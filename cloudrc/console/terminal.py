"""Drive the robot with the keys of a terminal.

A terminal repeats a key while it is held, but never tells that the key is released. A key therefore
counts as released if the terminal does not repeat it in time.
"""

from __future__ import annotations

import curses
import select
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from textwrap import wrap

from cloudrc.console.steering import Steering
from cloudrc.messages import Vector
from cloudrc.teleop.client import Api, describe_mission
from cloudrc.text import describe_point, describe_sensors, escape

SPEED = 0.5
"""Speed along each axis while its key is held [m/s]."""
FIRST_HOLD, NEXT_HOLD = 0.5, 0.3
"""Time for which a key counts as held after its first press, and after each repetition [s]. Most
terminals repeat a key first after 0.2 to 0.5 s, and then at least 10 times a second."""
KEYS: dict[str | int, tuple[str, Vector]] = {
    curses.KEY_UP: ("x", (SPEED, 0.0, 0.0)),
    curses.KEY_DOWN: ("x", (-SPEED, 0.0, 0.0)),
    curses.KEY_LEFT: ("y", (0.0, SPEED, 0.0)),
    curses.KEY_RIGHT: ("y", (0.0, -SPEED, 0.0)),
    "w": ("z", (0.0, 0.0, SPEED)),
    "s": ("z", (0.0, 0.0, -SPEED)),
}
"""Key -> its axis and its velocity [m/s]."""
PLACES = {
    **{"ц": "w", "ы": "s", "і": "s", "р": "h", "й": "q", "Ч": "X"},  # noqa: RUF001
    **{"ς": "w", "σ": "s", "η": "h", "Χ": "X"},  # noqa: RUF001
}
"""Letter of a Cyrillic or Greek keyboard -> Latin letter in the same place."""
PASTED = 8
"""Largest number of keys that arrive at once from a keyboard; more of them are pasted text."""
HELP = (
    "arrows: x and y, w and s: up and down, space: stop moving, h: hold, q: quit",
    "X (capital): emergency stop, a robot in the air falls",
)


def drive(api: Api) -> None:
    """Let the user steer the robot by the keys of this terminal, until the key q."""
    steering = Steering(api)
    steering.start()
    try:
        curses.wrapper(_handle_keys, steering, api)
    finally:
        steering.end_drive()


def meant_key(key: str | int) -> str | int:
    """Return the key on a Latin keyboard, of letters the small one; only X differs from x."""
    if isinstance(key, int):
        return key
    latin = PLACES.get(key) or PLACES.get(key.lower()) or key
    return latin if latin == "X" else latin.lower()


def _handle_keys(screen: curses.window, steering: Steering, api: Api) -> None:
    curses.curs_set(0)
    note = ""
    while not _is_gone():
        arrived = [*_sent(screen)]
        if len(arrived) > PASTED:
            note, arrived = "pasted text has no effect", []
        for sent in arrived:
            key = meant_key(sent)
            if key == "q":
                return
            note = _obey(key, sent, steering)
        _draw(screen, _lines(steering, api, note))


def _sent(screen: curses.window) -> Iterator[str | int]:
    """Yield what the terminal has sent, after at most 50 ms."""
    screen.timeout(50)
    with suppress(curses.error):  # nothing more was sent
        while True:
            yield screen.get_wch()
            screen.timeout(0)


def _obey(key: str | int, sent: str | int, steering: Steering) -> str:
    """Do what a key means; return a note about the key, "" if it needs none."""
    if key in KEYS:
        axis, velocity = KEYS[key]
        before = steering.velocity(time.monotonic())
        is_repeated = any(a == b != 0.0 for a, b in zip(before, velocity, strict=True))
        steering.hold_key(axis, velocity, NEXT_HOLD if is_repeated else FIRST_HOLD)
    elif key == "X":
        steering.release_keys()
        steering.stop()
        return ""
    elif key == "h":
        steering.release_keys()
        steering.ask("holding", "/v1/hold")
    elif key == " ":
        steering.release_keys()
    elif key == curses.KEY_RESIZE:  # the window has another size; nobody pressed a key
        return ""
    else:
        name = curses.keyname(sent).decode() if isinstance(sent, int) else sent
        also = "; X is the emergency stop (with Caps Lock: x without Shift)" * (key == "x")
        return f"the key {name!r} has no meaning{also}"
    if isinstance(sent, str) and sent.isupper():
        return "Caps Lock is on: x without Shift is now the emergency stop"
    return ""


def _draw(screen: curses.window, texts: Sequence[str]) -> None:
    screen.erase()
    height, width = screen.getmaxyx()
    lines = [part for text in texts for part in wrap(text, width - 1) or [""]]
    for row, line in enumerate(lines[:height]):
        with suppress(curses.error):  # the window was made smaller
            screen.addnstr(row, 0, line, width - 1, curses.A_BOLD if row == 0 else 0)
    screen.refresh()


def _lines(steering: Steering, api: Api, note: str) -> list[str]:
    """Return the text of the screen, important lines first: a small window cuts off the last."""
    mission, seen = steering.state.get("mission"), steering.state.get("seen")
    text, is_refusal, _ = steering.answer
    asked = ", ".join(f"{speed:.1f}" for speed in steering.velocity(time.monotonic()))
    lines = ["no telemetry from the robot"]
    if seen is not None:
        rtt = "unknown" if seen["rtt_s"] is None else f"{seen['rtt_s'] * 1e3:.0f} ms"
        lines = [
            f"{seen['guard']} at {describe_point(seen['position_m'])} m, asked ({asked}) m/s",
            f"next: {seen['next_step']}",
            f"guard: {seen['cause']}, seen {seen['age_s']:.1f} s ago, round trip {rtt}",
        ]
        if shown := describe_sensors(seen["sensors"]):
            lines.append(f"sensors: {shown}")
    lines.insert(1, f"not done: {text}" if is_refusal else text)
    lines[1:1] = [note] if note else []
    lines.append(describe_mission(mission) if mission else "no mission is under way")
    lines += ["", *HELP, f"cloudrc mission drive {api.place or api.url}"]
    return [escape(line) for line in lines]


def _is_gone() -> bool:
    """Return whether the terminal was closed; the process may get no signal in this case."""
    terminal = select.poll()
    terminal.register(sys.stdin)
    return any(events & select.POLLHUP for _, events in terminal.poll(0))
