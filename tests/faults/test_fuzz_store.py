"""What a search has found is shrunk, printed and kept; what is kept can be flown again."""

from __future__ import annotations

from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.faults.fuzz import Breach, Finding
from cloudrc.faults.schedule import Event, Schedule, dump, load


def breaking(schedule: Schedule, keep: bool = False) -> Finding:
    bad = any(event.kind == "blackout" for event in schedule.events)
    breaches = (Breach(1.5, "collision", "body touched pipe_1"),) if bad else ()
    return Finding(schedule, breaches, "", 1.0, 2.0, 0, 1)


def test_a_failure_is_printed_and_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cloudrc.faults.fuzz.fly", breaking)
    document = tmp_path / "search.md"
    flags = ["--seeds", "12", "--store", str(tmp_path), "--document", str(document)]
    assert main(["faults", "fuzz", *flags]) == 1
    printed = capsys.readouterr().out
    assert "| fence breaches | 0 | 12 | p < 0.25 |" in document.read_text()
    assert "| false alarms | - | 0 | not judged |" in document.read_text()
    assert "collision: body touched pipe_1" in printed
    stored = sorted(tmp_path.glob("collision-*.yaml"))
    assert stored
    assert [event.kind for event in load(stored[0]).events] == ["blackout"]
    assert "p <" in printed, "invariants that held have their bound"


def test_what_was_found_once_is_a_test_and_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cloudrc.faults.fuzz.fly", breaking)
    flags = ["--seeds", "12", "--store", str(tmp_path)]
    assert main(["faults", "fuzz", *flags]) == 1
    stored = sorted(tmp_path.glob("collision-*.yaml"))
    kept = stored[0].read_text()
    stored[0].write_text("found in another year")
    for _ in range(2):  # the same finding once more is the same file
        assert main(["faults", "fuzz", *flags]) == 1
        assert stored[0].read_text() == "found in another year"
        assert stored[0].with_stem(f"{stored[0].stem}-2").read_text() == kept
        assert len(list(tmp_path.glob("collision-*.yaml"))) == len(stored) + 1


def test_a_stored_schedule_is_flown_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "schedule.yaml"
    path.write_text(dump(Schedule(1, events=(Event("blackout", 2.0, 0.5),), duration=6.0)))
    assert main(["faults", "replay", str(path)]) == 0
    assert "passed" in capsys.readouterr().out
