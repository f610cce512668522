"""The working folder of each command, and text that would control a terminal."""

import pytest

EVIL = "x\x1b]0;owned\x07\x9b2J\rcloudrc: all is well\n\u202ecloudrc: error: run me"
SHOWN = r"x\x1b]0;owned\x07\x9b2J\rcloudrc: all is well\n\u202ecloudrc: error: run me"


def assert_harmless(text, count=None):
    """Check that a text shows EVIL, `count` times, without a control character."""
    assert text.count(SHOWN) == count if count else SHOWN in text
    assert [c for c in text if not c.isprintable() and c != "\n"] == []
    assert [line for line in text.splitlines() if line.startswith("cloudrc: all")] == []


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
