"""Keys of `cloudrc mission drive`: capital letters, other keyboards."""

import curses
from types import SimpleNamespace

import pytest

from cloudrc.console.terminal import _obey, meant_key


@pytest.mark.parametrize(
    ("sent", "meant"),
    [
        *(("W", "w"), ("Q", "q"), ("H", "h"), ("X", "X"), ("x", "x"), ("ц", "w"), ("Й", "q")),
        *(("Ч", "X"), ("ч", "ч"), ("Σ", "s"), ("ß", "ß"), (curses.KEY_UP, curses.KEY_UP)),
    ],
)
def test_capital_letters_and_other_keyboards(sent, meant):
    assert meant_key(sent) == meant


@pytest.mark.parametrize(
    ("key", "sent", "done", "note"),
    [
        ("w", "w", "hold_key", ""),
        ("w", "W", "hold_key", "Caps Lock is on: x without Shift is now the emergency stop"),
        ("h", "h", "ask", ""),
        ("X", "X", "stop", ""),
        ("x", "x", "", "the key 'x' has no meaning; X is the emergency stop"),
        (curses.KEY_RESIZE, curses.KEY_RESIZE, "", ""),
    ],
)
def test_a_key_is_obeyed_or_named(key, sent, done, note, monkeypatch):
    monkeypatch.setattr(curses, "keyname", lambda key: b"KEY_F(1)")  # else it needs a terminal
    called = []
    steering = SimpleNamespace(
        velocity=lambda now: (0.0, 0.0, 0.0),
        hold_key=lambda *given: called.append("hold_key"),
        release_keys=lambda: None,
        ask=lambda *given: called.append("ask"),
        stop=lambda: called.append("stop"),
    )
    assert _obey(key, sent, steering).startswith(note)
    assert bool(note) == bool(_obey(key, sent, steering))
    assert set(called) == ({done} if done else set())
