"""The epoch file: world's epochs rise through restarts, and each is on disk before it is used.

A block of them is reserved at the start, and the next one by a thread when half of it is used, so
that the flight does not wait for a slow disk. While one hangs for so long that the block is used
up, there is no epoch. What is left of a block is given up at the next start. A file that is lost,
or cannot be written, costs only that epochs begin again: the keys of a session come from fresh
nonces too, so nothing old is accepted.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

from cloudrc.files import draft, read
from cloudrc.tunnel.handshake import EPOCH_MAX

BLOCK = 4096
"""Epochs reserved at once; a restart every minute uses them up in two years."""
SIZE_MAX = 64
"""Longest file that is read [bytes]; the largest epoch has 10 digits."""


class EpochFile:
    """Hands out epochs, strictly rising."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        """Read the file, and reserve the first block of this process.

        Args:
            path: Of the file.
            say: Is told why epochs are not kept through a restart; later on by a thread.
        """
        self._path, self._say = path, say
        self._block = range(0)
        self._reserved: deque[range] = deque()
        self._used: SimpleQueue[int] = SimpleQueue()
        self._reserve(self._read())
        Thread(target=self._reserve_ahead, name="epochs", daemon=True).start()

    def take(self) -> int | None:
        """The next epoch, of which it is on disk that it may have been used; never waits.

        None while the disk keeps the next block waiting and this one is used up.
        """
        if not self._block and self._reserved:
            self._block = self._reserved.popleft()
        if not self._block:
            return None
        epoch, last, self._block = self._block[0], self._block[-1], self._block[1:]
        if len(self._block) == BLOCK // 2:
            self._used.put(last)
        return epoch

    def _reserve_ahead(self) -> None:
        """Do so whenever half of a block is used: waits, in a thread of its own."""
        while True:
            self._reserve(self._used.get())

    def _reserve(self, used: int) -> None:
        """Put on disk that a block behind the last epoch `used` may be, however long that takes."""
        first = used + 1 if used + BLOCK < EPOCH_MAX else 1
        block = range(first, first + BLOCK)
        try:
            replace_durably(self._path, f"{block[-1]}\n".encode("ascii"))
        except OSError as error:
            self._note(f"{error.strerror or error}; epochs are not kept through a restart")
        self._reserved.append(block)

    def _read(self) -> int:
        try:
            text = read(self._path, SIZE_MAX).decode("ascii").strip()
        except FileNotFoundError:
            return 0
        except OSError as error:
            self._note(f"{error.strerror or error}; epochs begin again")
            return 0
        except ValueError:  # no file, too long or no text
            text = ""
        if not text.isdecimal() or int(text) > EPOCH_MAX:
            self._note(f"it holds no epoch{self._set_aside()}; epochs begin again")
            return 0
        return int(text)

    def _set_aside(self) -> str:
        """Keep what may be somebody's, named by mistake; say so."""
        aside = self._path.with_name(f"{self._path.name}.no-epoch")
        try:
            self._path.replace(aside)
        except OSError:
            return ""  # nor will it be written
        return f" and is kept as {aside.name}"

    def _note(self, what: str) -> None:
        self._say(f"{self._path}: {what}")


def replace_durably(path: Path, data: bytes, mode: int = 0o600) -> None:
    """Put a file in the place of another, whole or not at all, and wait until it is on disk.

    Raises:
        OSError: If it cannot; then the old file is as it was.
    """
    with draft(path, mode) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
