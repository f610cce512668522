"""A wall clock that somebody sets is noticed; one that is merely a little fast is not."""

from __future__ import annotations

import re
import time
from argparse import Namespace
from collections.abc import Iterator

import pytest

from cloudrc.cli.ends import open_exporter
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


@pytest.mark.parametrize("by", [3600.0, -60.0])
def test_each_step_is_said_once_with_its_size(wall: Wall, by: float) -> None:
    lines: list[str] = []
    seen = WallClock(lines.append)
    wall.step(by)
    for _ in range(3):
        seen.steps()
    (line,) = lines
    said = re.match(r"wall clock stepped by ([+-]\S+) s: ", line)
    assert said
    assert float(said[1]) == pytest.approx(by, abs=1.0)


def test_a_process_that_is_scraped_says_it_in_its_log(
    wall: Wall, capsys: pytest.CaptureFixture[str]
) -> None:
    exporter = open_exporter(Namespace(metrics=("127.0.0.1", 0)), "cloud")
    assert exporter
    try:
        wall.step(60.0)
        assert "cloudrc_clock_steps_total 1.0" in exporter.text()
    finally:
        exporter.close()
    assert capsys.readouterr().err.startswith("cloudrc cloud: wall clock stepped by +")


def test_a_clock_that_drifts_has_not_been_set(monkeypatch: pytest.MonkeyPatch) -> None:
    boot = [0.0]
    monkeypatch.setattr(time, "clock_gettime", lambda clock: boot[-1])
    monkeypatch.setattr(time, "time", lambda: 1.7e9 + boot[-1] * 1.0005)
    seen = WallClock()
    for later in (1.0, 60.0, 3600.0, 86_400.0):
        boot.append(later)
        assert seen.steps() == 0
