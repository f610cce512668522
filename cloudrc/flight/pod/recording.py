# SPDX-License-Identifier: Apache-2.0

"""Record the flight of a real-time process without delaying its control loop.

The loop puts records into a queue of limited length. A thread writes a few records at a time to the
file and sleeps in between; thus it delays the loop by less than a millisecond. A second thread
syncs the file to the disk, which may take seconds. If the process is killed meanwhile, the
operating system still writes the data to the disk.
"""

from __future__ import annotations

import errno
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.errors import DISK_FULL
from cloudrc.results.record import part_before
from cloudrc.results.record.holes import Hole
from cloudrc.wire.records import (
    Arrival,
    CommandApplied,
    Control,
    GroundTruth,
    Lateness,
    Left,
    Record,
    TelemetrySent,
)

if TYPE_CHECKING:
    from cloudrc.results.record.writer import McapWriter

AFTERWARDS_NS = 90_000_000_000
"""Time for which all records are still kept after the robot has stopped following cloud [ns]; a
landing after a loss of the link takes less."""
TROUBLE = {**DISK_FULL, errno.EROFS: "disk is read-only"}
CAPACITY = 20_000
"""Largest number of records in the queue; world or cloud makes this number in about 30 s."""
PERIODIC = (Arrival, CommandApplied, Control, GroundTruth, Lateness, Left, TelemetrySent)
"""Types of records that world and cloud make all the time, even between flights."""
BATCH = 16
"""Largest number of records that the thread writes without a sleep."""
IDLE = 0.1
"""Sleep of the thread after it has written all records [s]."""
BUSY = 0.001
"""Sleep of the thread while more records wait [s]."""
APART_NS = 1_000_000_000
"""Lost records belong to one hole of the recording if they are less than this apart [ns]."""
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


class Recorder:
    """Writes records to a file in the background, from `start` to `stop`.

    If the queue is full, the oldest record is dropped, and the file names the number of dropped
    records and the holes that they leave. A file error must not stop the flight, so no method
    raises an exception.
    """

    def __init__(
        self,
        path: Path,
        open_sink: Callable[[Path], McapWriter],
        size_max: int | None = None,
    ) -> None:
        """Create the queue of records; after `start`, a thread opens the file.

        When the file reaches `size_max` [bytes], it becomes NAME.before.mcap, in place of an
        earlier one, and a new file begins; None means no limit.
        """
        self.error = ""  # why records are missing from the file, in words
        self._path = path
        self._open_sink = open_sink
        self._size_max = size_max
        self._queue: deque[Record] = deque()
        self._sink: McapWriter | None = None
        self._ended = False
        self._overflowed = self._unwritten = self._noted = 0
        self._holes: list[Hole] = []
        self._sync_error: OSError | None = None
        self._safe_since: float | None = None
        self._stopping, self._flushed = threading.Event(), threading.Event()
        # Daemon threads: the process can end even if the disk hangs.
        self._writing = threading.Thread(target=self._write_all, name="recording", daemon=True)
        self._syncing = threading.Thread(target=self._sync_all, name="recording-sync", daemon=True)

    @property
    def dropped(self) -> int:
        """Number of records that did not reach the file."""
        return self._overflowed + self._unwritten

    def put(self, records: Iterable[Record]) -> None:
        """Queue records, oldest first; never wait."""
        queue = self._queue
        queue.extend(records)
        while len(queue) > CAPACITY:
            self._lose(queue.popleft())
            self._overflowed += 1

    def _lose(self, record: Record) -> None:
        """Remember when a record was lost."""
        begin_ns, end_ns = record.stamp_ns - 1, record.stamp_ns + 1
        if self._holes and begin_ns - self._holes[-1].end_ns < APART_NS:
            last = self._holes.pop()
            begin_ns, end_ns = min(begin_ns, last.begin_ns), max(end_ns, last.end_ns)
        self._holes.append(Hole(begin_ns, end_ns))

    def _note_losses(self, sink: McapWriter) -> None:
        """Note in the file which records are lost, if these are more than before."""
        if self.dropped == self._noted:
            return
        self._noted = self.dropped
        lost = {
            "were dropped, because the disk was too slow": self._overflowed,
            "could not be written": self._unwritten,
        }
        text = "; ".join(f"{count} records {how}" for how, count in lost.items() if count)
        sink.note_losses(text, self._holes)

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

    def _write_all(self) -> None:
        rest, flushed = IDLE, time.monotonic()
        while not self._stopping.wait(rest):
            rest = BUSY if self._drain() == BATCH else IDLE
            if time.monotonic() - flushed >= FLUSH:
                self._flush()
                self._flushed.set()
                flushed = time.monotonic()
        self._close()
        self._flushed.set()

    def _sync_all(self) -> None:
        while self._flushed.wait() and not self._ended:
            self._flushed.clear()
            self._sync()

    def _drain(self) -> int:
        """Write at most `BATCH` records of the queue; return how many were taken."""
        if self._sink is None and not self._ended:
            try:
                self._sink = self._open_sink(self._path)
            except OSError as error:
                self._end(error)
        taken = 0
        while self._queue and taken < BATCH:  # the other thread never empties the queue
            taken += 1
            self._write(self._queue.popleft())
        return taken

    def _flush(self) -> None:
        """Pass data to the operating system; close the file if it is full or a sync has failed.

        After a full file, the next record begins a new one.
        """
        if self._sink and not self._ended:
            try:
                self._note_losses(self._sink)
                self._sink.flush()
                if self._sync_error is not None:
                    raise self._sync_error
                if self._size_max is not None and self._path.stat().st_size >= self._size_max:
                    full, self._sink = self._sink, None
                    full.close()
                    self._path.replace(part_before(self._path))
            except OSError as error:
                self._end(error)

    def _sync(self) -> None:
        """Write flushed data to the disk, however long that takes."""
        began, sink = time.monotonic(), self._sink
        if sink is not None:
            try:
                sink.sync()
                self._safe_since = began
            except OSError as error:  # the next flush, in the other thread, ends the file
                self._sync_error = error if sink is self._sink else None
            except ValueError:  # the file was closed in the meantime
                pass

    def _close(self) -> None:
        """Write the remaining records and close the file."""
        while self._drain():
            pass
        if self._sink and not self._ended:
            self._ended = True
            try:
                self._note_losses(self._sink)
                self._sink.close()
            except OSError as error:
                self._end(error)

    def _write(self, record: Record) -> None:
        if self._sink is None or self._ended:
            self._unwritten += 1
            return
        try:
            self._sink.write((record,))
        except OSError as error:
            self._unwritten += 1
            self._end(error)
        except ValueError as error:  # such as a text of a plug-in that is no Unicode
            self._unwritten += 1
            self._lose(record)
            kind = type(record).__name__
            self.error = f"{self._path}: a record of type {kind} cannot be written: {error}"

    def _end(self, error: OSError) -> None:
        """Close the file after an error, so that it stays readable; drop all later records."""
        self._ended = True
        reason = f"recording stopped: {TROUBLE.get(error.errno or 0, error.strerror or error)}"
        self.error = (
            f"{self._path}: {reason}; make room or choose another folder; the flight goes on"
        )
        if self._sink:
            code = "disk_full" if error.errno in DISK_FULL else ""
            self._unwritten += self._sink.abandon(reason, code)
