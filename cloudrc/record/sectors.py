"""A file on a disk that is failing: what cannot be read of it costs no more than itself."""

from __future__ import annotations

import errno
import io

SECTOR = 4096
"""What the kernel reads at once [bytes]."""


class Sectors(io.BufferedReader):
    """A file whose bad sectors read as zeros.

    Attributes:
        bad: Numbers of those that were met.
    """

    def __init__(self, raw: io.RawIOBase) -> None:
        """Take a file over.

        Args:
            raw: Open, without a buffer; is closed with this.
        """
        super().__init__(raw)
        self.bad: set[int] = set()

    def read(self, size: int | None = -1, /) -> bytes:
        """Read at most so many bytes; fewer at the end alone.

        Raises:
            OSError: If something else is wrong than a sector.
        """
        at = self.tell()
        try:
            return super().read(size)
        except OSError as error:
            if error.errno != errno.EIO or size is None or size < 0:
                raise
        return self._in_parts(at, size)

    def _in_parts(self, at: int, size: int) -> bytes:
        whole = self.seek(0, io.SEEK_END)
        end, parts = min(at + size, whole), list[bytes]()
        while at < end:
            length = min(SECTOR - at % SECTOR, end - at)
            try:
                self.seek(at)
                part = super().read(length)
            except OSError as error:
                if error.errno != errno.EIO:
                    raise
                part = b""
            if len(part) < length:
                self.bad.add(at // SECTOR)
            parts.append(part.ljust(length, b"\0"))
            at += length
        self.seek(at)
        return b"".join(parts)
