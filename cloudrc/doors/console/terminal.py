# SPDX-License-Identifier: Apache-2.0

"""Drive the robot with the keys of a terminal.

A terminal repeats a key while it is held, but never tells that the key is released. A key therefore
counts as released if the terminal does not repeat it in time.
"""

from __future__ import annotations

import curses
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from textwrap import wrap

from cloudrc.base.text import escape
from cloudrc.doors.console.steering import Steering
from cloudrc.teleop.client import Api, describe_mission
from cloudrc.teleop.telling import describe_robot
from cloudrc.wire.messages import Vector

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


def _handle_keys(screen: curses.window, steering: Steering, api: Api) -> None:
    curses.curs_set(0)
    note = ""
    while True:
        arrived = [*_sent(screen)]
        if len(arrived) > PASTED:
            note, arrived = "pasted text has no effect", []
        for key in arrived:
            if key in ("q", "Q"):
                return
            note = obey(key, steering)
        _draw(screen, _lines(steering, api, note))


def _sent(screen: curses.window) -> Iterator[str | int]:
    """Yield what the terminal has sent, after at most 50 ms."""
    screen.timeout(50)
    while (key := screen.getch()) != -1:
        yield chr(key) if key < 256 else key  # larger ones are those of curses, such as KEY_UP
        screen.timeout(0)


def obey(key: str | int, steering: Steering) -> str:
    """Do what a key means; return a note if it means nothing. Of the letters, case counts for X."""
    if isinstance(key, str) and key != "X":
        key = key.lower()
    if key in KEYS:
        axis, velocity = KEYS[key]
        before = steering.velocity(time.monotonic())
        is_repeated = any(a == b != 0.0 for a, b in zip(before, velocity, strict=True))
        steering.hold_key(axis, velocity, NEXT_HOLD if is_repeated else FIRST_HOLD)
        return ""
    if key not in ("X", "h", " "):
        return f"the key '{key}' has no meaning" if isinstance(key, str) else ""
    steering.release_keys()
    if key == "X":
        steering.stop()
    elif key == "h":
        steering.act("hold")
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
    state = steering.state
    asked = ", ".join(f"{speed:.1f}" for speed in steering.velocity(time.monotonic()))
    mission = state.get("mission")
    lines = [
        f"asked for ({asked}) m/s",
        note,
        steering.answer.words,
        *describe_robot(state.get("seen"), state.get("cloud_age_s")),
        describe_mission(mission) if mission else "no mission is under way",
        "",
        *HELP,
        f"cloudrc mission drive {api.place or api.url}",
    ]
    return [escape(line) for line in lines]
