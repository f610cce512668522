"""The recorder never blocks and survives all disk errors."""

from __future__ import annotations

import errno
import io
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.record.recover import recover
from cloudrc.record.writer import McapWriter
from cloudrc.records import Counted
from tests.record.conftest import MS, Shelf, assert_equal, counted, open_mcap, world_records, write

NO_SPACE = OSError(errno.ENOSPC, "No space left on device")


class Disk(io.BytesIO):
    """A file on a disk with space for `room` bytes."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self.room:
            raise NO_SPACE
        return super().write(data)


def test_the_oldest_are_dropped_and_counted() -> None:
    shelf, records = Shelf(), counted(25)
    recorder = Recorder(Path("x"), lambda path: shelf, capacity=10)
    for record in records:
        recorder.put([record])
    assert recorder.dropped == 15
    assert recorder.drain(4) == 4
    recorder.put(records[:2])
    assert recorder.dropped == 15
    recorder.put(records[2:5])
    assert recorder.dropped == 16
    recorder.close()
    assert shelf.closed
    assert shelf.records == [*records[15:19], *records[20:], *records[:5]]
    assert recorder.error == ""


def test_a_drain_takes_no_more_than_it_may() -> None:
    recorder = Recorder(Path("x"), lambda path: Shelf())
    recorder.put(counted(10))
    assert [recorder.drain(4) for _ in range(4)] == [4, 4, 2, 0]


def test_what_is_recorded_can_be_read(tmp_path: Path) -> None:
    path, records = tmp_path / "world.mcap", world_records(30)
    recorder = Recorder(path, open_mcap)
    recorder.put(records)
    recorder.close()
    assert_equal(Recording.read(path), Recording.from_records(records))
    assert (recorder.dropped, recorder.error) == (0, "")


@pytest.mark.promise("a-bad-disk-spares-the-flight")
def test_a_full_disk_stops_the_recording_and_nothing_else(tmp_path: Path) -> None:
    disk, records = Disk(60_000), world_records(400)
    recorder = Recorder(Path("world.mcap"), lambda path: McapWriter(disk, clock="world"))
    for record in records:
        recorder.put([record])
        recorder.drain()
        recorder.flush()
    recorder.close()
    assert recorder.error == (
        "world.mcap: recording stopped: disk full;"
        " make room or choose another folder; the flight goes on"
    )
    assert 0 < recorder.dropped < len(records)
    path = tmp_path / "kept.mcap"
    path.write_bytes(disk.getvalue())
    assert len(Recording.read(path)["/odometry"]) > 50


@pytest.mark.parametrize("room", range(60_000, 60_800, 80))
def test_on_a_full_disk_the_file_ends_with_a_whole_chunk(tmp_path: Path, room: int) -> None:
    disk = Disk(room)
    recorder = Recorder(Path("world.mcap"), lambda path: McapWriter(disk, clock="world"))
    for record in world_records(400):
        recorder.put([record])
        recorder.drain()
        recorder.flush()
    recorder.close()
    path = tmp_path / "kept.mcap"
    path.write_bytes(disk.getvalue())
    recovery = recover(path, tmp_path / "clean.mcap")
    assert (recovery.bytes_lost, recovery.dropped) == (0, {})
    note = Recording.read(path).note
    assert "disk full" in note or room - len(disk.getvalue()) < 200, "told, if there is room"


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
def test_disk_errors_are_reported_to_the_user_and_never_raised(
    step: str, code: int, words: str
) -> None:
    class Refusing(Shelf):
        pass

    def refuse(*_: object) -> None:
        raise OSError(code, "Input/output error")

    shelf = Refusing()
    setattr(shelf, step, refuse)
    recorder = Recorder(Path("w.mcap"), lambda path: shelf)
    recorder.put(counted(3))
    recorder.drain()
    recorder.flush()
    recorder.put(counted(2))
    recorder.close()
    assert f"w.mcap: recording stopped: {words};" in recorder.error
    assert recorder.dropped == (0 if step == "close" else 2)


def test_a_recording_without_a_file_needs_no_disk() -> None:
    recorder = Recorder(Path(os.devnull), open_mcap)
    recorder.put(counted(3))
    recorder.drain()
    recorder.flush()
    recorder.close()
    assert (recorder.error, recorder.dropped) == ("", 0)


def test_a_disk_that_fills_up_at_the_very_end_raises_nothing() -> None:
    recorder = Recorder(Path("w.mcap"), lambda path: McapWriter(Disk(1500), clock="world"))
    recorder.put(counted(20))
    recorder.close()
    assert "disk full" in recorder.error


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


@pytest.mark.parametrize("room", [0, 10, 100])
def test_a_disk_without_room_for_the_head_raises_nothing(room: int) -> None:
    recorder = Recorder(Path("w.mcap"), lambda path: McapWriter(Disk(room), clock="world"))
    recorder.put(counted(5))
    recorder.close()
    assert recorder.dropped == 5
    assert "disk full" in recorder.error


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


@pytest.mark.parametrize("room", [0, 1500, *range(20_000, 60_000, 7_000)])
def test_on_a_full_disk_every_record_is_in_the_file_or_counted(tmp_path: Path, room: int) -> None:
    disk, records, path = Disk(room), counted(3000), tmp_path / "w.mcap"
    recorder = Recorder(path, lambda _: McapWriter(disk, clock="world"))
    for start in range(0, len(records), 30):
        recorder.put(records[start : start + 30])
        while recorder.drain():
            pass
        if start % 90 == 0:
            recorder.flush()
    recorder.close()
    path.write_bytes(disk.getvalue())
    with suppress(BadInputError):
        kept = 0
        kept = len(Recording.read(path)["/count"])
    assert (kept + recorder.dropped, kept < len(records)) == (len(records), True)


def test_without_room_for_the_index_the_last_chunk_is_kept(tmp_path: Path) -> None:
    path, records = tmp_path / "w.mcap", counted(20)
    whole = write(path, records).read_bytes()
    disk = Disk(len(whole) - 100)
    recorder = Recorder(path, lambda _: McapWriter(disk, clock="world"))
    recorder.put(records)
    recorder.close()
    path.write_bytes(disk.getvalue())
    assert "disk full" in recorder.error
    assert len(Recording.read(path)["/count"]) == 20
    assert recorder.dropped == 0
