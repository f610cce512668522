"""Small files that unpack to very much cost one chunk of memory; all losses are counted."""

from __future__ import annotations

import io
import os
import struct
import tracemalloc
from pathlib import Path

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.records import Chunk

from cloudrc.errors import BadInputError
from cloudrc.record.reader import (
    DEFINITION_MAX,
    MAGIC,
    RECORD_COST,
    ROOM_SHARE,
    DamagedError,
    Scan,
    read_contents,
    unpack,
)
from cloudrc.record.recover import recover
from cloudrc.record.ros import definition
from cloudrc.record.topics import TOPICS
from cloudrc.record.writer import McapWriter
from cloudrc.records import TelemetrySent
from tests.record.conftest import world_records
from tests.record.test_recover_told import record, text


def chunk(*inside: bytes) -> bytes:
    data = b"".join(inside)
    packed = zstandard.compress(data)
    head = struct.pack("<QQQI", 0, 0, len(data), 0) + text(b"zstd")
    return record(Opcode.CHUNK, head + struct.pack("<Q", len(packed)) + packed)


def channel(number: int, topic: bytes = b"/t") -> bytes:
    values = struct.pack("<HH", number, 0) + text(topic) + text(b"cdr") + text(b"")
    return record(Opcode.CHANNEL, values)


def message(number: int) -> bytes:
    return record(Opcode.MESSAGE, struct.pack("<H", number) + bytes(20))


def file(*chunks: bytes) -> bytes:
    return MAGIC + record(Opcode.HEADER, text(b"") + text(b"")) + b"".join(chunks)


@pytest.mark.parametrize("compression", ["", "zstd"])
@pytest.mark.parametrize(("beyond", "read"), [(0, [1, 1]), (1, None), (-1, None)])
def test_a_chunk_is_as_long_as_it_says_or_is_none(
    compression: str, beyond: int, read: list[int] | None
) -> None:
    """A chunk that holds more than it states is damaged."""
    whole = message(1) * 2
    held = (whole + message(1))[: len(whole) + beyond]
    data = zstandard.compress(held) if compression else held
    said = Chunk(compression, data, 0, 0, 0, len(whole))
    if read is None:
        with pytest.raises(DamagedError, match="length"):
            unpack(said)
    else:
        assert [each.channel_id for each in unpack(said)] == read  # type: ignore[attr-defined]


def test_a_chunk_never_unpacks_to_more_than_it_states() -> None:
    bomb = Chunk("zstd", zstandard.compress(bytes(64 << 20)), 0, 0, 0, 1_000)
    tracemalloc.start()
    try:
        with pytest.raises(DamagedError, match="length"):
            unpack(bomb)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20


def test_of_a_chunk_of_many_messages_one_is_held_at_a_time() -> None:
    count, unpacked = 50_000, 50_000 * len(message(1))
    data = file(chunk(channel(1), message(1) * count))
    assert len(data) < 1_000
    tracemalloc.start()
    try:
        assert sum(1 for _ in Scan(io.BytesIO(data)).records()) == count + 2
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 3 * unpacked


def defined(topic: str = "/telemetry") -> bytes:
    """Define one of our topics as its writer does."""
    name = TOPICS[topic].ros_type
    schema = struct.pack("<H", 1) + text(name.encode()) + text(b"ros2msg")
    schema += text(definition(name).encode())
    values = struct.pack("<HH", 1, 1) + text(topic.encode()) + text(b"cdr") + text(b"")
    return record(Opcode.SCHEMA, schema) + record(Opcode.CHANNEL, values)


