"""Write a process's recording to its file from a background thread.

The thread writes a few records at a time and sleeps in between, so it delays the loop by less than
a millisecond. A second thread waits for the disk. Even if a sync takes seconds, the operating
system has the data and keeps it if the process is killed.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.records import (
    Arrival,
    CommandApplied,
    Control,
    GroundTruth,
    Lateness,
    Record,
    TelemetrySent,
)

if TYPE_CHECKING:
    from cloudrc.record.recorder import Recorder

STEP = 0.1
"""Smallest change between two checks that counts as a step of the wall clock [s]."""
DRIFT_MAX = 1e-3
"""Largest relative drift between both clocks; kernels slew by at most half of this value."""
AFTERWARDS_NS = 90_000_000_000
"""How long all records are still kept after the robot last followed the cloud [ns]. This time
covers the landing after a loss of the link."""
PERIODIC = (Arrival, CommandApplied, Control, GroundTruth, Lateness, TelemetrySent)
"""Types of records that are made all the time, with or without a flight."""
BATCH = 16
"""Largest number of records that are written without a pause."""
IDLE = 0.1
"""Sleep after the queue was emptied [s]; a wake costs more time than writing a few records."""
BUSY = 0.001
"""Sleep while more records wait [s]."""
FLUSH = 0.25
"""Longest time between two flushes [s]; a killed process loses less than 0.5 s."""
_SINCE_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # the former: Linux


class WallClock:
    """Detects when the wall clock was set: the clock since boot, which nobody can set, differs."""

    def __init__(self) -> None:
        """Read both clocks for the first time."""
        self._wall, self._boot = _read_clocks()

    def step(self) -> float:
        """Return by how much the clock was set since the last call [s]; 0 if it was not set."""
        wall, boot = _read_clocks()
        elapsed = boot - self._boot
        step = wall - self._wall - elapsed
        self._wall, self._boot = wall, boot
        return step if abs(step) > STEP + DRIFT_MAX * elapsed else 0.0


def _read_clocks() -> tuple[float, float]:
    """Read the wall clock and the clock since boot [s], without a stall in between."""
    while True:
        before, wall = time.clock_gettime(_SINCE_BOOT), time.time()
        boot = time.clock_gettime(_SINCE_BOOT)
        if boot - before < STEP / 2.0:
            return wall, boot


class FlightsOnly:
    """Selects all records during a flight, and only events otherwise.

    Between missions, the samples of an idle robot would fill a pod's volume within hours.
    """

    def __init__(self, flies: Callable[[], bool]) -> None:
        """Store the function that tells whether the robot follows the commands of cloud."""
        self._flies, self._until_ns = flies, 0

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


class RecordingThread:
    """Runs a recorder in the background from `start` to `stop`."""

    def __init__(self, recorder: Recorder) -> None:
        """Store the recorder. The loop puts records in, and only this class takes them out."""
        self._recorder = recorder
        self._stopping, self._flushed, self._over = threading.Event(), threading.Event(), False
        # Daemon threads, so that a hanging disk cannot keep the process from ending.
        self._writing = threading.Thread(target=self._write, name="recording", daemon=True)
        self._syncing = threading.Thread(target=self._sync, name="recording-sync", daemon=True)
        self._safe_since: float | None = None
        self._wall, self._steps = WallClock(), deque[float]()

    def start(self) -> None:
        """Start to write the recording to its file, and to sync the file to the disk."""
        for thread in (self._writing, self._syncing):
            thread.start()

    def sync_age(self) -> float | None:
        """Return how much of the recording a power cut would destroy [s]; None before any sync."""
        return None if self._safe_since is None else time.monotonic() - self._safe_since

    def take_steps(self) -> list[float]:
        """Return the steps of the wall clock since the last call [s]."""
        return [self._steps.popleft() for _ in range(len(self._steps))]

    def stop(self, timeout: float = 1.5) -> bool:
        """Complete the file; return whether this took at most `timeout` [s]."""
        self._stopping.set()
        self._writing.join(timeout)
        return not self._writing.is_alive()

    def _write(self) -> None:
        recorder, rest, flushed = self._recorder, IDLE, time.monotonic()
        while not self._stopping.wait(rest):
            rest = BUSY if recorder.drain(BATCH) == BATCH else IDLE
            if time.monotonic() - flushed >= FLUSH:
                recorder.flush(sync=False)
                self._flushed.set()
                flushed = time.monotonic()
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
                self._safe_since = began
