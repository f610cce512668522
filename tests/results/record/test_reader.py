# SPDX-License-Identifier: Apache-2.0

"""A file is read or copied up to its end or first damage; other kinds of files are named."""

import io
import json
import re
from contextlib import suppress
from pathlib import Path
from random import Random

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType

from cloudrc.base.errors import BadInputError
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.holes import END_NS, SOMEWHERE, Hole
from cloudrc.results.record.writer import McapWriter
from tests.results.record.conftest import assert_equal, copied, rewrite, world_records

RECORDS = world_records(160)


def recorded(records):
    stream = io.BytesIO()
    with McapWriter(stream, clock="world") as writer:
        writer.write(records)
        writer.attach("config.yaml", b"seed: 1\n" * 50)
    return stream.getvalue()


WHOLE, EXPECTED = recorded(RECORDS), Recording.from_records(RECORDS)
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


FIRST, SECOND, THIRD = (sum(CHUNKS[number]) // 2 for number in range(3))


def flipped(at, mask=255):
    return WHOLE[:at] + bytes([WHOLE[at] ^ mask]) + WHOLE[at + 1 :]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "x.mcap"


@pytest.fixture
def whole(tmp_path):
    (tmp_path / "whole.mcap").write_bytes(WHOLE)
    return tmp_path / "whole.mcap"


@pytest.mark.parametrize("cut", [0, 8])
def test_a_lost_index_loses_nothing(path, cut):
    path.write_bytes(WHOLE[: len(WHOLE) - cut])
    recording = Recording.read(path)
    assert recording.note == ""
    assert [remark[:18] for remark in recording.remarks] == ["had no whole index"] * (cut > 0)
    copy = copied(path)
    assert (copy.messages, copy.remarks) == (MESSAGES, ())
    assert copy.attachments == recording.attachments
    assert recording.metadata.items() <= copy.metadata.items()


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (WHOLE[:5], "is empty"),
        (WHOLE[:8] + b"\xff" * 40, "holds no readable message: cut short"),
        (flipped(FIRST), r"holds no readable message: damaged at byte \d+"),
        (b"SQLite format 3\0", r"is an SQLite file, not MCAP; .*ros2 bag convert"),
    ],
)
def test_a_file_without_a_message_is_named(path, refused, data, reason):
    path.write_bytes(data)
    with pytest.raises(BadInputError, match=rf"^[^\n]*x\.mcap: {reason}[^\n]*$"):
        Recording.read(path)
    assert re.search(reason, refused("report --recover", path))
    assert not path.with_name("x.recovered.mcap").exists()


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.LZ4, "enable_crcs": False},
        {"use_chunking": False, "use_statistics": False},
        {"shuffle": lambda messages: Random(1).shuffle(messages)},
    ],
    ids=["lz4", "no-chunks", "shuffled"],
)
def test_an_unusual_layout_is_read(whole, path, options):
    rewrite(whole, path, **options)
    recording = Recording.read(path)
    assert recording.note == ""
    assert_equal(recording, EXPECTED)
    assert (recording.messages, recording.sha256) == (MESSAGES, EXPECTED.sha256)
    assert [remark[:9] for remark in recording.remarks] == ["was not i"] * ("shuffle" in options)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"keep": lambda c, m: c.topic != "/guard"}, "it holds 0 of 1 on /guard$"),
        ({"rename": lambda t: t.replace("/odometry", "/ground_truth")}, "/odometry, 320 of 160 on"),
        ({"metadata": False}, "the metadata of cloudrc, which names the clock, is not there$"),
    ],
    ids=["topic", "joined", "metadata"],
)
def test_changes_by_another_program_are_noted(whole, path, options, said):
    recording = Recording.read(rewrite(whole, path, **options))
    assert re.search(said, recording.note), recording.note
    assert recording.holes == (SOMEWHERE,)
    assert (copied(path).note, copied(path).holes) == (recording.note, (SOMEWHERE,))


SOME = [start for _, start, _ in spans(WHOLE)][::6]
EVERYWHERE = pytest.mark.parametrize(
    "places",
    [[*SOME, *range(3, len(WHOLE), 7919)], pytest.param(range(len(WHOLE)), marks=pytest.mark.full)],
    ids=["some", "all"],
)


