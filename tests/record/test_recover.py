"""A recovery keeps all up to the first damaged part, and never calls a lossy file whole."""

from __future__ import annotations

import io
import json
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType

from cloudrc.cli.main import main
from cloudrc.config import document as yaml_text
from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.record.recover import recover
from cloudrc.record.writer import MISSING, McapWriter
from tests.record.conftest import MS, cloud_records, open_mcap, rewrite, world_records, write


def recording() -> bytes:
    """Make a complete file of both ends with an attachment."""
    stream = io.BytesIO()
    writer = McapWriter(stream, clock="world", clock_id="ab")
    writer.write(world_records(80))
    writer.write(cloud_records(8, start_ns=3_000_000_000))
    writer.attach("config.yaml", b"seed: 1\n" * 50)
    writer.close()
    return stream.getvalue()


WHOLE = recording()


def spans(data: bytes) -> list[tuple[int, int, int]]:
    """Return the opcode, start and end of each record."""
    found, start = [], 8
    while start < len(data) - 8:
        end = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
        found.append((data[start], start, end))
        start = end
    return found


CHUNKS = [(start, end) for opcode, start, end in spans(WHOLE) if opcode == Opcode.CHUNK]


def contents(data: bytes) -> list[object]:
    """Return the contents of a file, without its layout and its library's name."""
    reader = make_reader(io.BytesIO(data), validate_crcs=True)
    found: list[object] = [*reader.iter_attachments(), *reader.iter_metadata()]
    for schema, channel, message in reader.iter_messages():
        assert schema is not None
        what = (schema.name, schema.data, channel.topic, channel.message_encoding)
        found.append((*what, channel.metadata, message.sequence, message))
    return sorted(re.sub("(channel_)?id=[0-9]+", "", repr(each)) for each in found)


def rescue(folder: Path, data: bytes) -> tuple[int, bytes]:
    """Recover; return the exit code that the command would have, and the new file."""
    source, target = folder / "f.mcap", folder / "new.mcap"
    target.unlink(missing_ok=True)
    source.write_bytes(data)
    try:
        recovery = recover(source, target)
    except BadInputError:
        assert not target.exists()
        return 2, b""
    assert recovery.share == 1.0 if recovery.complete else recovery.share <= 0.999
    return (0 if recovery.complete else 1), target.read_bytes()


def test_a_whole_file_stays_what_it_is(tmp_path: Path) -> None:
    code, new = rescue(tmp_path, WHOLE)
    assert (code, contents(new)) == (0, contents(WHOLE))
    assert make_reader(io.BytesIO(new)).get_summary() is not None
    for cut in (1, 8, 30):  # a lost index loses nothing
        code, new = rescue(tmp_path, WHOLE[:-cut])
        assert (code, contents(new)) == (0, contents(WHOLE))


@pytest.mark.parametrize("layout", [{"compression": CompressionType.LZ4}, {"use_chunking": False}])
def test_an_unusual_file_is_complete(tmp_path: Path, layout: dict[str, Any]) -> None:
    path = tmp_path / "w.mcap"
    path.write_bytes(WHOLE)
    other = rewrite(path, tmp_path / "other.mcap", **layout)
    recovery = recover(other, tmp_path / "new.mcap")
    assert (recovery.complete, recovery.index_is_new, recovery.share) == (True, False, 1.0)


def test_all_before_the_first_damage_is_kept(tmp_path: Path) -> None:
    start, end = CHUNKS[1]
    middle = (start + end) // 2
    for data, said in (
        (WHOLE[:middle], "cut short"),
        (WHOLE[:middle] + bytes([WHOLE[middle] ^ 255]) + WHOLE[middle + 1 :], "damaged"),
    ):
        source, target = tmp_path / "f.mcap", tmp_path / "new.mcap"
        source.write_bytes(data)
        recovery = recover(source, target)
        assert recovery.kept["chunks"] == 1
        assert recovery.share == 1 - recovery.bytes_lost / len(data)
        assert recovery.notes[0].startswith(f"{said}: ")
        kept = Recording.read(target)
        assert kept.note == "; ".join(recovery.notes)
        assert 40 < len(kept["/odometry"]) < 80
        target.unlink()


def check_flips(folder: Path, places: Iterable[int]) -> None:
    """Each flip is reported, or the result is unchanged."""
    expected = contents(WHOLE)
    for at in places:
        flipped = WHOLE[:at] + bytes([WHOLE[at] ^ 1 << at % 8]) + WHOLE[at + 1 :]
        code, new = rescue(folder, flipped)
        assert code or contents(new) == expected, f"byte {at}"


def test_a_flipped_byte_is_detected_or_harmless(tmp_path: Path) -> None:
    heads = [start + n for _, start, _ in spans(WHOLE) for n in (0, 1)]
    check_flips(tmp_path, [at for at in heads if at < len(WHOLE)])
    check_flips(tmp_path, range(3, len(WHOLE), 2411))


@pytest.mark.full
@pytest.mark.parametrize("part", range(4))
def test_every_flipped_byte_is_detected_or_harmless(tmp_path: Path, part: int) -> None:
    check_flips(tmp_path, range(part, len(WHOLE), 4))


def test_a_second_recording_behind_the_first_is_told(tmp_path: Path) -> None:
    path = tmp_path / "w.mcap"
    path.write_bytes(WHOLE * 2)
    recovery = recover(path, tmp_path / "new.mcap")
    assert recovery.bytes_lost == len(WHOLE)
    assert recovery.share == pytest.approx(0.5)


