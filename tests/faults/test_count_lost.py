"""A recorder that counts one lost record too many, or too few, is noticed."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.faults.remains import Tape
from cloudrc.faults.schedule import Event
from cloudrc.record.recorder import Recorder
from cloudrc.record.writer import McapWriter
from tests.record.conftest import MS, world_records


def judged(kind: str, value: float) -> str:
    """What is said of 20 s that were recorded on a bad disk."""
    tape = Tape(Event(kind, 0.0, 20.0, value))
    for start in range(0, 20_000, 100):
        tape.hear(world_records(10, start * MS), (start + 100) * MS)
    return tape.wrong()


@pytest.mark.parametrize(
    ("kind", "value"),
    [*(("recorder_full", float(room)) for room in (0, 9_000, 60_000)), ("recorder_slow", 0.4)],
)
@pytest.mark.parametrize("by", [-1, 0, 1])
def test_a_count_that_is_wrong_by_one_is_noticed(
    kind: str, value: float, by: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    count: Any = Recorder.dropped.fget  # type: ignore[attr-defined]
    lie = 0 if kind == "recorder_slow" else by  # that one has lost nothing
    monkeypatch.setattr(Recorder, "dropped", property(lambda self: count(self) + lie))
    said = judged(kind, value)
    assert said == (f"the count of lost records is wrong by {lie}" if lie else "")


def test_what_a_full_disk_takes_with_it_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    abandon = McapWriter.abandon
    monkeypatch.setattr(McapWriter, "abandon", lambda self, reason: abandon(self, reason) * 0)
    assert "the count of lost records is wrong by -" in judged("recorder_full", 60_000.0)
