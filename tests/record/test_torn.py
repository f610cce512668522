"""A torn or damaged file is read as far as it is readable."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.reader import read_contents
from cloudrc.record.ros import definition
from cloudrc.record.topics import TOPICS
from cloudrc.record.writer import McapWriter
from tests.record.conftest import assert_equal, world_records

RECORDS = world_records(160)


def whole_file() -> bytes:
    stream = io.BytesIO()
    writer = McapWriter(stream, clock="world")
    writer.write(RECORDS)
    writer.attach("config.yaml", b"seed: 1\n" * 50)
    writer.close()
    return stream.getvalue()


WHOLE = whole_file()


def chunk_spans() -> list[tuple[int, int]]:
    """Return the start and end of each chunk."""
    spans, start = [], 8
    while WHOLE[start] != Opcode.FOOTER:
        end = start + 9 + int.from_bytes(WHOLE[start + 1 : start + 9], "little")
        if WHOLE[start] == Opcode.CHUNK:
            spans.append((start, end))
        start = end
    return spans


CHUNKS = chunk_spans()


def messages_until(cut: int) -> int:
    """Count the messages in the chunks that end before `cut`."""
    records = StreamReader(io.BytesIO(WHOLE), emit_chunks=True).records
    chunks = [record for record in records if isinstance(record, Chunk)]
    whole = [chunk for chunk, (_, end) in zip(chunks, CHUNKS, strict=True) if end <= cut]
    return sum(count_messages(chunk) for chunk in whole)


def count_messages(chunk: Chunk) -> int:
    return sum(isinstance(record, Message) for record in breakup_chunk(chunk))


def torn(folder: Path, cut: int) -> Path:
    path = folder / "torn.mcap"
    path.write_bytes(WHOLE[:cut])
    return path


EDGES = sorted({edge + by for span in CHUNKS for edge in span for by in (-1, 0, 1)})


@pytest.mark.parametrize("cut", [*EDGES, len(WHOLE) // 2, len(WHOLE) - 1, len(WHOLE) - 9])
def test_all_whole_chunks_are_read(tmp_path: Path, cut: int) -> None:
    expected, path = messages_until(cut), torn(tmp_path, cut)
    if not expected:
        with pytest.raises(BadInputError, match=r"torn\.mcap: holds no readable message"):
            Recording.read(path)
        return
    recording = Recording.read(path)
    assert sum(len(recording[topic]) for topic in TOPICS) == expected
    assert not recording.complete
    assert f"{expected} messages were read" in recording.note
    assert len(recording["/contact_force"]) == len(recording["/reference"])


def note_or_refusal(path: Path) -> str:
    """Return the note or error of a read; other exceptions pass."""
    try:
        return Recording.read(path).note
    except BadInputError as error:
        return str(error)


@given(st.integers(0, len(WHOLE) - 1))
@settings(max_examples=30, deadline=None)
def test_no_cut_ends_in_a_traceback(tmp_path_factory: pytest.TempPathFactory, cut: int) -> None:
    path = torn(tmp_path_factory.getbasetemp(), cut)
    refusal = note_or_refusal(path)
    if cut < CHUNKS[0][1]:
        assert refusal.startswith(f"{path}: holds no readable message")
        assert "name another recording" in refusal
    else:
        assert refusal.startswith("cut short")


@given(st.integers(0, len(WHOLE) - 1), st.integers(1, 255))
@settings(max_examples=30, deadline=None)
def test_no_flipped_byte_ends_in_a_traceback(
    tmp_path_factory: pytest.TempPathFactory, at: int, flip: int
) -> None:
    path = tmp_path_factory.getbasetemp() / "flipped.mcap"
    path.write_bytes(WHOLE[:at] + bytes([WHOLE[at] ^ flip]) + WHOLE[at + 1 :])
    assert "Traceback" not in note_or_refusal(path)


def test_the_whole_file_is_complete(tmp_path: Path) -> None:
    recording = Recording.read(torn(tmp_path, len(WHOLE)))
    assert recording.complete
    assert recording.note == ""
    assert_equal(recording, Recording.from_records(RECORDS))


def test_a_lost_index_loses_no_message(tmp_path: Path) -> None:
    recording = Recording.read(torn(tmp_path, len(WHOLE) - 1))
    assert recording.note.startswith("cut short in its index: all ")
    assert recording.attachments["config.yaml"] == b"seed: 1\n" * 50
    assert_equal(recording, Recording.from_records(RECORDS))


@pytest.mark.parametrize("number", [0, 1])
def test_a_damaged_chunk_costs_only_itself(tmp_path: Path, number: int) -> None:
    start, end = CHUNKS[number]
    path = tmp_path / "damaged.mcap"
    middle = (start + end) // 2
    path.write_bytes(WHOLE[:middle] + bytes([WHOLE[middle] ^ 255]) + WHOLE[middle + 1 :])
    recording = Recording.read(path)
    assert recording.note == "1 damaged chunks were left out"
    assert 100 < len(recording["/odometry"]) < 160
    assert recording["/odometry"]["stamp_ns"][-1] == RECORDS[-1].stamp_ns


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "it is not an MCAP file"),
        (WHOLE[:5], "it is not an MCAP file"),
        (b"PK\x03\x04 this is not a recording", "it is not an MCAP file"),
        (WHOLE[:8] + b"\x01" + b"\xff" * 40, "it is cut short or damaged"),
    ],
)
def test_nothing_readable_is_bad_input(tmp_path: Path, data: bytes, reason: str) -> None:
    path = tmp_path / "nothing.mcap"
    path.write_bytes(data)
    with pytest.raises(BadInputError, match=f"nothing.mcap: holds no readable message: {reason}"):
        Recording.read(path)


def test_a_file_that_is_not_there_is_bad_input(tmp_path: Path) -> None:
    for path in (tmp_path / "absent.mcap", tmp_path):
        with pytest.raises(BadInputError, match=r"cannot be read \(.+\); name a recording"):
            Recording.read(path)


def foreign(path: Path, topic: str, ros_type: str, text: str, data: bytes) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        schema = writer.register_schema(ros_type, "ros2msg", text.encode())
        channel = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channel, 1, data, 1)
        writer.finish()
    return path


def test_topics_of_another_layout_are_left_out_and_named(tmp_path: Path) -> None:
    ros_type = "cloudrc_msgs/msg/Arrival"
    changed = definition(ros_type).replace("bool used", "int8 used")
    for topic, name, text in (
        ("/uplink_delay", ros_type, changed),
        ("/uplink_delay", "cloudrc_msgs/msg/Pid", definition("cloudrc_msgs/msg/Pid")),
        ("/camera", ros_type, definition(ros_type)),
    ):
        recording = Recording.read(foreign(tmp_path / "f.mcap", topic, name, text, b"\0\1\0\0"))
        assert recording.note == f"topics of another layout were left out: {topic}"
        assert len(recording["/uplink_delay"]) == 0


def test_a_message_that_is_not_what_it_claims_is_counted(tmp_path: Path) -> None:
    ros_type = "cloudrc_msgs/msg/Arrival"
    text = definition(ros_type)
    path = foreign(tmp_path / "g.mcap", "/uplink_delay", ros_type, text, b"\0\1\0\0\7")
    assert Recording.read(path).note == "1 messages are not readable"
    assert len(read_contents(path).messages) == 1
