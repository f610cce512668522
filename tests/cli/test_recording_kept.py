"""An end that restarts with the same flags keeps its earlier recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from cloudrc.cli.processes import open_recorder
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from tests.record.conftest import MS, counted, world_records


def started(path: Path | None, size_max: float | None = None) -> Recorder:
    options = argparse.Namespace(record=path, record_max=size_max)
    return open_recorder(options, "world", b"id")


def record(recorder: Recorder, seconds: int = 1) -> Recorder:
    for start in range(0, 1000 * seconds, 500):
        recorder.put(world_records(50, start * MS))
        while recorder.drain():
            pass
        recorder.flush(sync=False)
    return recorder


def test_a_restart_keeps_the_recording_of_a_crash(tmp_path: Path) -> None:
    path, before = tmp_path / "world.mcap", tmp_path / "world.before.mcap"
    killed = record(started(path))
    left = path.read_bytes()
    again = started(path)
    again.put(counted(3))
    again.close()
    assert before.read_bytes() == left
    assert len(Recording.read(before)["/odometry"]) == 100
    assert len(Recording.read(path)["/count"]) == 3
    killed.close()
    left = path.read_bytes()
    started(path).close()
    assert before.read_bytes() == left, "only the previous one is kept"


def test_both_recordings_together_stay_within_the_limit(tmp_path: Path) -> None:
    path, limit = tmp_path / "world.mcap", 200_000
    for _ in range(3):
        recorder = record(started(path, limit), 30)
        recorder.close()
        assert "the file has reached its size limit" in recorder.error
        sizes = [each.stat().st_size for each in tmp_path.iterdir()]
        assert sum(sizes) < limit + 2 * 16_000, "each recording ends with its open chunk"
    assert len(sizes) == 2


def test_an_empty_recording_is_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "world.mcap"
    path.touch()
    started(path).close()
    started(None).close()
    assert [each.name for each in tmp_path.iterdir()] == ["world.mcap"]
