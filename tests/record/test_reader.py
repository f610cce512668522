"""A file is read up to its end or its first damaged part; foreign files are named as they are."""

from __future__ import annotations

import io
import itertools
import re
import tracemalloc
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.hash import messages_sha256
from cloudrc.record.reader import read_contents
from cloudrc.record.ros import definition
from cloudrc.record.topics import TOPICS
from cloudrc.record.writer import SHA256, McapWriter
from tests.record.conftest import assert_equal, rewrite, world_records

RECORDS = world_records(160)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole") / "whole.mcap"
    with McapWriter(path, clock="world") as writer:
        writer.write(RECORDS)
        writer.attach("config.yaml", b"seed: 1\n" * 50)
    return path


def chunk_spans(data: bytes) -> list[tuple[int, int, int]]:
    """Return the start and end of each chunk, and the number of messages up to there."""
    found, start, count = [], 8, 0
    chunks = StreamReader(io.BytesIO(data), emit_chunks=True).records
    sizes = (
        sum(isinstance(record, Message) for record in breakup_chunk(chunk))
        for chunk in chunks
        if isinstance(chunk, Chunk)
    )
    while data[start] != Opcode.FOOTER:
        end = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
        if data[start] == Opcode.CHUNK:
            count += next(sizes)
            found.append((start, end, count))
        start = end
    return found


def test_a_cut_file_is_read_to_its_last_whole_chunk(whole: Path, tmp_path: Path) -> None:
    data, path = whole.read_bytes(), tmp_path / "cut.mcap"
    spans = chunk_spans(data)
    for end, by in itertools.product([end for _, end, _ in spans], (-1, 0, 1, 500)):
        path.write_bytes(data[: end + by])
        expected = max((count for _, at, count in spans if at <= end + by), default=0)
        if not expected:
            with pytest.raises(BadInputError, match=r"cut\.mcap: holds no readable message: cut"):
                Recording.read(path)
            continue
        recording = Recording.read(path)
        assert sum(len(recording[topic]) for topic in TOPICS) == expected
        assert recording.note.startswith(f"cut short: {expected} messages were read, the last at ")
        assert (recording.complete, recording.lacking) == (False, "")


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_no_cut_or_flipped_byte_passes_unnoticed(whole: Path, data: st.DataObject) -> None:
    good = whole.read_bytes()
    at, flip = data.draw(st.integers(0, len(good) - 1)), data.draw(st.integers(0, 255))
    path = whole.with_name("damaged.mcap")
    path.write_bytes(good[:at] + (bytes([good[at] ^ flip]) + good[at + 1 :] if flip else b""))
    with suppress(BadInputError):
        recording = Recording.read(path)
        if recording.complete:  # a byte of the index, which is not read
            assert_equal(recording, Recording.from_records(RECORDS))


def test_a_whole_file_is_complete(whole: Path, tmp_path: Path) -> None:
    recording = Recording.read(whole)
    assert (recording.complete, recording.note, recording.remarks) == (True, "", ())
    assert_equal(recording, Recording.from_records(RECORDS))
    torn = tmp_path / "index.mcap"
    torn.write_bytes(whole.read_bytes()[:-1])
    recording = Recording.read(torn)
    assert recording.complete
    assert recording.remarks == ("had a torn index: all its messages were read",)
    assert recording.attachments["config.yaml"] == b"seed: 1\n" * 50
    assert_equal(recording, Recording.from_records(RECORDS))


def test_reading_stops_at_a_damaged_chunk(whole: Path, tmp_path: Path) -> None:
    data, path = bytearray(whole.read_bytes()), tmp_path / "damaged.mcap"
    (_, _, count), (start, end, _), *_ = chunk_spans(data)
    data[(start + end) // 2] ^= 255
    path.write_bytes(data)
    recording = Recording.read(path)
    assert recording.lacking == recording.note
    assert recording.note.startswith(f"damaged: a checksum is wrong: {count} messages were read")


def test_what_follows_the_end_is_told(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "twice.mcap"
    path.write_bytes(whole.read_bytes() * 2)
    assert Recording.read(path).lacking == "something follows its end"


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "is empty"),
        (bytes(100), "is empty"),
        (b"\x89MCAP0\r\n\x01" + b"\xff" * 40, "holds no readable message: cut short"),
        (b"#ROSBAG V2.0\n", "is a ROS 1 bag, not an MCAP file"),
        (b"SQLite format 3\0", r"is an SQLite file, not MCAP; .*ros2 bag convert"),
        (b"PK\x03\x04 and so on", "is not an MCAP file"),
    ],
)
def test_a_file_of_another_kind_is_named(tmp_path: Path, data: bytes, reason: str) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(data)
    with pytest.raises(BadInputError, match=rf"^[^\n]*x\.mcap: {reason}[^\n]*$"):
        Recording.read(path)


