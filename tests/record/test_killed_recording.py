"""A process that is killed loses at most half a second of its recording."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from cloudrc.record.columns import Recording
from cloudrc.record.recover import recover

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
@pytest.mark.parametrize("after", [0.9, 1.3])
def test_sigkill_loses_at_most_half_a_second(tmp_path: Path, after: float) -> None:
    kill_after(tmp_path, after)


@pytest.mark.promise("a-kill-loses-half-a-second")
@pytest.mark.process
@pytest.mark.parametrize("sync", [0.4, 60.0])
def test_so_it_does_while_the_disk_is_slow(tmp_path: Path, sync: float) -> None:
    kill_after(tmp_path, 2.1, sync)


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
    path = tmp_path / "world.mcap"
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
    clean = tmp_path / "clean.mcap"
    recovery = recover(path, clean)
    assert not recovery.complete
    assert "chunks" not in recovery.dropped
    recording = Recording.read(clean)
    assert "cut short" in recording.note
    stamps = recording["/count"]["stamp_ns"]
    lost = (last_ns - stamps[-1]) * 1e-9
    assert lost <= 0.5
    counts = recording["/count"]["total"]
    assert counts.tolist() == list(range(len(counts)))
    return float(lost)