@EVERYWHERE
def test_a_file_that_is_cut_anywhere_is_read_up_to_its_last_whole_chunk(path, places):
    for at in places:
        path.write_bytes(WHOLE[:at])
        count = sum(size for size, (_, end) in zip(SIZES, CHUNKS, strict=True) if end <= at)
        if not count:
            with pytest.raises(BadInputError):
                Recording.read(path)
            continue
        recording = Recording.read(path)
        assert recording.messages == MESSAGES[:count]
        assert recording.note.startswith("cut short: ") or count == len(MESSAGES)


@EVERYWHERE
def test_every_flipped_byte_is_noticed(path, places):
    for at in places:
        path.write_bytes(flipped(at, 1 << at % 8))
        with suppress(BadInputError):
            recording = Recording.read(path)
            if not recording.note:
                assert recording.attachments == {"config.yaml": b"seed: 1\n" * 50}
                assert recording.messages == MESSAGES


def test_a_torn_file_says_what_was_read(path):
    path.write_bytes(WHOLE[:SECOND])
    recording = Recording.read(path)
    last_ns = MESSAGES[SIZES[0] - 1][1]
    said = f"cut short: {SIZES[0]} messages were read, the last at {last_ns * 1e-9:.2f} s"
    assert (recording.note, recording.holes) == (said, (Hole(last_ns, END_NS),))
    assert recording.unread == SECOND - CHUNKS[1][0]
    copy = copied(path)
    assert (copy.note, copy.lacking, copy.holes) == (said, "", recording.holes)
    assert 40 < len(copy["/odometry"]) < 80


@pytest.mark.parametrize(
    "data",
    [flipped(THIRD), flipped(CHUNKS[2][0] + 7), WHOLE[:THIRD] + WHOLE[THIRD + 300 :]],
    ids=["flipped", "huge length", "cut out"],
)
def test_a_file_is_read_up_to_its_first_damage(path, data):
    path.write_bytes(data)
    recording = Recording.read(path)
    count = sum(SIZES[:2])
    assert recording.messages == MESSAGES[:count]
    assert recording.holes == (Hole(MESSAGES[count - 1][1], END_NS),)
    found = re.match(r"(damaged at byte (\d+)|cut short): \d+ messages were read", recording.note)
    assert found[2] is None or CHUNKS[1][1] <= int(found[2]) <= CHUNKS[2][0]
    assert recording.note.endswith("mcap recover") == (found[2] is not None)


def test_the_command_says_what_is_copied_and_missing(path, call, refused):
    new = path.with_name("new.mcap")
    path.write_bytes(WHOLE)
    assert f"kept {len(MESSAGES)} messages, 1 attachments" in call("report --recover", path).out
    path.write_bytes(WHOLE[: CHUNKS[0][1] + 100])
    to = path.with_name("a.mcap")
    assert "missing: cut short: " in call("report --recover", path, "-t", to).out
    found = json.loads(call("report --recover -o json", path, "--to", new).out)
    (account,) = found["recordings"]
    assert (found["schemaVersion"], account["complete"]) == (1, False)
    assert account["kept"]["messages"] == sum(account["topics"].values()) == SIZES[0]
    assert 0 < account["bytes_lost"] <= 100
    assert account["notes"] == [Recording.read(new).note]
    for target, reason in (
        (new, "already there; name another file with --to"),
        (new / "none", "Not a directory"),
    ):
        assert f"{target}: {reason}" in refused("report --recover", path, "-t", target)


def test_of_a_run_its_recording_is_copied_or_those_of_both_ends(tmp_path, as_json, refused):
    run = tmp_path / "run"
    run.mkdir()
    assert "name the folder of a run" in refused("report --recover", run)
    ends = [run / "world.mcap", run / "cloud.mcap"]
    for end in ends:
        end.write_bytes(WHOLE)
    assert "--to: names one file" in refused("report --recover --to new.mcap", run)

    def copies():
        found = as_json("report --recover", run)["recordings"]
        return [Path(each["file"]).name for each in found]

    assert copies() == ["world.recovered.mcap", "cloud.recovered.mcap"]
    (run / "mission.mcap").write_bytes(WHOLE)
    assert copies() == ["mission.recovered.mcap"]
    assert "is the file of --recover" in refused("report --to new.mcap", run)
