"""Write a process's recording to its file from a background thread.

The thread writes a few records at a time and sleeps in between; thus it delays the control loop by
less than a millisecond. A second thread syncs the file to the disk, which may take seconds. If the
process is killed meanwhile, the operating system still writes the data to the disk.
"""

from __future__ import annotations

import threading
import time
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

AFTERWARDS_NS = 90_000_000_000
"""Time for which all records are still kept after the robot has stopped following cloud [ns]; a
landing after a loss of the link takes less."""
PERIODIC = (Arrival, CommandApplied, Control, GroundTruth, Lateness, TelemetrySent)
"""Types of records that world and cloud make all the time, even between flights."""
BATCH = 16
"""Largest number of records that the thread writes without a sleep."""
IDLE = 0.1
"""Sleep of the thread after it has written all records [s]."""
BUSY = 0.001
"""Sleep of the thread while more records wait [s]."""
FLUSH = 0.25
"""Shortest time between two flushes [s]. A killed process loses records of less than 0.5 s."""


class FlightsOnly:
    """Keeps all records during a flight, and only events between flights.

    All records of an idle robot would fill a pod's volume within hours.
    """

    def __init__(self, flies: Callable[[], bool]) -> None:
        """Set the function that tells whether the robot follows the commands of cloud."""
        self._flies, self._until_ns = flies, 0

    def __call__(self, records: list[Record]) -> list[Record]:
        """Return the records to keep: all of a flight; between flights, only events."""
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
        self._recorder = recorder
        self._stopping, self._flushed, self._over = threading.Event(), threading.Event(), False
        # Daemon threads: the process can end even if the disk hangs.
        self._writing = threading.Thread(target=self._write, name="recording", daemon=True)
        self._syncing = threading.Thread(target=self._sync, name="recording-sync", daemon=True)
        self._safe_since: float | None = None

    def start(self) -> None:
        """Start the threads that write the file and sync it to the disk."""
        for thread in (self._writing, self._syncing):
            thread.start()

    def sync_age(self) -> float | None:
        """Return the time since the last sync to disk began [s]; None before the first sync."""
        return None if self._safe_since is None else time.monotonic() - self._safe_since

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
                recorder.flush()
                self._flushed.set()
                flushed = time.monotonic()
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
