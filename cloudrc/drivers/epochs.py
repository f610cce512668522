"""The epoch file: world's epochs rise through restarts, and each is on disk before it is used.

A block of them is reserved at the start, and the next one only when it is used up: a slow disk
meets the flight once in 4,096 epochs. What is left of a block is given up at the next start. A file
that is lost, or cannot be written, costs only that epochs begin again: the keys of a session come
from fresh nonces too, so nothing old is accepted.
"""

from __future__ import annotations

import os
from pathlib import Path

from cloudrc.tunnel.handshake import EPOCH_MAX

BLOCK = 4096
"""Epochs reserved at once; a restart every minute uses them up in two years."""


class EpochFile:
    """Hands out epochs, strictly rising.

    Attributes:
        trouble: Why they are not kept through a restart, in words; "" if all is well.
    """

    def __init__(self, path: Path) -> None:
        """Read the file, and reserve the first block of this process."""
        self._path = path
        self.trouble = ""
        self._next = self._read() + 1
        self._last = 0
        self._reserve()

    def take(self) -> int:
        """The next epoch; it is on disk that it may have been used."""
        if self._next > self._last or self._next > EPOCH_MAX:
            self._reserve()
        self._next += 1
        return self._next - 1

    def _reserve(self) -> None:
        if self._next + BLOCK > EPOCH_MAX:
            self._next = 1
        self._last = self._next + BLOCK - 1
        try:
            replace_durably(self._path, f"{self._last}\n".encode("ascii"))
        except OSError as error:
            self._note(f"{error.strerror or error}; epochs are not kept through a restart")

    def _read(self) -> int:
        try:
            text = self._path.read_text(encoding="ascii").strip()
            epoch = int(text) if text.isdecimal() else -1  # no number may have 4301 digits
        except FileNotFoundError:
            return 0
        except (OSError, ValueError) as error:
            self._note(f"{error}; epochs begin again")
            return 0
        if not 0 <= epoch <= EPOCH_MAX:
            self._note("it holds no epoch; epochs begin again")
            return 0
        return epoch

    def _note(self, what: str) -> None:
        self.trouble = f"{self._path}: {what}"


def replace_durably(path: Path, data: bytes, mode: int = 0o600) -> None:
    """Put a file in the place of another, whole or not at all, and wait until it is on disk.

    Raises:
        OSError: If it cannot; then the old file is as it was.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError:
        draft.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)
