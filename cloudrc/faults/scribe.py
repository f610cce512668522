"""The recorder in virtual time, on disks that are full, slow, or forget what was not synced."""

from __future__ import annotations

import errno
import io
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from cloudrc.drivers.recording import FLUSH, SyncAge
from cloudrc.record.recorder import Recorder
from cloudrc.record.topics import rows
from cloudrc.record.writer import McapWriter
from cloudrc.records import Record

PAGE = 4096
"""What a disk writes at once [bytes]."""


class FullDisk(io.BytesIO):
    """A file on a disk that has room for so many bytes."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room

    def write(self, data: Any) -> int:
        """Take the bytes, or refuse."""
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


class SlowWriter(McapWriter):
    """Each `sync` takes its time [s]."""

    def __init__(self, target: Path | FullDisk, delay: float) -> None:
        super().__init__(target, clock="world")
        self.delay, self.owed = delay, 0.0

    def sync(self) -> None:
        """Owe the time that it takes."""
        super().sync()
        self.owed += self.delay

    def pay(self) -> float:
        """Say how long the disk is busy from now on [s]."""
        owed, self.owed = self.owed, 0.0
        return owed


class ForgetfulWriter(McapWriter):
    """Knows what a power cut would leave: what was synced, and of the rest what chance has written.

    Attributes:
        now_ns: When `sync` is called [ns].
    """

    def __init__(self, path: Path, delay: float) -> None:
        """Open the file.

        Args:
            path: Of the file.
            delay: That a sync takes [s].
        """
        super().__init__(path, clock="world")
        self._path, self._delay_ns = path, round(delay * 1e9)
        self.now_ns = self._began_ns = self._done_ns = 0
        self._before = self._after = 0
        self._age = SyncAge()

    def sync(self) -> None:
        """What was written until now is safe once the disk is done."""
        self.sync_age(self.now_ns)
        super().sync()
        self._before, self._after = self._after, self._path.stat().st_size
        self._began_ns, self._done_ns = self.now_ns, self.now_ns + self._delay_ns

    def sync_age(self, at_ns: int) -> float | None:
        """What the recording thread would show at an instant [ns] as its metric [s]."""
        if at_ns >= self._done_ns:
            self._age.done(self._began_ns * 1e-9)
        return self._age.read(at_ns * 1e-9)

    def after_power_cut(self, at_ns: int, rng: np.random.Generator | None) -> bytes:
        """Give the file as a machine finds it that was without power.

        Args:
            at_ns: When the power is gone [ns].
            rng: Which pages that were not synced have reached the disk all the same, the others
                read as zeros; None if nothing of them has.
        """
        data = self._path.read_bytes()
        safe = self._after if at_ns >= self._done_ns else self._before
        if rng is None:
            return data[:safe]
        pages = bytearray(data)
        for start in range(safe, len(pages), PAGE):
            if rng.random() < 0.5:
                pages[start : start + PAGE] = bytes(len(pages[start : start + PAGE]))
        return bytes(pages)


class Scribe:
    """The recording thread in virtual time: it drains, flushes, and waits for its disk."""

    def __init__(self, recorder: Recorder, owed: Callable[[], float] = lambda: 0.0) -> None:
        self.recorder, self._owed = recorder, owed
        self._put: list[Record] = []
        self._busy_until_ns = self._flushed_ns = 0

    def miscounted(self, kept: int) -> int:
        """How far the recorder's count of what is lost is from the truth; its file lacks an end.

        Args:
            kept: Messages in the file.
        """
        ends = list(accumulate(len(rows(record)) for record in self._put))
        # A record that makes no message may be lost or not: nobody can tell.
        most = bisect_right(ends, kept)
        least = min(bisect_left(ends, kept) + 1, most) if kept else 0
        put, dropped = len(ends), self.recorder.dropped
        return dropped - min(max(dropped, put - most), put - least)

    def hear(self, records: list[Record], now_ns: int) -> None:
        """Take new records over at an instant [ns]."""
        self.recorder.put(records)
        self._put += records
        if now_ns < self._busy_until_ns:
            return
        while self.recorder.drain():
            pass
        if now_ns - self._flushed_ns >= FLUSH * 1e9:
            self._flushed_ns = now_ns
            self.recorder.flush()
            self._busy_until_ns = now_ns + round(self._owed() * 1e9)
