"""A step of the wall clock is detected, a slight drift is not."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from cloudrc.drivers.exporter import Exporter
from cloudrc.drivers.process import _Observers
from cloudrc.drivers.recording import RecordingThread, WallClock, told
from cloudrc.record.recorder import Recorder
from cloudrc.records import Fault
from tests.record.conftest import Shelf


class Wall:
    """A wall clock that is wrong by `offset` [s]."""

    offset = 0.0

    def step(self, by: float) -> None:
        self.offset += by


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    wall, true = Wall(), time.time
    monkeypatch.setattr(time, "time", lambda: true() + wall.offset)
    return wall


@pytest.mark.parametrize("by", [3600.0, -3600.0, 1.0, -1.0])
def test_each_step_is_noticed_once_with_its_size(wall: Wall, by: float) -> None:
    seen = WallClock()
    assert seen.step() == 0.0
    for _ in range(2):
        wall.step(by)
        assert [seen.step(), seen.step()] == [pytest.approx(by, abs=0.1), 0.0]


@pytest.mark.parametrize("by", [3600.0, -60.0])
def test_it_is_told_in_one_line(by: float) -> None:
    fault = told(by, 7)
    assert (fault.stamp_ns, fault.code) == (7, "wall_clock")
    said = re.match(r"wall clock stepped by ([+-]\S+) s: ", fault.text)
    assert said
    assert float(said[1]) == by
    assert "\n" not in fault.text


def test_the_recording_thread_detects_steps_without_scrapes(wall: Wall) -> None:
    thread = RecordingThread(Recorder(Path("x"), lambda path: Shelf()))
    thread.start()
    wall.step(-60.0)
    steps, until = list[float](), time.monotonic() + 10.0
    while not steps and time.monotonic() < until:
        time.sleep(0.01)
        steps = thread.take_steps()
    assert steps == [pytest.approx(-60.0, abs=0.1)]
    assert thread.take_steps() == []
    assert thread.stop(10.0)


def test_an_end_records_it_on_its_own_clock_and_counts_it() -> None:
    steps = [[60.0, -1.0], []]
    watch = _Observers("world", None, None, None, lambda: 5_000_000_000, lambda: steps.pop(0))
    began_ns = time.monotonic_ns() - 5_000_000_000
    records = watch.after([])
    assert [type(record) for record in records] == [Fault, Fault]
    assert 0 <= records[0].stamp_ns - began_ns < 1_000_000_000
    assert watch.after([]) == []
    exporter = Exporter("world")
    exporter.see([Fault(0, "late", "..."), *records])
    assert "cloudrc_clock_steps_total 2.0" in exporter.text()


def test_a_clock_that_drifts_has_not_been_set(monkeypatch: pytest.MonkeyPatch) -> None:
    boot = [0.0]
    monkeypatch.setattr(time, "clock_gettime", lambda clock: boot[-1])
    monkeypatch.setattr(time, "time", lambda: 1.7e9 + boot[-1] * 1.0005)
    seen = WallClock()
    for later in (1.0, 60.0, 3600.0, 86_400.0):
        boot.append(later)
        assert seen.step() == 0.0


@pytest.mark.parametrize("stopped_before", [True, False])
def test_nor_has_one_whose_looker_was_stopped_in_the_middle(
    stopped_before: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stop of a second between the reads of both clocks, by SIGSTOP or a CPU quota."""
    true = [0.0]
    stops = iter([False, True])

    def look() -> float:
        stop = next(stops, False)
        true[0] += stop and stopped_before
        shown = 1.7e9 + true[0]
        true[0] += stop and not stopped_before
        return shown

    monkeypatch.setattr(time, "clock_gettime", lambda clock: true[0])
    monkeypatch.setattr(time, "time", look)
    seen = WallClock()
    assert [seen.step(), seen.step()] == [0.0, 0.0]
