"""A file is read or recovered up to its end or first damage; other kinds of files are named."""

import io
import itertools
import json
import re
import subprocess
import tracemalloc
from collections import Counter
from contextlib import suppress
from random import Random

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

from cloudrc.drivers import local
from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.recovery import recover
from cloudrc.record.ros import definition
from cloudrc.record.writer import McapWriter
from tests.record.conftest import assert_equal, rewrite, world_records, write

RECORDS = world_records(160)


def recorded(records):
    stream = io.BytesIO()
    with McapWriter(stream, clock="world") as writer:
        writer.write(records)
        writer.attach("config.yaml", b"seed: 1\n" * 50)
    return stream.getvalue()


WHOLE, EXPECTED = recorded(RECORDS), Recording.from_records(RECORDS)
OTHER = recorded(RECORDS[1:])
"""Another recording."""
MESSAGES = [
    (channel.topic, message.log_time, message.data)
    for _, channel, message in make_reader(io.BytesIO(WHOLE)).iter_messages()
]


def spans(data):
    """Return the opcode, start and end of each record."""
    found, start = [], 8
    while start < len(data) - 8:
        end = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
        found.append((data[start], start, end))
        start = end
    return found


CHUNKS = [(start, end) for opcode, start, end in spans(WHOLE) if opcode == Opcode.CHUNK]
SIZES = [
    sum(isinstance(record, Message) for record in breakup_chunk(chunk))
    for chunk in StreamReader(io.BytesIO(WHOLE), emit_chunks=True).records
    if isinstance(chunk, Chunk)
]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.mcap"


@pytest.fixture
def whole(tmp_path):
    (tmp_path / "whole.mcap").write_bytes(WHOLE)
    return tmp_path / "whole.mcap"


def flipped(at, mask=255):
    return WHOLE[:at] + bytes([WHOLE[at] ^ mask]) + WHOLE[at + 1 :]


@pytest.mark.parametrize("cut", [0, 1, 8, 30])
def test_a_lost_index_loses_nothing(path, cut):
    path.write_bytes(WHOLE[: len(WHOLE) - cut])
    recording = Recording.read(path)
    assert recording.note == ""
    assert [remark[:16] for remark in recording.remarks] == ["had a torn index"] * (cut > 0)
    recovery = recover(path, new := path.with_name("new.mcap"))
    assert (recovery.complete, recovery.index_is_new) == (True, cut > 0)
    copy = Recording.read(new)
    assert copy.messages == MESSAGES
    assert copy.attachments == recording.attachments
    assert recording.metadata.items() <= copy.metadata.items()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (bytes(100), "is empty"),
        (b"\x89MCAP0\r\n\x01" + b"\xff" * 40, "holds no readable message: cut short"),
        (b"#ROSBAG V2.0\n", "is a ROS 1 bag, not an MCAP file"),
        (b"SQLite format 3\0", r"is an SQLite file, not MCAP; .*ros2 bag convert"),
        (b"PK\x03\x04 and so on", "is not an MCAP file"),
        (
            WHOLE.replace(b"\x04\0\0\0zstd", b"\x04\0\0\0snap"),
            "holds no readable message: its chunks are compressed by 'snap'; .*: mcap compress",
        ),
    ],
)
def test_a_file_of_another_kind_is_named(path, data, reason):
    path.write_bytes(data)
    for read in (Recording.read, lambda path: recover(path, path.with_name("new.mcap"))):
        with pytest.raises(BadInputError, match=rf"^[^\n]*x\.mcap: {reason}[^\n]*$"):
            read(path)
    assert not path.with_name("new.mcap").exists(), "no file without messages is written"


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
    ids=["lz4", "plain", "no-chunks", "no-crc", "no-summary", "shuffled"],
)
def test_an_unusual_layout_is_read(whole, path, options):
    rewrite(whole, path, **options)
    recording = Recording.read(path)
    assert recording.note == ""
    assert_equal(recording, EXPECTED)
    assert (recording.messages, recording.sha256) == (MESSAGES, EXPECTED.sha256)
    assert [remark[:9] for remark in recording.remarks] == ["was not i"] * ("shuffle" in options)
    recovery = recover(path, path.with_name("new.mcap"))
    assert (recovery.complete, recovery.index_is_new, recovery.share) == (True, False, 1.0)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"keep": lambda c, m: c.topic != "/guard"}, "it holds 0 of 1 on /guard$"),
        ({"keep": lambda c, m: m.log_time < 10**9}, r"it holds .*, .*, .* and 7 more topics$"),
        ({"rename": lambda t: f"/r2{t}"}, "it holds 0 of"),
        ({"rename": lambda t: t.replace("/odometry", "/ground_truth")}, "/odometry, 320 of 160 on"),
        ({"metadata": False}, "the metadata of cloudrc, which names the clock, is not there"),
        ({"shuffle": lambda all: all.extend(all[:4])}, "messages were removed or added: it holds "),
    ],
    ids=["topic", "half", "renamed", "joined", "metadata", "doubled"],
)
def test_changes_by_another_program_are_noted(whole, path, options, said):
    recording = Recording.read(rewrite(whole, path, **options))
    assert recording.lacking == recording.note
    assert re.search(said, recording.lacking), recording.lacking
    with suppress(BadInputError):  # no message is of cloudrc
        recover(path, new := path.with_name("new.mcap"))
        assert recording.lacking in Recording.read(new).lacking, "the copy says it, too"


