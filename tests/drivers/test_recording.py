"""The recorder with its three threads: one puts, one writes, one syncs."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from pathlib import Path

from cloudrc.drivers.recording import RecordingThread
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.records import Record
from tests.record.conftest import Shelf, assert_equal, counted, open_mcap, world_records


class Slow(Shelf):
    """A sink whose third sync hangs until it is released."""

    def __init__(self) -> None:
        super().__init__()
        self.release, self.begun = threading.Event(), threading.Semaphore(0)
        self.began, self.flushed = list[float](), threading.Semaphore(0)

    def flush(self) -> None:
        self.flushed.release()

    def sync(self) -> None:
        self.began.append(time.monotonic())
        self.begun.release()
        if len(self.began) == 3:
            self.release.wait(10.0)


def test_the_thread_writes_everything_before_it_ends(tmp_path: Path) -> None:
    path, records = tmp_path / "world.mcap", world_records(200)
    recorder = Recorder(path, open_mcap)
    thread = RecordingThread(recorder)
    thread.start()
    for record in records:
        recorder.put([record])
    assert thread.stop(timeout=10.0)
    recording = Recording.read(path)
    assert recording.complete
    assert_equal(recording, Recording.from_records(records))


def test_a_hanging_sync_delays_nobody_and_is_told(tmp_path: Path) -> None:
    """The loop goes on, and the operating system gets the data."""
    path, shelf = tmp_path / "w.mcap", Slow()
    path.touch()
    recorder = Recorder(path, lambda path: shelf)
    thread = RecordingThread(recorder)
    assert thread.sync_age() is None
    thread.start()
    for _ in range(3):
        assert shelf.begun.acquire(timeout=5.0)
    ages = [thread.sync_age(), thread.sync_age()]
    assert all(age is not None and age >= shelf.began[2] - shelf.began[1] for age in ages)
    assert ages[0] < ages[1], "it rises while the disk hangs"
    recorder.put(counted(500))
    while shelf.flushed.acquire(blocking=False):
        pass
    for _ in range(2):
        assert shelf.flushed.acquire(timeout=5.0)
    assert thread.stop(timeout=10.0)
    assert (len(shelf.records), recorder.dropped) == (500, 0)
    shelf.release.set()


def test_a_hanging_disk_does_not_keep_the_process() -> None:
    release = threading.Event()

    class Hanging(Shelf):
        def write(self, records: Iterable[Record]) -> None:
            release.wait(10.0)

    recorder = Recorder(Path("x"), lambda path: Hanging(), capacity=5)
    recorder.put(counted(5))
    thread = RecordingThread(recorder)
    thread.start()
    recorder.put(counted(20))
    assert not thread.stop(timeout=0.05)
    assert recorder.dropped >= 15
    release.set()
    assert thread.stop(timeout=10.0)
