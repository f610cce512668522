"""The recorder of a process that flies: records go in without waiting, an MCAP file comes out.

The loop only puts; what writes (`cloudrc/drivers/recording.py`) drains. Between them lies a
bounded queue that gives up its oldest record when it is full, and counts it. Whatever goes wrong
with the file, the flight goes on.
"""

from __future__ import annotations

import contextlib
import errno
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol

from cloudrc.records import Record

TROUBLE = {
    errno.ENOSPC: "disk full",
    errno.EDQUOT: "disk quota used up",
    errno.EROFS: "disk is read-only",
}
CAPACITY = 20_000
"""Records that the queue holds: some 30 s of either end."""


class Sink(Protocol):
    """What the recorder needs of a writer."""

    def write(self, records: Iterable[Record]) -> None:
        """Record them, oldest first."""

    def flush(self) -> None:
        """Hand everything to the operating system."""

    def sync(self) -> None:
        """Have what was flushed survive the machine."""

    def abandon(self, reason: str) -> int:
        """After an error: cut off what is torn, note why, say how many records go with it."""

    def close(self) -> None:
        """End the file."""


class Recorder:
    """A queue between one thread that puts and one that drains; a third one may `sync`.

    Attributes:
        error: Why something was not recorded, in words; "" if all is well.
    """

    def __init__(
        self,
        path: Path,
        open_sink: Callable[[Path], Sink],
        capacity: int = CAPACITY,
        size_max: int | None = None,
    ) -> None:
        """Set the queue up; the file is opened by the first drain.

        Args:
            path: Of the file.
            open_sink: Opens it: `lambda path: McapWriter(path, clock="world")`.
            capacity: Records that the queue holds.
            size_max: The file is ended when it has grown to this [bytes]; None: never.
        """
        self.error = ""
        self._size_max = size_max
        self._path = path
        self._open_sink = open_sink
        self._capacity = capacity
        self._queue: deque[Record] = deque()
        self._sink: Sink | None = None
        self._ended = False
        self._overflowed = 0
        self._unwritten = 0
        self._refused: OSError | None = None  # by `sync`

    @property
    def dropped(self) -> int:
        """Number of records that did not reach the file."""
        return self._overflowed + self._unwritten

    def put(self, records: Iterable[Record]) -> None:
        """Take records over; never waits and never raises.

        Args:
            records: Oldest first.
        """
        queue = self._queue
        queue.extend(records)
        while len(queue) > self._capacity:
            # The other thread may have emptied the queue since.
            with contextlib.suppress(IndexError):
                queue.popleft()
                self._overflowed += 1

    def drain(self, max_records: int = 64) -> int:
        """Write out what waits in the queue; never raises.

        Args:
            max_records: At most so many, so that the caller does not keep the loop from running.

        Returns:
            How many were taken from the queue.
        """
        sink = self._sink or self._open()
        taken = 0
        with contextlib.suppress(IndexError):
            while taken < max_records:
                record = self._queue.popleft()
                taken += 1
                self._write(sink, record)
        return taken

    def flush(self, *, sync: bool = True) -> None:
        """Hand what was written to the operating system; never raises.

        Args:
            sync: And to the disk, however long that takes.
        """
        if self._sink and not self._ended:
            try:
                self._sink.flush()
                if sync:
                    self.sync()
                if self._refused is not None:
                    raise self._refused
                if self._size_max is not None and self._path.stat().st_size >= self._size_max:
                    raise OSError(errno.EFBIG, "it has grown to its limit")
            except OSError as error:
                self._stop(error)

    def sync(self) -> bool:
        """Have what was flushed survive the machine, however long that takes; never raises.

        Returns:
            Whether it does: False if that failed, or if nothing is recorded into a file.
        """
        sink = self._sink
        if sink is not None and not self._ended:
            try:
                sink.sync()
                return self._path.is_file()
            except OSError as error:  # whoever drains gives the file up, at the next flush
                self._refused = error
            except ValueError:  # it was closed meanwhile
                pass
        return False

    def close(self) -> None:
        """Write out the rest and end the file; never raises."""
        while self.drain():
            pass
        if self._sink and not self._ended:
            self._ended = True
            try:
                self._sink.close()
            except OSError as error:
                self._stop(error)

    def _open(self) -> Sink | None:
        if not self._ended:
            try:
                self._sink = self._open_sink(self._path)
            except OSError as error:
                self._stop(error)
        return self._sink

    def _write(self, sink: Sink | None, record: Record) -> None:
        if sink is None or self._ended:
            self._unwritten += 1
            return
        try:
            sink.write((record,))
        except OSError as error:
            self._unwritten += 1
            self._stop(error)
        except Exception as error:  # a record that cannot be encoded must not end the others
            self._unwritten += 1
            kind = type(record).__name__
            self.error = f"{self._path}: a record of type {kind} cannot be written: {error}"

    def _stop(self, error: OSError) -> None:
        """Give the file up: what is in it stays readable, what comes now is counted."""
        self._ended = True
        reason = f"recording stopped: {TROUBLE.get(error.errno or 0, error.strerror or error)}"
        self.error = (
            f"{self._path}: {reason}; make room or choose another folder; the flight goes on"
        )
        if self._sink:
            self._unwritten += self._sink.abandon(reason)
