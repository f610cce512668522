"""No wall clock affects the control path: the flight is identical for any wall clock."""

from __future__ import annotations

import ast
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import pytest

from cloudrc.config.load import load_experiment
from tests.flights.conftest import digest

PACKAGE = Path(__file__).parents[2] / "cloudrc"
HOUR = 3600.0
STEPS: dict[str, Callable[[int, float], float]] = {
    "an hour ahead": lambda call, now: now + HOUR,
    "an hour back": lambda call, now: now - HOUR,
    "stepping at every look": lambda call, now: now + HOUR * (-1) ** call,
    "drifting by 500 ppm": lambda call, now: now * 1.0005,
    "in 1970": lambda call, now: 0.0,
    "in 2106": lambda call, now: 4_294_967_296.0,
    "running backwards": lambda call, now: 2e9 - now,
}
WALL = ("time", "time_ns", "localtime", "gmtime", "ctime", "strftime")


def fly(monkeypatch: pytest.MonkeyPatch, clock: Callable[[int, float], float] | None) -> str:
    if clock is not None:
        calls, true = count(), time.time
        monkeypatch.setattr(time, "time", lambda: clock(next(calls), true()))
        monkeypatch.setattr(time, "time_ns", lambda: int(clock(next(calls), true()) * 1e9))
    experiment = load_experiment("hover", ["mission.waypoints.0.dwell_s=0.5", "link.profile=wifi"])
    return digest(experiment)


@pytest.fixture(scope="module")
def undisturbed() -> str:
    with pytest.MonkeyPatch.context() as patch:
        return fly(patch, None)


@pytest.mark.promise("wall-clock-does-not-matter")
@pytest.mark.parametrize("step", STEPS)
def test_the_flight_is_the_same_whatever_the_wall_clock_does(
    step: str, undisturbed: str, monkeypatch: pytest.MonkeyPatch, figure: Callable[..., None]
) -> None:
    differs = int(fly(monkeypatch, STEPS[step]) != undisturbed)
    figure("steps and drifts of the wall clock: flights that differ", differs, "==", 0)
    assert not differs


def wall_clocks(tree: ast.AST) -> list[str]:
    """Find calls that read a wall clock."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            text = ast.unparse(node)
            if text in {f"time.{name}" for name in WALL} | {"time.CLOCK_REALTIME"}:
                found.append(text)
            if node.attr in ("now", "utcnow", "today") and "date" in text:
                found.append(text)
        elif isinstance(node, ast.ImportFrom) and node.module == "time":
            found += [alias.name for alias in node.names if alias.name in WALL]
    return found


CONTROL_PATH = ("world/", "cloud/", "teleop/", "tunnel/", "link/", "endpoint", "drivers/realtime",
                "drivers/process", "drivers/keyfile", "drivers/virtual",
                "drivers/teleop")  # fmt: skip
ALLOWED = {
    # The kernel's stamps of datagrams are converted to an age of 0 to 50 ms at once.
    "link/relay.py": ["time.time_ns"],
    # The kernel stamps probes by this clock.
    "link/verify/probe.py": ["time.time_ns"] * 4,
    # Only people read the time in a line of the audit log.
    "teleop/auth.py": ["datetime.now"],
}


@pytest.mark.promise("wall-clock-does-not-matter")
def test_nothing_on_the_control_path_reads_a_wall_clock() -> None:
    found = {}
    for path in PACKAGE.rglob("*.py"):
        place = path.relative_to(PACKAGE).as_posix()
        if place.startswith(CONTROL_PATH):
            found[place] = wall_clocks(ast.parse(path.read_text()))
    assert len(found) > 60
    without = [start for start in CONTROL_PATH if not any(at.startswith(start) for at in found)]
    assert not without, "nothing has this name any more"
    assert {place: clocks for place, clocks in found.items() if clocks} == ALLOWED


@pytest.mark.parametrize(
    "code", ["time.time()", "from time import time_ns", "datetime.now()", "datetime.date.today()"]
)
def test_the_check_finds_a_wall_clock(code: str) -> None:
    assert wall_clocks(ast.parse(code))
