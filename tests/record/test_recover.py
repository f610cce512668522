"""A recovery keeps all intact data, counts the losses and never passes a wrong byte."""

from __future__ import annotations

import io
import json
import random
from collections.abc import Iterable
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from cloudrc.cli.main import main
from cloudrc.config import document as yaml_text
from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.reader import CHUNK_MAX, RECORD_MAX
from cloudrc.record.recover import recover
from cloudrc.record.writer import McapWriter
from tests.record.conftest import assert_equal, cloud_records, world_records

RECORDS = world_records(160)
NOISE = random.Random(1).randbytes(80_000)


def recording(records: int = 80) -> bytes:
    """Make a complete file of about 100 kB, mostly an incompressible attachment."""
    stream = io.BytesIO()
    writer = McapWriter(stream, clock="world", clock_id="ab")
    writer.write(world_records(records))
    writer.write(cloud_records(8, start_ns=3_000_000_000))
    writer.attach("config.yaml", b"seed: 1\n")
    writer.attach("noise", NOISE)
    writer.close()
    return stream.getvalue()


WHOLE = recording()


def spans(data: bytes) -> list[tuple[int, int, int]]:
    """Yield the opcode, start and end of each record."""
    found, start = [], 8
    while start < len(data) - 8:
        end = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
        found.append((data[start], start, end))
        start = end
    return found


def of(opcode: int) -> tuple[int, int]:
    return next((start, end) for code, start, end in spans(WHOLE) if code == opcode)


