"""The recorder with its three threads: one puts, one writes, one syncs."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Iterable
from pathlib import Path

import pytest

from cloudrc.drivers.recording import RecordingThread
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.records import Record
from tests.record.conftest import Shelf, assert_equal, counted, open_mcap, world_records


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


def test_an_fsync_that_takes_long_keeps_nobody_waiting() -> None:
    syncing, release = threading.Event(), threading.Event()

    class Slow(Shelf):
        def sync(self) -> None:
            syncing.set()
            release.wait(10.0)

    shelf = Slow()
    recorder = Recorder(Path("x"), lambda path: shelf)
    recorder.put(counted(1))
    recorder.drain()
    flushing = threading.Thread(target=recorder.flush)
    flushing.start()
    assert syncing.wait(10.0)
    for record in counted(500):  # five seconds of a loop at 100 Hz
        recorder.put([record])
    assert recorder.dropped == 0
    release.set()
    flushing.join(10.0)
    recorder.close()
    assert len(shelf.records) == 501


def test_a_hanging_sync_keeps_no_data_from_the_operating_system() -> None:
    release, flushed = threading.Event(), threading.Semaphore(0)

    class Slow(Shelf):
        def flush(self) -> None:
            flushed.release()

        def sync(self) -> None:
            release.wait(10.0)

    shelf = Slow()
    recorder = Recorder(Path("x"), lambda path: shelf)
    thread = RecordingThread(recorder)
    thread.start()
    recorder.put(counted(3))
    for _ in range(3):
        assert flushed.acquire(timeout=5.0)
    assert len(shelf.records) == 3
    assert thread.stop(timeout=5.0)
    release.set()


def test_what_a_power_cut_would_take_is_told(tmp_path: Path) -> None:
    """The disk does two syncs and hangs in the third."""
    begun, release, began = threading.Semaphore(0), threading.Event(), list[float]()

    class Hanging(Shelf):
        def sync(self) -> None:
            began.append(time.monotonic())
            begun.release()
            if len(began) == 3:
                release.wait(10.0)

    path = tmp_path / "w.mcap"
    path.touch()
    thread = RecordingThread(Recorder(path, lambda path: Hanging()))
    assert thread.sync_age() is None
    thread.start()
    for _ in range(3):
        assert begun.acquire(timeout=5.0)
    ages = [thread.sync_age(), thread.sync_age()]
    assert all(age is not None and age >= began[2] - began[1] for age in ages)
    assert ages[0] < ages[1], "it rises while the disk hangs"
    release.set()
    assert thread.stop(timeout=5.0)


@pytest.mark.parametrize("name", ["gone.mcap", "refused.mcap"])
def test_what_is_in_no_file_is_never_safe(tmp_path: Path, name: str) -> None:
    class Refusing(Shelf):
        def sync(self) -> None:
            raise OSError(errno.EIO, "Input/output error")

    (tmp_path / "refused.mcap").touch()
    sink = Refusing() if name == "refused.mcap" else Shelf()
    recorder = Recorder(tmp_path / name, lambda path: sink)
    recorder.put(counted(1))
    recorder.drain()
    assert not recorder.sync()
    (tmp_path / name).touch()
    assert recorder.sync() is (name == "gone.mcap")


def test_an_error_of_a_background_sync_stops_the_recording() -> None:
    class Refusing(Shelf):
        def sync(self) -> None:
            raise OSError(errno.EIO, "Input/output error")

    shelf = Refusing()
    recorder = Recorder(Path("w.mcap"), lambda path: shelf)
    recorder.put(counted(1))
    recorder.drain()
    recorder.sync()
    assert not shelf.closed
    recorder.flush(sync=False)
    assert shelf.closed
    assert "w.mcap: recording stopped: Input/output error" in recorder.error


def test_a_sync_of_a_file_that_was_closed_meanwhile_is_nothing(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "w.mcap", open_mcap)
    recorder.put(counted(1))
    recorder.drain()
    assert recorder._sink is not None
    recorder._sink.close()
    recorder.sync()
    assert recorder.error == ""


def test_a_disk_that_hangs_does_not_keep_the_process() -> None:
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
