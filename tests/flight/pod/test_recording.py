# SPDX-License-Identifier: Apache-2.0

"""The recorder never blocks and survives all disk errors; what a pod records."""

import errno
import io
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from unittest.mock import Mock

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.flight.pod.recording import AFTERWARDS_NS, FlightsOnly, Recorder
from cloudrc.results.record import part_before
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.writer import McapWriter
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import GuardChange, Lateness
from tests.results.record.conftest import MS, Shelf, counted, open_mcap, world_records


class Disk(io.BytesIO):
    """A file on a disk with space for `room` bytes."""

    def __init__(self, room):
        super().__init__()
        self.room = room

    def write(self, data):
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


def record_all(recorder, records, every):
    """Write all records; flush after `every` records."""
    for start in range(0, len(records), every):
        recorder.put(records[start : start + every])
        while recorder._drain():
            pass
        recorder._sync()
        recorder._flush()
    recorder._close()


def test_records_that_a_slow_disk_drops_are_told_and_leave_a_hole(tmp_path, monkeypatch):
    path, records = tmp_path / "world.mcap", world_records(600)
    monkeypatch.setattr("cloudrc.flight.pod.recording.CAPACITY", 200)
    recorder = Recorder(path, open_mcap)
    third = len(records) // 3
    for start in (0, third, 2 * third):
        for record in records[start : start + third]:
            recorder.put([record])
            if start != third:
                recorder._drain()
        recorder._flush()
    recorder._close()
    recording = Recording.read(path)
    assert f"{recorder.dropped} records were dropped" in recording.note
    (hole,) = recording.holes
    stamps_ns = [each.stamp_ns for each in records[third : third + recorder.dropped]]
    assert hole == (stamps_ns[0] - 1, stamps_ns[-1] + 1)


@pytest.mark.promise("a-bad-disk-spares-the-flight")
@pytest.mark.parametrize("room", [0, 1500, 20_000, 52_640])
@pytest.mark.fault(
    29,
    "bad-disk",
    injects="the disk of the recording is full, read-only or slow",
    expects="no flight ends by it; dropped records are counted; the file ends with a whole chunk",
    figures="room for 0 to 52,640 bytes",
)
def test_on_a_full_disk_all_is_kept_or_counted(tmp_path, room):
    path, records = tmp_path / "w.mcap", counted(3000)
    disk = Disk(room)
    recorder = Recorder(path, lambda _: McapWriter(disk, clock="world"))
    record_all(recorder, records, 30)
    path.write_bytes(disk.getvalue())
    assert recorder.error.startswith(f"{path}: recording stopped: disk full; make room or choose")
    kept = 0
    with suppress(BadInputError):
        recording = Recording.read(path)
        kept = len(recording["/count"])
        assert recording.unread == 0, "the file ends with a whole chunk"
        noted = "disk full" in recording.note
        assert noted == (recording.metadata.get("stopped") == "disk_full")
        assert noted or room - path.stat().st_size < 200, "noted, if there is room for a note"
    assert kept + recorder.dropped == len(records)
    assert kept < len(records)


def failing(step, error):
    """Make a sink whose `step` fails."""
    shelf = Shelf()
    setattr(shelf, step, Mock(side_effect=error))
    return shelf


@pytest.mark.promise("a-bad-disk-spares-the-flight")
@pytest.mark.parametrize("step", ["flush", "sync", "close"])
def test_disk_errors_are_reported_and_never_raised(step):
    shelf = failing(step, OSError(errno.EROFS, "Read-only file system"))
    recorder = Recorder(Path("w.mcap"), lambda path: shelf)
    recorder.put(counted(3))
    recorder._drain()
    recorder._sync()
    recorder._flush()
    recorder.put(counted(2))
    recorder._close()
    assert "w.mcap: recording stopped: disk is read-only;" in recorder.error
    assert recorder.dropped == (0 if step == "close" else 2)


def test_a_recording_at_its_size_limit_begins_anew(tmp_path):
    recorder = Recorder(path := tmp_path / "w.mcap", open_mcap, size_max=20_000)
    record_all(recorder, world_records(1000), 100)
    assert (recorder.error, recorder.dropped) == ("", 0)
    parts = [part_before(path), path]
    before, last = map(Recording.read, parts)
    assert sorted(tmp_path.iterdir()) == sorted(parts), "older parts are gone"
    assert 20_000 <= parts[0].stat().st_size < 60_000
    assert (before.note, last.note) == ("", "")
    stamps_ns = [*before["/odometry"]["stamp_ns"], *last["/odometry"]["stamp_ns"]]
    assert stamps_ns == [*range(stamps_ns[0], 10_000 * MS, 10 * MS)]


def test_a_pod_records_flights_whole_and_events_between_them():
    now, kept = 0, {}
    choose = FlightsOnly(lambda: now in (100, 101, 102))
    for now in range(300):
        start_ns = now * 1_000_000_000
        wakes = [Lateness(start_ns + n * 10_000_000, "world", 0.0, 0.0, 0) for n in range(100)]
        event = GuardChange(start_ns + 990_000_000, GuardState.HOLD, "told")
        kept[now] = len(choose([*wakes, event]))
    whole = {index for index, count in kept.items() if count == 101}
    assert whole == set(range(100, 102 + AFTERWARDS_NS // 1_000_000_000 + 1))
    assert {kept[index] for index in kept.keys() - whole} == {1}
    assert choose([]) == []


FLIGHT = """
import sys, time
from pathlib import Path
from cloudrc.flight.pod.recording import Recorder
from cloudrc.results.record.writer import McapWriter
from cloudrc.wire.records import Counted

class Writer(McapWriter):
    def sync(self):
        time.sleep(float(sys.argv[2]))  # the disk is slow
        super().sync()


recorder = Recorder(Path(sys.argv[1]), lambda path: Writer(path, clock="world"))
recorder.start()
start = time.monotonic_ns()
for n in range(10_000):
    now = time.monotonic_ns() - start
    recorder.put([Counted(now, "world", "sent", n)])
    print(now, flush=True)
    time.sleep(0.005)
"""


@pytest.mark.promise("a-kill-loses-half-a-second")
@pytest.mark.process
@pytest.mark.parametrize(("after", "sync"), [(0.9, 0.0), (2.1, 0.4), (2.1, 60.0)])
@pytest.mark.fault(
    30,
    "recorder-killed",
    injects="SIGKILL ends the recorder, also while the disk is slow",
    expects="what was recorded before is read",
    figures="at most .5 s lost",
)
def test_sigkill_loses_at_most_half_a_second(tmp_path, after, sync):
    """`after` is the time of the kill [s], `sync` the duration of one sync to a slow disk [s]."""
    path = tmp_path / "world.mcap"
    command = [sys.executable, "-c", FLIGHT, str(path), str(sync)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        for line in process.stdout:
            last_ns = int(line)
            if last_ns * 1e-9 >= after:
                break
        process.send_signal(signal.SIGKILL)
        rest = process.stdout.read().split()
    last_ns = int(rest[-1]) if rest else last_ns
    recording = Recording.read(path)
    assert "cut short" in recording.note
    counts = recording["/count"]["total"]
    assert counts.tolist() == list(range(len(counts)))
    lost = (last_ns - recording["/count"]["stamp_ns"][-1]) * 1e-9
    assert lost <= 0.5