@pytest.mark.parametrize("size", [0, 1 << 20])
def test_a_file_that_unpacks_to_too_much_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    """Make many small chunks with known topics, as from a writer."""
    monkeypatch.setattr("cloudrc.record.reader.ROOM_MIN", room := 3 << 20)
    one = record(Opcode.MESSAGE, struct.pack("<H", 1) + bytes(20 + size))
    path, new = tmp_path / "w.mcap", tmp_path / "new.mcap"
    path.write_bytes(file(chunk(defined()), *[chunk(one * ((1 << 20) // len(one) + 1))] * 9))
    assert path.stat().st_size * ROOM_SHARE < room
    reason = f"w.mcap: its {path.stat().st_size} bytes unpack to more than those of any recording"
    tracemalloc.start()
    try:
        with pytest.raises(BadInputError, match=reason) as caught:
            read_contents(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 5 * room
    assert "\n" not in str(caught.value)
    with pytest.raises(BadInputError, match=reason):
        recover(path, new)
    assert os.listdir(tmp_path) == ["w.mcap"]


def test_messages_of_topics_that_nobody_asked_for_are_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "w.mcap"
    path.write_bytes(file(chunk(defined(), message(1)), chunk(channel(2), message(2) * 20_000)))
    tracemalloc.start()
    try:
        assert [message[0] for message in read_contents(path).messages] == ["/telemetry"]
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 4 * 20_000 * len(message(2))


def test_a_topic_that_is_defined_behind_its_messages_is_read(tmp_path: Path) -> None:
    """As after a damaged chunk."""
    path = tmp_path / "w.mcap"
    path.write_bytes(file(chunk(message(1) * 3), chunk(defined(), message(1))))
    assert len(read_contents(path).messages) == 4


def test_an_idle_recording_is_far_from_what_is_too_much(tmp_path: Path) -> None:
    """Messages that differ only in time compress best."""
    (telemetry,) = [r for r in world_records(1) if isinstance(r, TelemetrySent)]
    path = tmp_path / "idle.mcap"
    with McapWriter(path, clock="world") as writer:
        for number in range(8_000):
            writer.write([telemetry._replace(stamp_ns=10_000_000 * number)])
    room = path.stat().st_size * ROOM_SHARE
    taken = sum(len(data) + 31 + RECORD_COST for *_, data in read_contents(path).messages)
    assert 2 * taken < room


def test_of_a_chunk_that_ends_in_nonsense_nothing_is_kept(tmp_path: Path) -> None:
    path, new = tmp_path / "w.mcap", tmp_path / "new.mcap"
    for torn in (message(1)[:-1], record(Opcode.MESSAGE, bytes(21)), b"\5", channel(2)[:-1]):
        path.write_bytes(file(chunk(channel(1), message(1), torn), chunk(channel(1), message(1))))
        recovery = recover(path, new)
        assert (recovery.kept["messages"], recovery.dropped["chunks"]) == (1, 1)


@pytest.mark.parametrize(
    "inside",
    [
        record(Opcode.MESSAGE_INDEX, struct.pack("<HI", 1, 16 * 100) + bytes(16 * 100)),
        record(Opcode.METADATA, text(b"") + text(b"")),
        channel(1, b"t" * DEFINITION_MAX),
    ],
)
def test_what_becomes_many_objects_is_not_read_in_a_chunk(tmp_path: Path, inside: bytes) -> None:
    path = tmp_path / "w.mcap"
    path.write_bytes(file(chunk(inside)))
    with pytest.raises(BadInputError, match="nothing that can be read"):
        recover(path, tmp_path / "new.mcap")


def test_too_many_definitions_are_left_out_with_their_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cloudrc.record.recover.DEFINITIONS_MAX", 3_500)
    path = tmp_path / "w.mcap"
    each = [channel(n, b"%d" % n + b"t" * 1_000) + message(n) for n in range(5)]
    again = channel(0, b"0" + b"t" * 1_000) + message(0)  # as some writers do in every chunk
    path.write_bytes(file(chunk(*each), chunk(again)))
    recovery = recover(path, tmp_path / "new.mcap")
    assert (recovery.kept["messages"], recovery.kept["channels"]) == (4, 3)
    assert recovery.dropped == {"messages": 2}


class Counting(io.BytesIO):
    taken = 0

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self.taken += len(data)
        return data


def test_a_break_after_every_chunk_costs_no_look_at_all_the_rest() -> None:
    count = 300
    stream = Counting(file(*[chunk(channel(1), message(1)) + bytes(9)] * count))
    scan = Scan(stream)
    assert len(list(scan.records())) == 1 + 2 * count
    assert scan.dropped == {"records": count - 1}
    assert stream.taken < 5_000 * count


@pytest.mark.parametrize("gap", [4_000, 4_080, 4_095, 4_096, 12_283, 12_288, 3_000_000])
def test_the_next_chunk_is_found_however_far_it_is(gap: int) -> None:
    data = file(chunk(channel(1), message(1)), bytes(gap), chunk(channel(1), message(1)))
    scan = Scan(io.BytesIO(data))
    assert len(list(scan.records())) == 5
    assert scan.skipped == gap