def test_a_torn_file_that_another_program_ended_is_noted(path):
    with path.open("wb") as stream:
        writer = McapWriter(stream, clock="world")
        writer.write(RECORDS)
        writer._mcap.finish()
    assert "another program added an end" in Recording.read(path).lacking


def write_foreign(path, topic, ros_type, text, data, channels=1, **options):
    """Write messages as another program, but with the metadata key `clock` of cloudrc."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile="ros2")
        writer.add_metadata("cloudrc", {"clock": "world"})
        schema = writer.register_schema(ros_type, "ros2msg", text.encode())
        robots = [{"robot": str(n)} for n in range(channels)]
        numbers = [writer.register_channel(topic, "cdr", schema, robot) for robot in robots]
        for each, number in itertools.product(data, numbers):
            writer.add_message(number, 1, each, 1)
        writer.finish()


OURS = "cloudrc_msgs/msg/Arrival"
ARRIVAL = definition(OURS)


@pytest.mark.parametrize(
    ("topic", "name", "text", "channels", "said"),
    [
        ("/uplink_delay", OURS, ARRIVAL.replace("bool used", "int8 used"), 1, "layout"),
        ("/uplink_delay", "cloudrc_msgs/msg/Pid", definition("cloudrc_msgs/msg/Pid"), 1, "layout"),
        ("/uplink_delay", OURS, ARRIVAL, 2, "two robots or two recordings are in one file"),
        ("/camera", OURS, ARRIVAL, 1, ""),
        ("/camera", "", "", 1, ""),
    ],
)
def test_foreign_topics_are_not_read_as_topics_of_cloudrc(path, topic, name, text, channels, said):
    write_foreign(path, topic, name, text, [b"\0\1\0\0\7"], channels)
    recording = Recording.read(path)
    assert said in recording.lacking
    assert bool(said) == bool(recording.note)
    assert bool(recording.remarks) == (not said)
    assert channels == 2 or len(recording["/uplink_delay"]) == 0


def test_an_unreadable_message_gives_one_line(path):
    write_foreign(path, "/uplink_delay", OURS, ARRIVAL, [b"\0\1\0\0\7"])
    with pytest.raises(
        BadInputError, match=r"x\.mcap: a message on /uplink_delay is not readable;"
    ):
        Recording.read(path)["/uplink_delay"]


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize(("size", "count"), [(0, 40_000), (1 << 20, 20)])
@pytest.mark.parametrize("lies", [False, True])
def test_a_bomb_ends_with_one_line(path, monkeypatch, compression, size, count, lies):
    """A small file unpacks to far more: to large messages, or to very many messages."""
    monkeypatch.setattr("cloudrc.record.reader.UNPACKED_MAX", limit := 4)
    options = {"chunk_size": 1 << 27, "compression": compression, "index_types": IndexType.NONE}
    data = (bytes(size) for _ in range(count))
    write_foreign(path, "/odometry", "nav_msgs/msg/Odometry", "", data, **options)
    if lies:  # about the size of the chunk
        data = bytearray(path.read_bytes())
        start = data.index(compression.name.lower().encode()) - 16
        data[start : start + 8] = (1000).to_bytes(8, "little")
        path.write_bytes(data)
    tracemalloc.start()
    try:
        told = Recording.read(path).lacking
    except BadInputError as error:
        told = str(error)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert "\n" not in told
    assert ("unpacks to more than 4 times its size" in told) != lies
    assert peak < 4 * limit << 20


def examine(folder, data):
    """Read and recover a file; check that a result without a note has all content."""
    source, new, found = folder / "f.mcap", folder / "new.mcap", list[Recording]()
    source.write_bytes(data)
    new.unlink(missing_ok=True)
    with suppress(BadInputError):
        found.append(Recording.read(source))
        recovery = recover(source, new)
        assert recovery.share == 1.0 if recovery.complete else recovery.share <= 0.999
        found += [Recording.read(new)] if recovery.complete else []
    for one in found:
        if not one.note:
            assert one.attachments == {"config.yaml": b"seed: 1\n" * 50}
            assert one.messages == MESSAGES


SOME = [start + n for _, start, _ in spans(WHOLE) for n in (0, 1) if start + n < len(WHOLE)][::6]
SOME += range(3, len(WHOLE), 7919)
FOURTHS = [range(part, len(WHOLE), 4) for part in range(4)]


@pytest.mark.parametrize(
    "places",
    [SOME, *(pytest.param(part, marks=pytest.mark.full) for part in FOURTHS)],
    ids=["some", *"1234"],
)
def test_every_cut_and_every_flipped_byte_is_noticed(tmp_path, places):
    for at in places:
        examine(tmp_path, flipped(at, 1 << at % 8))
        examine(tmp_path, WHOLE[:at])


def test_a_recovery_of_a_torn_file_says_what_is_kept_and_lost(path):
    new, middle = path.with_name("new.mcap"), sum(CHUNKS[1]) // 2
    path.write_bytes(WHOLE[:middle])
    assert Recording.read(path).note.startswith(f"cut short: {SIZES[0]} messages were read")
    recovery = recover(path, new)
    assert recovery.kept["messages"] == SIZES[0]
    assert recovery.share == 1 - recovery.bytes_lost / middle
    assert recovery.notes[0].startswith("cut short: ")
    kept = Recording.read(new)
    assert kept.note == "; ".join(recovery.notes)
    assert 40 < len(kept["/odometry"]) < 80
    path.write_bytes(WHOLE + OTHER)
    assert Recording.read(path).lacking == "something follows its end"
    recovery = recover(path, new)
    share = pytest.approx(len(WHOLE) / len(WHOLE + OTHER))
    assert (recovery.bytes_lost, recovery.share) == (len(OTHER), share)


def middle_of(number):
    return sum(CHUNKS[number]) // 2


FIRST, SECOND, THIRD = map(middle_of, range(3))
END = len(WHOLE) - 1
OPCODE, LENGTH, HUGE = (CHUNKS[1][0] + n for n in (0, 2, 7))


@pytest.mark.parametrize(
    ("places", "left_out"),
    [
        ([SECOND], [1]),
        ([FIRST], [0]),
        ([FIRST, THIRD], [0, 2]),
        ([OPCODE], [1]),
        ([LENGTH], [1]),
        ([HUGE], [1]),
        ([LENGTH, THIRD], [1, 2]),
        ([WHOLE.index(b"zstd", SECOND - 9000)], [1]),
        ([END - 100, SECOND], [1]),
        ([END, SECOND], [1]),
    ],
    ids=str,
)
def test_intact_parts_behind_damage_are_recovered(path, places, left_out):
    """A part is left out as a whole, and its messages are counted by topic."""
    data, new = bytearray(WHOLE), path.with_name("new.mcap")
    for at in places:
        data[at] ^= 255
    path.write_bytes(data)
    bounds = list(itertools.accumulate(SIZES, initial=0))
    lost = [message for n in left_out for message in MESSAGES[bounds[n] : bounds[n + 1]]]
    recovery = recover(path, new)
    kept = Recording.read(new)
    assert kept.messages == [message for message in MESSAGES if message not in lost]
    assert recovery.topics == Counter(topic for topic, _, _ in kept.messages)
    assert recovery.kept["messages"] == len(kept.messages)
    assert recovery.kept["topics"] == len(recovery.topics)
    dropped = {topic: number for topic, number in recovery.dropped.items() if number is not None}
    assert dropped == Counter(topic for topic, _, _ in lost)
    assert not recovery.complete
    assert kept.note == "; ".join(recovery.notes)
    assert recovery.share == len(kept.messages) / len(MESSAGES)
    size = sum(CHUNKS[n][1] - CHUNKS[n][0] for n in left_out)
    assert size <= recovery.bytes_lost < 2 * size, "with the lists of messages beside them"
    assert recovery.notes[0].startswith(f"damaged at byte {CHUNKS[left_out[0]][0]}")


BEHIND = CHUNKS[2][1]  # the first byte behind the third chunk
LOST = {
    "cut out": (WHOLE[:SECOND] + WHOLE[SECOND + 3000 :], 1),
    "cut out twice": (WHOLE[:SECOND] + WHOLE[SECOND + 9 : THIRD] + WHOLE[THIRD + 1 :], 2),
    "zeros put in": (WHOLE[:SECOND] + bytes(5000) + WHOLE[SECOND:], 1),
    "as long as before": (
        WHOLE[:SECOND] + WHOLE[SECOND + 99 : THIRD] + bytes(99) + WHOLE[THIRD:],
        2,
    ),
    "a size of 2**63 bytes": (flipped(CHUNKS[1][0] + 9 + 16 + 7), 1),
    "and padded": (WHOLE[:SECOND] + WHOLE[SECOND + 3000 :] + bytes(4096), 1),
}


@pytest.mark.parametrize(("data", "chunks_lost"), LOST.values(), ids=LOST)
def test_a_recovery_goes_on_behind_bytes_that_were_lost_or_inserted(path, data, chunks_lost):
    """All intact chunks behind them are only shifted; the index counts the others' messages."""
    path.write_bytes(data)
    recovery = recover(path, new := path.with_name("new.mcap"))
    lost = sum((Counter(MESSAGES) - Counter(Recording.read(new).messages)).values())
    assert len(MESSAGES) - recovery.kept["messages"] == lost <= chunks_lost * max(SIZES)
    assert lost >= min(SIZES)
    assert sum(recovery.dropped.values()) == lost
    assert not recovery.complete
    last = WHOLE[CHUNKS[3][0] : CHUNKS[3][0] + 50]
    path.write_bytes(data[: data.index(last) + 50])  # without an index, too
    kept = recover(path, new := path.with_name("torn.mcap")).kept["messages"]
    assert kept >= SIZES[0] + (chunks_lost == 1) * SIZES[2]


