"""Write a process's recording to its file from a background thread.

The thread writes a few records at a time and sleeps in between. Loop and thread share the
interpreter; in this way the thread delays the loop by less than a millisecond. A second thread
waits for the disk. Even if a sync takes seconds, the operating system has the data and keeps it if
the process is killed.

With each flush the thread also checks whether somebody set the wall clock, which the loop never
reads. The check compares the wall clock with the clock since boot. Nobody can set the clock since
boot, and unlike the monotonic clock it continues while the machine sleeps.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from cloudrc.exposition.ends import CLOCK_SET
from cloudrc.records import (
    Arrival,
    CommandApplied,
    Control,
    Fault,
    GroundTruth,
    Lateness,
    Record,
    TelemetrySent,
)

STEP = 0.1
"""Smallest change between two checks that counts as a step of the wall clock [s]."""
DRIFT_MAX = 1e-3
"""Largest relative drift between both clocks [1]; kernels slew by at most half of this value."""
_SINCE_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # the former: Linux


class WallClock:
    """Detects that the wall clock was set."""

    def __init__(self) -> None:
        """Read both clocks for the first time."""
        self._wall, self._boot = _now()

    def step(self) -> float:
        """Return by how much the clock was set since the last call [s]; 0 if it was not set."""
        wall, boot = _now()
        elapsed = boot - self._boot
        step = wall - self._wall - elapsed
        self._wall, self._boot = wall, boot
        return step if abs(step) > STEP + DRIFT_MAX * elapsed else 0.0


def told(step: float, stamp_ns: int) -> Fault:
    """Make the record of a step of the wall clock.

    Args:
        step: Size of the step [s].
        stamp_ns: When the step was detected [ns], own clock of the end.
    """
    text = (
        f"wall clock stepped by {step:+.1f} s: the flight is not affected;"
        " do not compare times of day before and after the step"
    )
    return Fault(stamp_ns, CLOCK_SET, text)


def _now() -> tuple[float, float]:
    """Read the wall clock and the clock since boot [s], without a stall in between."""
    while True:
        before, wall = time.clock_gettime(_SINCE_BOOT), time.time()
        boot = time.clock_gettime(_SINCE_BOOT)
        if boot - before < STEP / 2.0:
            return wall, boot


AFTERWARDS_NS = 90_000_000_000
"""How long all records are still kept after the robot last followed the cloud [ns]. This time
covers the landing after a loss of the link."""
PERIODIC = (Arrival, CommandApplied, Control, GroundTruth, Lateness, TelemetrySent)
"""Types of records that are made all the time, with or without a flight."""
BATCH = 16
"""Number of records written at a time."""
IDLE = 0.1
"""Sleep after the queue was emptied [s]; a wake costs more time than writing a few records."""
BUSY = 0.001
"""Sleep while more records wait [s]."""
FLUSH = 0.25
"""Longest time between two flushes [s]; a killed process loses less than 0.5 s."""


class Recorder(Protocol):
    """The part of a recorder that the thread uses. No method raises."""

    def drain(self, max_records: int = ...) -> int:
        """Write at most `max_records` records; return how many were taken from the queue."""

    def flush(self, *, sync: bool = ...) -> None:
        """Hand the written data to the operating system."""

    def sync(self) -> bool:
        """Sync the flushed data to the disk, which may take seconds; return the success."""

    def close(self) -> None:
        """Write the remaining records and end the file."""


class FlightsOnly:
    """Selects all records during a flight, and only events otherwise.

    A pod outlives its missions: 100 samples a second of an idle robot would fill its volume within
    hours.
    """

    def __init__(self, flies: Callable[[], bool]) -> None:
        """Store `flies`.

        Args:
            flies: Tells whether the robot flies, that is, follows the commands of cloud.
        """
        self._flies = flies
        self._until_ns = 0

    def __call__(self, records: list[Record]) -> list[Record]:
        """Select the records to keep."""
        if not records:
            return records
        stamp_ns = records[-1].stamp_ns
        if self._flies():
            self._until_ns = stamp_ns + AFTERWARDS_NS
        if stamp_ns <= self._until_ns:
            return records
        return [record for record in records if not isinstance(record, PERIODIC)]


class SyncAge:
    """Measures how much of a recording a power cut would destroy [s].

    A power cut destroys all records since the start of the last completed sync.
    """

    def __init__(self) -> None:
        """Create the measurement; no sync has completed yet."""
        self._safe: float | None = None

    def done(self, began: float) -> None:
        """Note that a sync has completed; it started at `began` [s]."""
        self._safe = began

    def read(self, now: float) -> float | None:
        """Return the time at risk at `now` [s]; None before the first completed sync."""
        return None if self._safe is None else now - self._safe


class RecordingThread:
    """Runs a recorder in the background from `start` to `stop`."""

    def __init__(self, recorder: Recorder) -> None:
        """Create the thread; `start` starts it.

        Args:
            recorder: The recorder. The loop adds records; only this thread drains them.
        """
        self._recorder = recorder
        self._stopping = threading.Event()
        # A daemon thread, so that a hanging disk cannot keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._flushed, self._over = threading.Event(), False
        self._age = SyncAge()
        self._wall, self._steps = WallClock(), deque[float]()
        self._syncing = threading.Thread(target=self._sync, name="recording-sync", daemon=True)

    def start(self) -> None:
        """Start both threads."""
        self._thread.start()
        self._syncing.start()

    def sync_age(self) -> float | None:
        """Return how much of the recording is not on disk yet [s]; None before the first sync."""
        return self._age.read(time.monotonic())

    def take_steps(self) -> list[float]:
        """Return the steps of the wall clock since the last call [s]."""
        return [self._steps.popleft() for _ in range(len(self._steps))]

    def stop(self, timeout: float = 1.5) -> bool:
        """Write the remaining records, complete the file, and wait until both are done.

        Args:
            timeout: Longest time to wait [s].

        Returns:
            True if the file was completed in time.
        """
        self._stopping.set()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        recorder, rest = self._recorder, IDLE
        flushed = time.monotonic()
        while not self._stopping.wait(rest):
            rest = BUSY if recorder.drain(BATCH) == BATCH else IDLE
            now = time.monotonic()
            if now - flushed >= FLUSH:
                recorder.flush(sync=False)
                self._flushed.set()
                flushed = now
                if step := self._wall.step():
                    self._steps.append(step)
        recorder.close()
        self._over = True
        self._flushed.set()

    def _sync(self) -> None:
        while True:
            self._flushed.wait()
            self._flushed.clear()
            if self._over:
                return
            began = time.monotonic()
            if self._recorder.sync():
                self._age.done(began)
