"""Writing a report: complete, again from its folder, without figures, from a torn recording."""

from __future__ import annotations

import builtins
import json
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from cloudrc.config.load import dump
from cloudrc.errors import BadInputError, MissingPrerequisiteError
from cloudrc.record.columns import Recording
from cloudrc.record.merge import write_mission
from cloudrc.records import Record
from cloudrc.report.document import Run
from cloudrc.report.write import read_run, write_report
from tests.metrics.conftest import at, flown, paper, touch

RUN = Run("virtual", "virtual", "f" * 64)


@cache
def records() -> tuple[list[Record], list[Record]]:
    log = flown()
    log.world.append(touch(8))
    world, cloud = (sorted(r, key=lambda record: record.stamp_ns) for r in (log.world, log.cloud))
    return world, cloud


def run_folder(folder: Path) -> Path:
    (folder / "config.yaml").write_text(dump(paper()[0]))
    write_mission(folder / "mission.mcap", *records())
    return folder


def test_a_run_folder_gives_the_same_report_again(tmp_path: Path) -> None:
    run_folder(tmp_path)
    first = write_report(tmp_path, *_in_memory(), RUN, page=False)
    again = write_report(tmp_path, *read_run(tmp_path), page=False)
    assert again == first
    assert json.loads((tmp_path / "report.json").read_text()) == first


def _in_memory() -> tuple[Recording, Any]:
    return Recording.from_records(*records()), paper()[0]


def test_a_torn_recording_still_gives_a_report(tmp_path: Path) -> None:
    mission = run_folder(tmp_path) / "mission.mcap"
    whole = mission.read_bytes()
    mission.write_bytes(whole[: len(whole) // 2])
    report = write_report(tmp_path, *read_run(tmp_path), page=False)
    assert report["verdict"] == "interrupted"
    assert report["complete"] is False
    assert "incomplete" in report["notes"][0]
    assert 0 < report["numbers"]["duration"]["value"] < 10
    assert "records_sha256" not in report


def test_an_interrupted_run_stays_interrupted(tmp_path: Path) -> None:
    run_folder(tmp_path)
    world, cloud = ([r for r in part if r.stamp_ns < at(4)] for part in records())
    write_mission(tmp_path / "mission.mcap", world, cloud)
    recording = Recording.from_records(world, cloud)
    stopped = Run("local", "relay", interrupted=True, notes=("the relay died",))
    assert write_report(tmp_path, recording, paper()[0], stopped, page=False)["verdict"] == (
        "interrupted"
    )
    assert read_run(tmp_path)[2] == stopped


@pytest.mark.parametrize("name", ["config.yaml", "mission.mcap"])
def test_a_folder_without_a_run_is_refused(tmp_path: Path, name: str) -> None:
    (run_folder(tmp_path) / name).unlink()
    with pytest.raises(BadInputError, match=f"has no {name}"):
        read_run(tmp_path)


def test_without_matplotlib_the_numbers_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any) -> Any:
        if name.partition(".")[0] == "matplotlib":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, *args)

    for name in [n for n in sys.modules if n.startswith("cloudrc.report.figures")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingPrerequisiteError, match=r"cloudrc\[report\]"):
        write_report(tmp_path, *_in_memory(), RUN)
    assert json.loads((tmp_path / "report.json").read_text())["schemaVersion"] == 1
    assert not (tmp_path / "report.html").exists()
