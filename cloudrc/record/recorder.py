"""Record the flight of a real-time process without delaying its control loop.

The loop puts records into a queue of limited length, and a thread (`cloudrc/drivers/recording.py`)
writes them to the file. If the queue is full, the oldest record is dropped and counted. A file
error must not stop the flight, so no method raises an exception.
"""

from __future__ import annotations

import contextlib
import errno
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.errors import DISK_FULL
from cloudrc.records import Record

if TYPE_CHECKING:
    from cloudrc.record.writer import McapWriter

TROUBLE = {**DISK_FULL, errno.EROFS: "disk is read-only"}
CAPACITY = 20_000
"""Largest number of records in the queue; world or cloud makes this number in about 30 s."""


class Recorder:
    """Queue of records: one thread calls `put`, another calls `drain`, a third may call `sync`."""

    def __init__(
        self,
        path: Path,
        open_sink: Callable[[Path], McapWriter],
        capacity: int = CAPACITY,
        size_max: int | None = None,
    ) -> None:
        """Create a queue of `capacity` records; the first `drain` opens `path` with `open_sink`.

        When the file reaches `size_max` [bytes], recording ends; None means no limit.
        """
        self.error = ""  # why records are missing from the file, in words
        self._path = path
        self._open_sink = open_sink
        self._capacity = capacity
        self._size_max = size_max
        self._queue: deque[Record] = deque()
        self._sink: McapWriter | None = None
        self._ended = False
        self._overflowed = self._unwritten = 0
        self._sync_error: OSError | None = None

    @property
    def dropped(self) -> int:
        """Number of records that did not reach the file."""
        return self._overflowed + self._unwritten

    def put(self, records: Iterable[Record]) -> None:
        """Queue records, oldest first; never wait."""
        queue = self._queue
        queue.extend(records)
        while len(queue) > self._capacity:
            # The other thread may have emptied the queue in the meantime.
            with contextlib.suppress(IndexError):
                queue.popleft()
                self._overflowed += 1

    def drain(self, max_records: int = 64) -> int:
        """Take at most `max_records` from the queue, and write them; return how many."""
        if self._sink is None and not self._ended:
            try:
                self._sink = self._open_sink(self._path)
            except OSError as error:
                self._stop(error)
        taken = 0
        with contextlib.suppress(IndexError):
            while taken < max_records:
                record = self._queue.popleft()
                taken += 1
                self._write(record)
        return taken

    def flush(self) -> None:
        """Pass data to the operating system; close the file if it is full or a sync has failed."""
        if self._sink and not self._ended:
            try:
                self._sink.flush()
                if self._sync_error is not None:
                    raise self._sync_error
                if self._size_max is not None and self._path.stat().st_size >= self._size_max:
                    raise OSError(errno.EFBIG, "the file has reached its size limit")
            except OSError as error:
                self._stop(error)

    def sync(self) -> bool:
        """Write flushed data to the disk, however long that takes; return whether it worked."""
        sink = self._sink
        if sink is not None and not self._ended:
            try:
                sink.sync()
                return self._path.is_file()
            except OSError as error:  # the next flush, in the other thread, ends the file
                self._sync_error = error
            except ValueError:  # the file was closed in the meantime
                pass
        return False

    def close(self) -> None:
        """Write the remaining records and close the file."""
        while self.drain():
            pass
        if self._sink and not self._ended:
            self._ended = True
            try:
                self._sink.close()
            except OSError as error:
                self._stop(error)

    def _write(self, record: Record) -> None:
        if self._sink is None or self._ended:
            self._unwritten += 1
            return
        try:
            self._sink.write((record,))
        except OSError as error:
            self._unwritten += 1
            self._stop(error)
        except Exception as error:  # one record that cannot be encoded must not stop the others
            self._unwritten += 1
            kind = type(record).__name__
            self.error = f"{self._path}: a record of type {kind} cannot be written: {error}"

    def _stop(self, error: OSError) -> None:
        """Close the file after an error, so that it stays readable; drop all later records."""
        self._ended = True
        reason = f"recording stopped: {TROUBLE.get(error.errno or 0, error.strerror or error)}"
        self.error = (
            f"{self._path}: {reason}; make room or choose another folder; the flight goes on"
        )
        if self._sink:
            self._unwritten += self._sink.abandon(reason)
