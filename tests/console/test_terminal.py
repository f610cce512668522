"""Keys of `cloudrc mission drive`: pasted text, capital letters, other keyboards."""

import curses
from types import SimpleNamespace

import pytest

from cloudrc.console.terminal import (
    PASTE_BEGINS,
    PASTE_ENDS,
    PASTE_GAP,
    KeyReader,
    _obey,
    meant_key,
)


def keys(*sent, pause=0.0):
    """Return the keys that are meant if a terminal sends each of these texts, `pause` [s] apart."""
    reader, found = KeyReader(), []
    for number, text in enumerate(sent):
        for key in text if isinstance(text, str) else [text]:
            found.append(reader.take(key, 1.0 + number * pause))
    return [key for key in found if key is not None]


def test_pasted_text_is_no_key():
    pasted = f"w{PASTE_BEGINS}X marks the spot: shq{PASTE_ENDS}s"
    assert keys(pasted) == ["w", "s"]
    assert keys("w", PASTE_BEGINS, "Xq", curses.KEY_UP, PASTE_ENDS, "X") == ["w", "X"]
    reader = KeyReader()
    for key in pasted[:-1]:
        reader.take(key, 1.0)
    assert reader.note == "pasted text has no effect"


def test_a_key_counts_again_if_the_end_of_pasted_text_never_arrives():
    assert keys(f"{PASTE_BEGINS}some", "X", pause=0.9 * PASTE_GAP) == []
    assert keys(f"{PASTE_BEGINS}some", "X", pause=1.1 * PASTE_GAP) == ["X"]


SIDEWAYS = [curses.KEY_RIGHT, curses.KEY_LEFT]


@pytest.mark.parametrize(
    ("sent", "found"),
    [
        ("\x1b[I\x1b[1;5Aw", ["w"]),  # the window has the focus; Ctrl and an arrow
        ("\x1bOA\x1b[B\x1bOC\x1b[D", [curses.KEY_UP, curses.KEY_DOWN, *SIDEWAYS]),
        ("\x1b[200~\x1bOA\x1b[201~w", ["w"]),
        ("\x1bX", ["X"]),  # Alt and X
        ("\x1b\x1b[200~X\x1b[201~", []),
        ("\x1b[" + "1" * 40 + "X", ["1"] * 26 + ["X"]),
    ],
)
def test_a_sequence_is_no_key_and_hides_no_emergency_stop(sent, found):
    assert keys(sent)[-len(found) or 9 :] == found


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
        ("h", "H", "ask", "Caps Lock is on: x without Shift is now the emergency stop"),
        ("X", "X", "stop", ""),
        ("x", "x", "", "the key 'x' has no meaning; X is the emergency stop"),
        ("5", "5", "", "the key '5' has no meaning"),
        (curses.KEY_PPAGE, curses.KEY_PPAGE, "", "the key 'KEY_PPAGE' has no meaning"),
        (curses.KEY_F1, curses.KEY_F1, "", "the key 'KEY_F(1)' has no meaning"),
        (curses.KEY_RESIZE, curses.KEY_RESIZE, "", ""),
    ],
)
def test_a_key_is_obeyed_or_named(key, sent, done, note, monkeypatch):
    names = {curses.KEY_PPAGE: b"KEY_PPAGE", curses.KEY_F1: b"KEY_F(1)"}
    monkeypatch.setattr(curses, "keyname", names.__getitem__)  # the real one needs a terminal
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
