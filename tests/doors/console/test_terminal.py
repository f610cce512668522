# SPDX-License-Identifier: Apache-2.0

"""Keys of `cloudrc mission drive`."""

import curses
from types import SimpleNamespace

import pytest

from cloudrc.doors.console.terminal import obey


@pytest.mark.parametrize(
    ("key", "done"),
    [
        *(("w", "hold_key"), ("W", "hold_key"), (curses.KEY_UP, "hold_key"), ("H", "act hold")),
        *(("X", "stop"), ("x", "the key 'x' has no meaning"), (curses.KEY_RESIZE, "")),
    ],
)
def test_a_key_is_obeyed_or_named(key, done):
    called = []
    steering = SimpleNamespace(
        velocity=lambda now: (0.0, 0.0, 0.0),
        hold_key=lambda *given: called.append("hold_key"),
        release_keys=lambda: None,
        act=lambda verb: called.append(f"act {verb}"),
        stop=lambda: called.append("stop"),
    )
    note = obey(key, steering)
    assert "".join([*called, note]) == done
