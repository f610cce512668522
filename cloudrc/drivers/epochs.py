"""Keep world's epochs in a file, so that they rise through restarts.

Each epoch is on disk before it is used. A block of epochs is reserved at the start; a thread
reserves the next block when half of it is used, so that the flight does not wait for a slow disk.
If the disk hangs until the block is used up, there is no epoch. A restart skips the rest of a
block. If the file is lost or cannot be written, epochs begin again; that is safe, since the keys of
a session also come from fresh nonces.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from threading import Thread

from cloudrc.files import atomic_file, read
from cloudrc.tunnel.handshake import EPOCH_MAX

BLOCK = 4096
"""Number of epochs reserved at once; with a restart every minute all epochs last two years."""
SIZE_MAX = 64
"""Size limit of the file [bytes]; the largest epoch has 10 digits."""


class EpochFile:
    """Hands out epochs, strictly rising."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        """Read the file and reserve the first block of this process.

        Args:
            path: The epoch file.
            say: Called with the reason if epochs are not kept; also called from a thread.
        """
        self._path, self._say = path, say
        self._block = range(0)
        self._reserved: deque[range] = deque()
        self._used: SimpleQueue[int] = SimpleQueue()
        self._reserve(self._read())
        Thread(target=self._reserve_ahead, name="epochs", daemon=True).start()

    def take(self) -> int | None:
        """Return the next epoch without waiting; it is reserved on disk.

        None if this block is used up and the next one is not on disk yet.
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
        """Reserve the next block each time half of a block is used; runs in a thread."""
        while True:
            self._reserve(self._used.get())

    def _reserve(self, used: int) -> None:
        """Reserve on disk the block that follows the epoch `used`; may wait for the disk."""
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
            self._note(f"holds no epoch{self._set_aside()}; epochs begin again")
            return 0
        return int(text)

    def _set_aside(self) -> str:
        """Rename a file that may have been named by mistake; return words for the message."""
        aside = self._path.with_name(f"{self._path.name}.no-epoch")
        try:
            self._path.replace(aside)
        except OSError:
            return ""  # then it cannot be replaced either
        return f" and was renamed {aside.name}"

    def _note(self, text: str) -> None:
        self._say(f"{self._path}: {text}")


def replace_durably(path: Path, data: bytes, mode: int = 0o600) -> None:
    """Replace a file atomically and wait until it is on disk.

    Raises:
        OSError: If that fails; the old file is unchanged.
    """
    with atomic_file(path, mode) as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
