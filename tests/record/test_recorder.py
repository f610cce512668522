"""The recorder never blocks and survives all disk errors."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.record.recover import recover
from cloudrc.record.writer import McapWriter
from cloudrc.records import Counted, Record
from tests.record.conftest import MS, Shelf, assert_equal, counted, open_mcap, world_records, write


class Disk(io.BytesIO):
    """A file on a disk with space for `room` bytes."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


def on_disk(room: int, records: list[Record], path: Path, every: int) -> Recorder:
    """Record on a disk with little room, with a flush after some records; save what is kept."""
    disk = Disk(room)
    recorder = Recorder(path, lambda _: McapWriter(disk, clock="world"))
    for start in range(0, len(records), every):
        recorder.put(records[start : start + every])
        while recorder.drain():
            pass
        recorder.flush()
    recorder.close()
    path.write_bytes(disk.getvalue())
    return recorder


def test_the_oldest_are_dropped_and_counted() -> None:
    shelf, records = Shelf(), counted(25)
    recorder = Recorder(Path("x"), lambda path: shelf, capacity=10)
    for record in records:
        recorder.put([record])
    assert recorder.dropped == 15
    assert recorder.drain(4) == 4
    recorder.put(records[:5])
    assert recorder.dropped == 16
    recorder.close()
    assert shelf.closed
    assert shelf.records == [*records[15:19], *records[20:], *records[:5]]
    assert recorder.error == ""


def test_what_is_recorded_can_be_read(tmp_path: Path) -> None:
    path, records = tmp_path / "world.mcap", world_records(30)
    for target, recorder in ((path, Recorder(path, open_mcap)), (None, None)):
        recorder = recorder or Recorder(Path(os.devnull), open_mcap)
        recorder.put(records)
        recorder.drain()
        recorder.flush()
        recorder.close()
        assert (recorder.dropped, recorder.error) == (0, "")
        if target:
            assert_equal(Recording.read(target), Recording.from_records(records))


@pytest.mark.promise("a-bad-disk-spares-the-flight")
@pytest.mark.parametrize("room", [0, 100, 1500, *range(20_000, 60_800, 2_720)])
def test_on_a_full_disk_all_is_kept_or_counted(tmp_path: Path, room: int) -> None:
    path, records = tmp_path / "w.mcap", counted(3000)
    recorder = on_disk(room, records, path, 30)
    assert recorder.error == (
        f"{path}: recording stopped: disk full; make room or choose another folder;"
        " the flight goes on"
    )
    kept = 0
    with suppress(BadInputError):
        recording = Recording.read(path)
        kept = len(recording["/count"])
        recovery = recover(path, tmp_path / "clean.mcap")
        assert recovery.bytes_lost == 0, "the file ends with a whole chunk"
        told = "disk full" in recording.note
        assert told or room - path.stat().st_size < 200, "told, if there is room"
    assert kept + recorder.dropped == len(records)
    assert kept < len(records)


def test_without_room_for_the_index_all_chunks_are_kept(tmp_path: Path) -> None:
    path, records = tmp_path / "w.mcap", counted(20)
    size = write(path, records).stat().st_size
    recorder = on_disk(size - 100, records, path, 30)
    assert "disk full" in recorder.error
    assert (len(Recording.read(path)["/count"]), recorder.dropped) == (20, 0)


def failing(step: str, error: OSError) -> Shelf:
    """Make a sink whose `step` fails."""

    def refuse(*_: object) -> None:
        raise error

    shelf = Shelf()
    setattr(shelf, step, refuse)
    return shelf


@pytest.mark.promise("a-bad-disk-spares-the-flight")
@pytest.mark.parametrize("step", ["flush", "sync", "close"])
@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "disk full"),
        (errno.EROFS, "disk is read-only"),
        (errno.EDQUOT, "disk quota used up"),
        (errno.EIO, "Input/output error"),
    ],
)
def test_disk_errors_are_told_and_never_raised(step: str, code: int, words: str) -> None:
    shelf = failing(step, OSError(code, "Input/output error"))
    recorder = Recorder(Path("w.mcap"), lambda path: shelf)
    recorder.put(counted(3))
    recorder.drain()
    recorder.flush()
    recorder.put(counted(2))
    recorder.close()
    assert f"w.mcap: recording stopped: {words};" in recorder.error
    assert recorder.dropped == (0 if step == "close" else 2)


def test_a_folder_that_is_not_there_stops_the_recording_only(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "absent" / "world.mcap", open_mcap)
    recorder.put(counted(7))
    assert recorder.drain() == 7
    recorder.put(counted(3))
    recorder.flush()
    recorder.close()
    assert recorder.dropped == 10
    assert "world.mcap: recording stopped: No such file or directory" in recorder.error


def test_a_record_that_cannot_be_written_costs_only_itself(tmp_path: Path) -> None:
    path, bad = tmp_path / "w.mcap", Counted(1, "world", "sent", 2**70)
    recorder = Recorder(path, open_mcap)
    recorder.put([*counted(1), bad, *counted(3)])
    recorder.close()
    assert recorder.dropped == 1
    assert "a record of type Counted cannot be written" in recorder.error
    assert len(Recording.read(path)["/count"]) == 4


def test_a_recording_that_has_grown_to_its_limit_ends_whole(tmp_path: Path) -> None:
    path = tmp_path / "world.mcap"
    recorder = Recorder(path, open_mcap, size_max=20_000)
    for start in range(0, 3000, 100):
        recorder.put(world_records(100, start * MS))
        while recorder.drain():
            pass
        recorder.flush()
    recorder.close()
    assert "recording stopped: the file has reached its size limit" in recorder.error
    assert recorder.dropped > 0
    assert 20_000 <= path.stat().st_size < 100_000
    assert Recording.read(path).note == "recording stopped: the file has reached its size limit"


@pytest.mark.parametrize("make", [Shelf, lambda: failing("sync", OSError(errno.EIO, "broken"))])
def test_a_sync_by_another_thread_reports_its_error_later(
    tmp_path: Path, make: Callable[[], Shelf]
) -> None:
    path, shelf = tmp_path / "w.mcap", make()
    recorder = Recorder(path, lambda path: shelf)
    recorder.put(counted(1))
    recorder.drain()
    assert not recorder.sync(), "what is in no file is never safe"
    path.touch()
    works = type(shelf.sync).__name__ == "method"
    assert recorder.sync() is works
    assert not shelf.closed
    recorder.flush(sync=False)
    assert (shelf.closed, recorder.error == "") == (not works, works)


def test_a_sync_of_a_closed_file_is_nothing(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "w.mcap", open_mcap)
    recorder.put(counted(1))
    recorder.drain()
    assert recorder._sink is not None
    recorder._sink.close()
    assert not recorder.sync()
    assert recorder.error == ""