def test_a_folder_or_an_absent_file_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.mcap", tmp_path):
        with pytest.raises(BadInputError, match=r"cannot be read \(.+\); name a recording"):
            Recording.read(path)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {"chunk_size": 1, "enable_crcs": False},
        {"use_statistics": False, "repeat_channels": False, "use_summary_offsets": False},
        {"shuffle": lambda messages: Random(1).shuffle(messages)},
    ],
    ids=str,
)
def test_an_unusual_layout_is_read(whole: Path, tmp_path: Path, options: dict[str, Any]) -> None:
    path = rewrite(whole, tmp_path / "n.mcap", **options)
    contents = read_contents(path)
    assert contents.note == ""
    assert_equal(Recording.from_contents(contents), Recording.from_records(RECORDS))
    assert messages_sha256(contents.messages) == contents.metadata[SHA256]
    assert [remark[:9] for remark in contents.remarks] == ["was not i"] * ("shuffle" in options)


def test_another_compression_is_named(whole: Path, tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(whole.read_bytes().replace(b"\x04\0\0\0zstd", b"\x04\0\0\0snap"))
    with pytest.raises(BadInputError, match=r"chunks are compressed by 'snap'; .* zstd and lz4"):
        read_contents(path)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"keep": lambda c, m: c.topic != "/guard"}, "it holds 0 of 1 on /guard$"),
        ({"keep": lambda c, m: m.log_time < 10**9}, r"it holds .*, .*, .* and 6 more topics$"),
        ({"rename": lambda t: f"/r2{t}"}, "it holds 0 of"),
        ({"rename": lambda t: t.replace("/odometry", "/ground_truth")}, "/odometry, 320 of 160 on"),
        ({"metadata": False}, "the metadata of cloudrc, which names the clock, is not there"),
        ({"shuffle": lambda all: all.extend(all[:4])}, "messages were removed or added: it holds "),
    ],
    ids=["topic", "half", "renamed", "joined", "metadata", "doubled"],
)
def test_what_other_programs_changed_is_named(
    whole: Path, tmp_path: Path, options: dict[str, Any], said: str
) -> None:
    recording = Recording.read(rewrite(whole, tmp_path / "n.mcap", **options))
    assert recording.lacking == recording.note
    assert re.search(said, recording.lacking), recording.lacking


def test_a_torn_recording_that_others_ended_is_told(tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream, clock="world")
    writer.write(RECORDS)
    writer._mcap.finish()
    (tmp_path / "w.mcap").write_bytes(stream.getvalue())
    assert "another program has put an end to it" in Recording.read(tmp_path / "w.mcap").lacking


def foreign(path: Path, topic: str, ros_type: str, text: str, data: bytes, channels: int) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        writer.add_metadata("cloudrc", {"clock": "world"})
        schema = writer.register_schema(ros_type, "ros2msg", text.encode())
        for n in range(channels):
            channel = writer.register_channel(topic, "cdr", schema, {"robot": str(n)})
            writer.add_message(channel, 1, data, 1)
        writer.finish()
    return path


ARRIVAL = definition("cloudrc_msgs/msg/Arrival")


@pytest.mark.parametrize(
    ("topic", "name", "text", "channels", "said"),
    [
        ("/uplink_delay", "Arrival", ARRIVAL.replace("bool used", "int8 used"), 1, "layout"),
        ("/uplink_delay", "Pid", definition("cloudrc_msgs/msg/Pid"), 1, "layout"),
        ("/uplink_delay", "Arrival", ARRIVAL, 2, "two robots or two recordings are in one file"),
        ("/uplink_delay", "Arrival", ARRIVAL, 1, "1 messages are not readable"),
        ("/camera", "Arrival", ARRIVAL, 1, ""),
    ],
)
def test_foreign_topics_are_told_apart(
    tmp_path: Path, topic: str, name: str, text: str, channels: int, said: str
) -> None:
    path, ros_type = tmp_path / "f.mcap", f"cloudrc_msgs/msg/{name}"
    recording = Recording.read(foreign(path, topic, ros_type, text, b"\0\1\0\0\7", channels))
    assert said in recording.lacking
    assert bool(said) == bool(recording.note)
    assert bool(recording.remarks) == (not said)
    assert len(recording["/uplink_delay"]) == 0


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("size", [0, 1 << 20])
@pytest.mark.parametrize("stated", [None, 1000])
def test_a_bomb_ends_with_one_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    compression: CompressionType,
    size: int,
    stated: int | None,
) -> None:
    """A few kilobytes unpack to far more: in large messages, or in very many."""
    monkeypatch.setattr("cloudrc.record.reader.UNPACKED_MAX", limit := 4)
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as stream:
        options = {"compression": compression, "index_types": IndexType.NONE}
        writer = Writer(stream, chunk_size=1 << 27, **options)
        writer.start()
        schema = writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", b"")
        channel = writer.register_channel("/odometry", "cdr", schema)
        for _ in range(20 if size else 40_000):
            writer.add_message(channel, 1, bytes(size), 1)
        writer.finish()
    if stated is not None:  # the chunk lies about its size
        data = bytearray(path.read_bytes())
        start = data.index(compression.name.lower().encode()) - 16
        data[start : start + 8] = stated.to_bytes(8, "little")
        path.write_bytes(data)
    tracemalloc.start()
    try:
        told = note_or_error(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert told.count("\n") == 0
    assert ("unpacks to more than 4 times its size" in told) == (stated is None)
    assert peak < 4 * limit << 20


def note_or_error(path: Path) -> str:
    try:
        return read_contents(path).lacking
    except BadInputError as error:
        return str(error)