WHOLE_IN_ALL = {
    "damaged magic": b"\0" + WHOLE[1:],
    "damaged header": WHOLE[:12] + b"\xff" + WHOLE[13:],
    "zeros in front": bytes(512) + WHOLE,
    "padded": WHOLE + bytes(4096),
    "followed by rubbish": WHOLE + b"rubbish" * 99,
    "appended a second time": WHOLE * 2,
    "appended twice, then cut": WHOLE * 2 + WHOLE[:SECOND],
    "its beginning appended": WHOLE + WHOLE[:SECOND],
    "repeated bytes": WHOLE[:THIRD] + WHOLE[CHUNKS[1][0] - 40 :],
    "cut out of a list of messages": WHOLE[: BEHIND + 20] + WHOLE[BEHIND + 90 :],
}


@pytest.mark.parametrize("data", WHOLE_IN_ALL.values(), ids=WHOLE_IN_ALL)
def test_a_file_with_all_that_its_index_counts_is_complete(path, call, data):
    path.write_bytes(data)
    new = path.with_name("x.recovered.mcap")
    assert "left out" in call("recover", path, code=0).out
    copy = Recording.read(new)
    assert (copy.messages, copy.note) == (MESSAGES, "")
    assert copy.attachments == Recording.read(path).attachments