def contents(data: bytes) -> list[object]:
    """Return the contents of a file, without its layout and its library's name."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    found: list[object] = []
    for record in StreamReader(io.BytesIO(data), validate_crcs=True).records:
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Message):
            channel = channels[record.channel_id]
            schema = schemas[channel.schema_id]
            what = (schema.name, schema.encoding, schema.data, channel.topic, channel.metadata)
            when = (record.log_time, record.publish_time, record.sequence)
            found.append((*what, channel.message_encoding, *when, record.data))
        elif isinstance(record, Attachment):
            found.append(record)
        elif isinstance(record, Metadata):
            found.append((record.name, record.metadata))
    return sorted(found, key=repr)


def rescue(folder: Path, data: bytes) -> tuple[int, dict[str, object], bytes]:
    """Run the command; return its exit code, its output and the new file."""
    source, target = folder / "f.mcap", folder / "new.mcap"
    target.unlink(missing_ok=True)
    source.write_bytes(data)
    try:
        recovery = recover(source, target)
    except BadInputError:
        assert not target.exists()
        return 2, {}, b""
    account = {"kept": recovery.kept, "dropped": recovery.dropped, "lost": recovery.bytes_lost}
    return (0 if recovery.complete else 1), account, target.read_bytes()


def test_a_whole_file_is_complete_and_stays_what_it_is(tmp_path: Path) -> None:
    code, account, new = rescue(tmp_path, WHOLE)
    assert code == 0
    assert contents(new) == contents(WHOLE)
    assert account["dropped"] == {}
    assert make_reader(io.BytesIO(new)).get_summary() is not None
    assert rescue(tmp_path, new)[0] == 0


def test_a_torn_file_keeps_every_whole_chunk(tmp_path: Path) -> None:
    chunks = [span for span in spans(WHOLE) if span[0] == Opcode.CHUNK]
    _, start, end = chunks[2]
    code, account, new = rescue(tmp_path, WHOLE[: (start + end) // 2])
    assert code == 1
    assert account["lost"] == (start + end) // 2 - start
    assert account["kept"]["chunks"] == 2  # type: ignore[index]
    (tmp_path / "kept.mcap").write_bytes(new)
    kept = Recording.read(tmp_path / "kept.mcap")
    assert "cut short: the file has no end" in kept.note
    assert len(kept["/odometry"]) >= 79


def test_a_lost_index_loses_nothing(tmp_path: Path) -> None:
    for cut in (1, 8, 30):
        code, _, new = rescue(tmp_path, WHOLE[:-cut])
        assert code == 0
        assert contents(new) == contents(WHOLE)


def test_a_damaged_chunk_costs_only_itself_and_is_counted(tmp_path: Path) -> None:
    start, end = of(Opcode.CHUNK)
    data = flipped(WHOLE, (start + end) // 2, 255)
    code, account, new = rescue(tmp_path, data)
    lost = len(contents(WHOLE)) - (len(contents(new)) - 1)  # the new note is one more
    assert code == 1
    assert account["dropped"] == {"chunks": 1, "messages": lost}


def test_a_wrong_length_breaks_the_chain_for_one_record_only(tmp_path: Path) -> None:
    start, _ = of(Opcode.CHUNK)
    code, account, _ = rescue(tmp_path, flipped(WHOLE, start + 6, 64))
    assert code == 1
    assert account["kept"]["attachments"] == 2  # type: ignore[index]
    assert account["kept"]["chunks"] == sum(s[0] == Opcode.CHUNK for s in spans(WHOLE)) - 1  # type: ignore[index]


def test_a_damaged_attachment_is_left_out(tmp_path: Path) -> None:
    _, end = of(Opcode.ATTACHMENT)
    code, account, _ = rescue(tmp_path, flipped(WHOLE, end - 6, 1))
    assert code == 1
    assert account["dropped"] == {"attachments": 1}


def flipped(data: bytes, at: int, by: int) -> bytes:
    return data[:at] + bytes([data[at] ^ by]) + data[at + 1 :]


EXPECTED = contents(WHOLE)


def check_flips(folder: Path, places: Iterable[int]) -> None:
    """Each flip is reported, or the result is unchanged."""
    for at in places:
        code, _, new = rescue(folder, flipped(WHOLE, at, 1 << at % 8))
        assert code or contents(new) == EXPECTED, f"byte {at}"


def test_a_flipped_byte_is_detected_or_harmless(tmp_path: Path) -> None:
    heads = [start + n for _, start, _ in spans(WHOLE) for n in (0, 1, 9)]
    check_flips(tmp_path, [at for at in heads if at < len(WHOLE)])
    check_flips(tmp_path, range(3, len(WHOLE), 2411))


@pytest.mark.full
@pytest.mark.parametrize("part", range(8))
def test_every_flipped_byte_is_detected_or_harmless(tmp_path: Path, part: int) -> None:
    assert 95_000 < len(WHOLE) < 130_000
    check_flips(tmp_path, range(part, len(WHOLE), 8))


def test_lengths_that_lie_take_no_memory(tmp_path: Path) -> None:
    huge = WHOLE[:8] + bytes([Opcode.ATTACHMENT]) + (1 << 62).to_bytes(8, "little") + WHOLE[8:]
    code, account, _ = rescue(tmp_path, huge)
    assert code == 1
    assert account["kept"]["messages"] > 300  # type: ignore[index]
    long = RECORD_MAX + 1
    sparse = tmp_path / "sparse.mcap"
    with sparse.open("wb") as stream:
        stream.write(WHOLE[:8] + bytes([Opcode.METADATA]) + long.to_bytes(8, "little"))
        stream.truncate(long + 100)
    with pytest.raises(BadInputError, match="holds nothing that can be read"):
        recover(sparse, tmp_path / "new.mcap")


def bomb(claimed: int) -> bytes:
    """Make a file with a short chunk that unpacks to far more than it states."""
    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.ZSTD, chunk_size=1 << 40)
    writer.start()
    writer.add_message(writer.register_channel("/t", "cdr", 0), 1, bytes(64 << 20), 1)
    writer.finish()
    data = bytearray(stream.getvalue())
    start = next(start for code, start, _ in spans(bytes(data)) if code == Opcode.CHUNK)
    data[start + 25 : start + 33] = claimed.to_bytes(8, "little")
    return bytes(data)


@pytest.mark.parametrize("claimed", [1000, CHUNK_MAX + 1, 1 << 63])
def test_a_chunk_that_unpacks_to_more_than_it_says_is_left_out(
    tmp_path: Path, claimed: int
) -> None:
    source = tmp_path / "bomb.mcap"
    source.write_bytes(bomb(claimed))
    with pytest.raises(BadInputError):
        recover(source, tmp_path / "new.mcap")


def test_the_command_says_what_is_kept_and_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torn = tmp_path / "world.mcap"
    torn.write_bytes(WHOLE)
    assert main(["recover", str(torn)]) == 0
    assert "kept 100.0%" in capsys.readouterr().out
    torn.write_bytes(WHOLE[: len(WHOLE) // 4])
    new = tmp_path / "new.mcap"
    assert main(["recover", str(torn), "--to", str(new), "-o", "json"]) == 1
    account = json.loads(capsys.readouterr().out)
    assert account["schemaVersion"] == 1
    assert not account["complete"]
    assert account["bytes_lost"] > 0
    assert main(["recover", str(torn), "-t", str(new)]) == 2
    assert "already there; name another file with --to" in capsys.readouterr().err
    assert main(["recover", str(torn), "-t", str(tmp_path / "y.mcap"), "-o", "yaml"]) == 1
    document, _ = yaml_text.parse_yaml(capsys.readouterr().out, "stdout")
    assert document["bytes_lost"] == account["bytes_lost"]
    nowhere = tmp_path / "none" / "n.mcap"
    assert main(["recover", str(torn), "--to", str(nowhere)]) == 2
    assert f"error: {nowhere}: No such file or directory; name" in capsys.readouterr().err
    torn.write_bytes(b"PK not a recording")
    assert main(["recover", str(torn), "--to", str(tmp_path / "n.mcap")]) == 2
    assert "is not an MCAP file" in capsys.readouterr().err
    assert main(["recover", str(tmp_path / "absent.mcap")]) == 2


def test_what_was_recovered_is_what_was_recorded(tmp_path: Path) -> None:
    source, target = tmp_path / "w.mcap", tmp_path / "n.mcap"
    with McapWriter(source, clock="world") as writer:
        writer.write(RECORDS)
    recover(source, target)
    assert_equal(Recording.read(target), Recording.from_records(RECORDS))
