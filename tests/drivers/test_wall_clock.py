"""A wall clock that somebody sets is noticed; one that is merely a little fast is not."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from cloudrc.drivers.wall_clock import WallClock
from cloudrc.faults.walls import Wall, steppable_wall_clock


@pytest.fixture
def wall() -> Iterator[Wall]:
    with steppable_wall_clock() as clock:
        yield clock


@pytest.mark.parametrize("by", [3600.0, -3600.0, 1.0, -1.0])
def test_each_step_is_counted_once(wall: Wall, by: float) -> None:
    seen = WallClock()
    assert seen.steps() == 0
    wall.step(by)
    assert [seen.steps(), seen.steps()] == [1, 1]
    wall.step(by)
    assert seen.steps() == 2


def test_a_clock_that_drifts_has_not_been_set(monkeypatch: pytest.MonkeyPatch) -> None:
    boot = [0.0]
    monkeypatch.setattr(time, "clock_gettime", lambda clock: boot[-1])
    monkeypatch.setattr(time, "time", lambda: 1.7e9 + boot[-1] * 1.0005)
    seen = WallClock()
    for later in (1.0, 60.0, 3600.0, 86_400.0):
        boot.append(later)
        assert seen.steps() == 0