INDEXES = [span for span in spans(WHOLE) if span[0] == Opcode.MESSAGE_INDEX]


@pytest.mark.parametrize("number", [0, 3, -1])
@pytest.mark.parametrize("inside", [0, 1, 9, 11, 15, 22, 23, 30])
def test_a_damaged_index_of_messages_loses_nothing_and_has_a_place(path, call, number, inside):
    """`inside` is the damaged byte: of opcode, length, channel, number of entries, or an entry."""
    _, start, _ = INDEXES[number]
    path.write_bytes(flipped(start + inside, 3))
    new = path.with_name("x.recovered.mcap")
    told = call("recover", path, code=0).out
    assert "kept 100.0%" in told
    assert f"damaged at byte {start}" in told
    copy = Recording.read(new)
    assert (copy.messages, copy.note) == (MESSAGES, "")
    assert copy.attachments == Recording.read(path).attachments


def test_behind_a_damaged_chunk_its_indexes_are_no_damage(path):
    path.write_bytes(flipped(sum(CHUNKS[1]) // 2))
    note = Recording.read(path).note
    assert note.count("byte ") == 1, note
    assert f"byte {CHUNKS[1][0]} " in note


@pytest.mark.parametrize("opcode", [Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.SUMMARY_OFFSET])
@pytest.mark.parametrize("inside", [1, 12, 20, 60])
def test_a_damaged_index_of_the_file_loses_nothing(path, call, opcode, inside):
    """The checksum of all data proves that every message was read."""
    start = next(start for kind, start, _ in spans(WHOLE) if kind == opcode)
    path.write_bytes(flipped(start + inside, 1))
    assert "kept 100.0%" in call("recover", path, code=0).out
    copy = Recording.read(path.with_name("x.recovered.mcap"))
    assert (copy.messages, copy.note) == (MESSAGES, "")


@pytest.mark.parametrize(
    "rest", [OTHER, OTHER[:SECOND], WHOLE + OTHER, OTHER + WHOLE, WHOLE[1000:-1000]]
)
def test_a_second_recording_behind_the_first_is_not_passed_over(path, call, rest):
    path.write_bytes(WHOLE + rest)
    with pytest.raises(BadInputError, match=r"follows its end; .*: cloudrc recover "):
        Recording.read(path).refuse_damaged(path)
    assert "lossy: something follows its end" in call("recover", path, code=1).out


def test_if_nothing_counts_the_lost_messages_each_topic_has_a_question_mark(path, call):
    path.write_bytes(WHOLE[: len(WHOLE) // 2])
    said = call("recover", path, code=1).out
    dropped = recover(path, path.with_name("new.mcap")).dropped
    assert dropped.keys() >= {topic for topic, _, _ in MESSAGES[: SIZES[0]]}
    assert {*dropped.values()} == {None}
    assert "/odometry ?" in said


def test_without_an_index_damaged_chunks_of_a_torn_file_are_left_out(path):
    """Messages whose topic was named in a damaged chunk are counted, too."""
    path.write_bytes(flipped(SECOND)[: CHUNKS[3][0] + 50])
    recovery = recover(path, path.with_name("new.mcap"))
    assert recovery.kept["messages"] == SIZES[0] + SIZES[2]
    path.write_bytes(flipped(FIRST)[: CHUNKS[3][0] + 50])
    with pytest.raises(
        BadInputError, match=r"no readable message: damaged at byte [^\n]*cut short"
    ):
        recover(path, path.with_name("none.mcap"))


def test_messages_of_another_program_are_named_as_dropped(whole, path):
    rewrite(whole, path, rename=lambda topic: topic.replace("/guard", "/camera"))
    assert recover(path, path.with_name("new.mcap")).dropped == {"/camera": 1, "/guard": 1}
    rewrite(whole, path, rename=lambda topic: f"/r2{topic}")
    with pytest.raises(BadInputError, match="has topics that cloudrc does not record: /r2/"):
        recover(path, path.with_name("none.mcap"))


def test_an_attachment_that_was_changed_is_left_out(path):
    path.write_bytes(flipped(WHOLE.index(b"seed: 1")))
    recovery = recover(path, path.with_name("new.mcap"))
    assert (recovery.dropped, recovery.kept["attachments"]) == ({}, 0)
    assert "config.yaml" in recovery.notes[0]


def test_attachments_in_a_damaged_part_are_named(path):
    """The damage begins in front of the attachment, and the index knows its name."""
    start = next(start for code, start, _ in spans(WHOLE) if code == Opcode.ATTACHMENT)
    path.write_bytes(WHOLE[: start - 40] + bytes(80) + WHOLE[start + 40 :])
    assert "attachments lost: config.yaml" in recover(path, path.with_name("new.mcap")).notes[0]


@pytest.mark.parametrize("size", [4, 9, 200, 430])
def test_an_attachment_whose_end_is_zeros_is_lost(path, size):
    """Its checksum is zero then, which means "not computed" in MCAP."""
    end = next(end for code, _, end in spans(WHOLE) if code == Opcode.ATTACHMENT)
    path.write_bytes(WHOLE[: end - size] + bytes(size) + WHOLE[end:])
    recovery = recover(path, new := path.with_name("new.mcap"))
    assert "attachments lost: config.yaml" in recovery.notes[0]
    assert Recording.read(new).attachments == {}


def test_the_last_line_puts_the_copy_in_place_of_a_damaged_file_of_a_run(tmp_path, call):
    """A shell that runs the line leaves the damaged file beside the copy."""
    (run := tmp_path / "a run").mkdir()
    (run / "config.yaml").write_text("")
    data = WHOLE[: CHUNKS[1][1]]
    (run / "world.mcap").write_bytes(data)
    *_, last = call("recover", run / "world.mcap", code=1).out.splitlines()
    moves, _, report = last.partition(": ")[2].rpartition(" && ")
    subprocess.run(["sh", "-c", moves], check=True)
    assert Recording.read(run / "world.mcap").lacking == ""
    assert (run / "world.mcap.damaged").read_bytes() == data
    assert report == f"cloudrc report '{run}'"


def test_a_channel_without_a_definition_is_damaged(path, tmp_path):
    source = write(tmp_path / "w.mcap", world_records(5))
    flat = rewrite(source, path, use_chunking=False).read_bytes()
    at = [start for code, start, _ in spans(flat) if code == Opcode.CHANNEL][3]
    path.write_bytes(flat[:at] + b"\x90" + flat[at + 1 :])
    assert Recording.read(path).lacking.startswith("damaged: ")


def test_a_recording_without_messages_is_not_recovered(path):
    with pytest.raises(BadInputError, match="holds no readable message: none is in it; nothing"):
        recover(write(path, []), new := path.with_name("new.mcap"))
    assert not new.exists()


def test_a_recording_of_a_session_in_flight_is_not_recovered(path, monkeypatch, refused):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(path.parent))
    path.write_bytes(WHOLE[: CHUNKS[0][1] + 100])
    (path.parent / local.JOURNAL_FILE).touch()
    with local.announced(path.parent, ""):
        said = refused("recover", path)
    assert f"{path.parent}: the session has not ended; end it: cloudrc down" in said
    assert sorted(path.parent.glob("*.mcap")) == [path]


def test_the_command_says_what_is_kept_and_lost(path, call, refused):
    new = path.with_name("new.mcap")
    path.write_bytes(WHOLE)
    assert "kept 100.0%" in call("recover", path).out
    path.write_bytes(WHOLE[: CHUNKS[0][1] + 100])
    account = json.loads(call("recover -o json", path, "--to", new, code=1).out)
    assert (account["schemaVersion"], account["complete"]) == (1, False)
    assert 0 < account["bytes_lost"] <= 100
    for target, reason in (
        (new, "already there; name another file with --to"),
        (new / "none", "Not a directory; check the path"),
    ):
        assert f"{target}: {reason}" in refused("recover", path, "-t", target)