@pytest.mark.parametrize(
    "data",
    [WHOLE[: CHUNKS[0][1] - 1], WHOLE[:300], b"PK not a recording", b"", bytes(1000)],
)
def test_a_file_without_anything_in_it_is_never_offered(tmp_path: Path, data: bytes) -> None:
    assert rescue(tmp_path, data) == (2, b"")


def test_an_empty_recording_is_not_offered(tmp_path: Path) -> None:
    data = write(tmp_path / "empty.mcap", []).read_bytes()
    assert rescue(tmp_path, data) == (2, b"")


def test_the_command_says_what_is_kept_and_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torn, new = tmp_path / "world.mcap", tmp_path / "new.mcap"
    torn.write_bytes(WHOLE)
    assert main(["recover", str(torn)]) == 0
    assert "kept 100.0%" in capsys.readouterr().out
    torn.write_bytes(WHOLE[: CHUNKS[0][1] + 100])
    assert main(["recover", str(torn), "--to", str(new), "-o", "json"]) == 1
    account = json.loads(capsys.readouterr().out)
    assert (account["schemaVersion"], account["complete"]) == (1, False)
    assert 0 < account["bytes_lost"] <= 100
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


def test_what_a_recording_says_it_lacks_is_lossy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The recording reached its size limit; its name for that cannot steer a terminal."""
    path, new = tmp_path / "w.mcap", tmp_path / "new.mcap"
    recorder = Recorder(path, open_mcap, size_max=50_000)
    for start in range(0, 20_000, 500):
        recorder.put(world_records(50, start * MS))
        while recorder.drain():
            pass
        recorder.flush(sync=False)
    recorder.close()
    said = "recording stopped: the file has reached its size limit"
    assert main(["recover", str(path), "--to", str(new)]) == 1
    out = capsys.readouterr().out
    assert out.startswith("kept 99.9%: ")
    assert f"lossy: {said}\n" in out
    assert Recording.read(new).note == Recording.read(path).note == said
    path.write_bytes(path.read_bytes()[:-50])
    new.unlink()
    assert recover(path, new).notes[0] == said
    with McapWriter(path, clock="world") as writer:
        writer.write(world_records(5))
        writer.note({MISSING: "\x1b[2J all"})
    new.unlink()
    assert main(["recover", str(path), "--to", str(new)]) == 1
    assert "lossy: \\x1b[2J all\n" in capsys.readouterr().out


def test_more_channels_than_a_file_can_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cloudrc.record.recover.CHANNELS_MAX", 5)
    with pytest.raises(BadInputError, match="defines more than 5 channels and schemas"):
        recover(write(tmp_path / "w.mcap", world_records(5)), tmp_path / "new.mcap")


def test_messages_without_a_channel_are_counted(tmp_path: Path) -> None:
    path = write(tmp_path / "w.mcap", world_records(5))
    flat = rewrite(path, tmp_path / "flat.mcap", use_chunking=False).read_bytes()
    homeless = next(start for code, start, _ in spans(flat) if code == Opcode.CHANNEL)
    path.write_bytes(flat[:homeless] + b"\x90" + flat[homeless + 1 :])  # an unknown record
    recovery = recover(path, tmp_path / "new.mcap")
    assert recovery.dropped["messages"] > 0
    assert f"{recovery.dropped['messages']} messages are lost" in recovery.notes


FLIGHT = """
import sys, time
from pathlib import Path
from cloudrc.drivers.recording import RecordingThread
from cloudrc.record.recorder import Recorder
from cloudrc.record.writer import McapWriter
from cloudrc.records import Counted

class Writer(McapWriter):
    def sync(self):
        time.sleep(float(sys.argv[2]))  # the disk is slow
        super().sync()


recorder = Recorder(Path(sys.argv[1]), lambda path: Writer(path, clock="world"))
RecordingThread(recorder).start()
start = time.monotonic_ns()
for n in range(10_000):
    now = time.monotonic_ns() - start
    recorder.put([Counted(now, "world", "sent", n)])
    print(now, flush=True)
    time.sleep(0.005)
"""


@pytest.mark.promise("a-kill-loses-half-a-second")
@pytest.mark.process
@pytest.mark.parametrize(("after", "sync"), [(0.9, 0.0), (1.3, 0.0), (2.1, 0.4), (2.1, 60.0)])
def test_sigkill_loses_at_most_half_a_second(tmp_path: Path, after: float, sync: float) -> None:
    """Even if the disk is slow: `sync` is how long it takes [s]."""
    kill_after(tmp_path, after, sync)


@pytest.mark.process
@pytest.mark.full
@pytest.mark.parametrize("part", range(10))
def test_sigkill_at_50_instants_loses_at_most_half_a_second(
    tmp_path: Path, part: int, figure: Callable[..., None]
) -> None:
    losses = []
    for n in range(5):
        folder = tmp_path / f"{n}"
        folder.mkdir()
        losses.append(kill_after(folder, 0.6 + 0.031 * (5 * part + n)))
    figure("recorder killed by SIGKILL: recording lost", max(losses), "<=", 0.5, "s", 5)


def kill_after(tmp_path: Path, after: float, sync: float = 0.0) -> float:
    path, clean = tmp_path / "world.mcap", tmp_path / "clean.mcap"
    command = [sys.executable, "-c", FLIGHT, str(path), str(sync)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            last_ns = int(line)
            if last_ns * 1e-9 >= after:
                break
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().split()
    last_ns = int(rest[-1]) if rest else last_ns
    assert not recover(path, clean).complete
    recording = Recording.read(clean)
    assert "cut short" in recording.note
    lost = (last_ns - recording["/count"]["stamp_ns"][-1]) * 1e-9
    assert lost <= 0.5
    counts = recording["/count"]["total"]
    assert counts.tolist() == list(range(len(counts)))
    return float(lost)
