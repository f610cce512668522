"""The working folder of each command, calls of commands, and text that would control a terminal."""

import pytest

KEYS = "mission.steps.count=1", "mission.steps.period_s=1.0", "criteria.settle_m=null"
SHORT = [f"--set={key}" for key in KEYS]
"""Overrides of `steps` for one second of flight."""
FLY = ["run", "steps", "--mode", "virtual", *SHORT]
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


@pytest.fixture
def replace_flights(monkeypatch):
    """Return a function that replaces flights by `fly(experiment)`, in this process."""
    monkeypatch.setattr("cloudrc.trials.workers.usable_cores", lambda: 1)
    return lambda fly: monkeypatch.setattr("cloudrc.runs.flight.fly_point", fly)
