"""The recorder with its threads, and what a pod records."""

import threading
import time

from cloudrc.drivers.recording import AFTERWARDS_NS, FlightsOnly, RecordingThread
from cloudrc.messages import GuardState
from cloudrc.record.recorder import Recorder
from cloudrc.records import GuardChange, Lateness
from tests.record.conftest import Shelf, counted


class Slow(Shelf):
    """A sink whose third sync hangs until it is released."""

    def __init__(self):
        super().__init__()
        self.release, self.begun = threading.Event(), threading.Semaphore(0)
        self.began, self.flushed = [], threading.Semaphore(0)

    def flush(self):
        self.flushed.release()

    def sync(self):
        self.began.append(time.monotonic())
        self.begun.release()
        if len(self.began) == 3:
            self.release.wait(10.0)


def test_a_hanging_sync_delays_nobody_and_is_told(tmp_path):
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
    assert shelf.began[2] - shelf.began[1] <= ages[0] < ages[1], "it rises while the disk hangs"
    recorder.put(counted(500))
    while shelf.flushed.acquire(blocking=False):
        pass
    for _ in range(2):
        assert shelf.flushed.acquire(timeout=5.0)
    assert thread.stop(timeout=10.0)
    assert (len(shelf.records), recorder.dropped) == (500, 0)
    shelf.release.set()


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
