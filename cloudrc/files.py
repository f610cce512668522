"""Files where somebody else writes, too: read whole and never waited for, written in one step."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader, FileIO
from pathlib import Path
from typing import IO

SIZE_MAX = 1 << 20
"""Longest that is read [bytes]: what a ConfigMap holds."""


class TooLongError(ValueError):
    """A file that is longer than who reads it takes."""


def version(path: Path | str, *, follow: bool = True) -> tuple[int, int, int] | None:
    """Tell versions of a file apart by one system call; None while there is none.

    Args:
        path: The file.
        follow: Whether a link stands for what it leads to.
    """
    try:
        status = os.stat(path, follow_symlinks=follow)
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size


def read(path: Path, size_max: int = SIZE_MAX) -> bytes:
    """Read a file that somebody else has written, without waiting for anybody.

    Args:
        path: The file.
        size_max: Longest that is read [bytes].

    Raises:
        OSError: If it cannot be read.
        ValueError: If it is no file, as a pipe is none.
        TooLongError: If it is longer than that.
    """
    with BufferedReader(open_file(path)) as file:
        status = os.fstat(file.fileno())
        # As much memory is asked for at once: no more than there is to read, and room to grow.
        long = status.st_size > size_max
        data = b"" if long else file.read(min(size_max, status.st_size + SIZE_MAX) + 1)
    if long or len(data) > size_max:
        raise TooLongError(f"{path}: longer than {size_max} bytes")
    return data


def open_file(path: Path) -> FileIO:
    """Open a file that somebody else has written, without waiting for anybody; it has no buffer.

    Raises:
        OSError: If it cannot be opened.
        ValueError: If it is no file, as a pipe is none.
    """
    file = FileIO(path, opener=_at_once)
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return file
    file.close()
    raise ValueError(f"{path}: not a file")


@contextmanager
def draft(path: Path, mode: int = 0o666) -> Iterator[IO[bytes]]:
    """Make a file that gets its name when it is whole; what had that name till then is replaced.

    The folder may be somebody else's: a link that lies there is replaced, too, and not followed,
    and no name of a draft can be known before.

    Args:
        path: The file.
        mode: Of the new one from its beginning, less what the process masks.

    Raises:
        OSError: If it cannot be written; then what was there before is as it was.
    """
    new = path.with_name(f".{path.name}.{os.urandom(8).hex()}")
    alone = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
    file = open(os.open(new, alone, mode), "wb")
    try:
        with file:
            yield file
        new.replace(path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise


def put(path: Path, data: bytes) -> None:
    """Write a whole file by a `draft`."""
    with draft(path) as file:
        file.write(data)


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)
