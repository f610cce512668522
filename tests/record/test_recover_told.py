"""A recording whose note says that data is missing is never called complete."""

from __future__ import annotations

import errno
import io
import struct
from pathlib import Path
from typing import Any

import pytest

from cloudrc.cli.main import main
from cloudrc.record.columns import Recording
from cloudrc.record.reader import HEAD, MAGIC
from cloudrc.record.recorder import Recorder
from cloudrc.record.recover import recover
from cloudrc.record.writer import MISSING, McapWriter
from tests.record.conftest import MS, open_mcap, world_records, write


class FullDisk(io.BytesIO):
    """A file on a disk with room for some bytes."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room

    def write(self, data: Any) -> int:
        """Write the bytes, or refuse."""
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


def drained(recorder: Recorder) -> Recorder:
    """Record 20 s."""
    for start in range(0, 20_000, 500):
        recorder.put(world_records(50, start * MS))
        while recorder.drain():
            pass
        recorder.flush(sync=False)
    recorder.close()
    return recorder


def full(path: Path, room: int = 60_000) -> Path:
    """Make a recording whose disk fills up."""
    disk = FullDisk(room)
    drained(Recorder(path, lambda _: McapWriter(disk, clock="world")))
    path.write_bytes(disk.getvalue())
    return path


def ended(path: Path) -> Path:
    """Make a recording that reaches its size limit."""
    drained(Recorder(path, open_mcap, size_max=50_000))
    return path


def recovered(path: Path) -> Path:
    """Make the recovery of a torn recording."""
    torn = write(path.with_name("torn.mcap"), world_records(500))
    torn.write_bytes(torn.read_bytes()[:20_000])
    assert not recover(torn, path).complete
    return path


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (full, "recording stopped: disk full"),
        (ended, "recording stopped: the file has reached its size limit"),
        (recovered, "cut short: the file has no end; "),
    ],
)
def test_what_a_recording_says_it_lacks_is_lossy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], make: object, said: str
) -> None:
    assert callable(make)
    path, new = make(tmp_path / "w.mcap"), tmp_path / "new.mcap"
    assert main(["recover", str(path), "--to", str(new)]) == 1
    assert f"lossy: {said}" in capsys.readouterr().out
    assert Recording.read(new).note == Recording.read(path).note


def test_what_was_said_before_a_file_was_torn_is_said_still(tmp_path: Path) -> None:
    path, new = full(tmp_path / "w.mcap"), tmp_path / "new.mcap"
    path.write_bytes(path.read_bytes()[:-50])
    note = "recording stopped: disk full; cut short: the file has no end"
    recover(path, new)
    assert Recording.read(new).note == note


@pytest.mark.parametrize("short", [1, 60, 100])
def test_without_space_for_the_note_the_file_gets_no_end(tmp_path: Path, short: int) -> None:
    size = full(tmp_path / "w.mcap").stat().st_size
    path = full(tmp_path / "v.mcap", size - short)
    assert not recover(path, tmp_path / "new.mcap").complete


def test_a_second_recording_in_one_file_is_counted_as_left_out(tmp_path: Path) -> None:
    path, new = write(tmp_path / "w.mcap", world_records(500)), tmp_path / "new.mcap"
    alone = recover(path, tmp_path / "alone.mcap")
    assert alone.complete
    path.write_bytes(path.read_bytes() * 2)
    recovery = recover(path, new)
    assert not recovery.complete
    assert recovery.kept == alone.kept
    counts = {"chunks": alone.kept["chunks"], "messages": alone.kept["messages"]}
    assert recovery.dropped == counts
    assert recovery.share == pytest.approx(0.5, abs=0.02)


def test_more_channels_than_a_file_can_number_are_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cloudrc.record.recover.CHANNELS_MAX", 300)
    path = tmp_path / "many.mcap"
    path.write_bytes(hostile(350, schemas=True) + hostile(350, schemas=False)[len(MAGIC) :])
    recovery = recover(path, tmp_path / "new.mcap")
    assert (recovery.kept["messages"], recovery.kept["channels"]) == (300, 300)
    assert recovery.dropped == {"messages": 400}


def test_of_messages_none_of_which_is_kept_nothing_is(tmp_path: Path) -> None:
    path = tmp_path / "homeless.mcap"
    messages = record(5, struct.pack("<H", 1) + bytes(20)) * 9
    path.write_bytes(MAGIC + record(12, text(b"a") + text(b"")) + messages)
    recovery = recover(path, tmp_path / "new.mcap")
    assert (recovery.share, recovery.dropped) == (0.0, {"messages": 9})


def test_what_a_recording_says_does_not_steer_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.mcap"
    with McapWriter(path, clock="world") as writer:
        writer.write(world_records(5))
        writer.note({MISSING: "\x1b[2J all"})
    assert main(["recover", str(path)]) == 1
    assert "lossy: \\x1b[2J all\n" in capsys.readouterr().out


def hostile(count: int, *, schemas: bool) -> bytes:
    """Make messages that each redefine the same channel, perhaps with a schema."""
    parts = [MAGIC]
    for n in range(count):
        name, number = b"t%07d" % n, struct.pack("<H", 1)
        if schemas:
            parts.append(record(3, number + text(name) + text(b"ros2msg") + text(b"")))
        channel = number + struct.pack("<H", schemas) + text(name) + text(b"cdr") + text(b"")
        parts += [record(4, channel), record(5, number + bytes(20))]
    return b"".join(parts)


def record(opcode: int, payload: bytes) -> bytes:
    return HEAD.pack(opcode, len(payload)) + payload


def text(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data
