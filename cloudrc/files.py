"""Read and write files that other processes also write.

Reading never waits. Writing replaces a file in one step.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedReader, FileIO
from pathlib import Path
from typing import IO

SIZE_MAX = 1 << 20
"""Largest file that is read by default [bytes]: the size limit of a ConfigMap."""


class TooLongError(ValueError):
    """A file is larger than the reader's limit."""


def version(path: Path | str) -> tuple[int, int, int] | None:
    """Identify the content of a file by one system call; None if the file does not exist."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size


def read(path: Path, size_max: int = SIZE_MAX) -> bytes:
    """Read a whole file of at most `size_max` bytes, without waiting for another process.

    Raises:
        OSError: If the file cannot be read.
        ValueError: If `path` is not a regular file; a TooLongError if the file is larger.
    """
    with BufferedReader(open_file(path)) as file:
        status = os.fstat(file.fileno())
        # read() allocates its argument at once: ask for the size of the file plus room to grow.
        long = status.st_size > size_max
        data = b"" if long else file.read(min(size_max, status.st_size + SIZE_MAX) + 1)
    if long or len(data) > size_max:
        raise TooLongError(f"{path}: longer than {size_max} bytes")
    return data


def open_file(path: Path) -> FileIO:
    """Open a file that another process has written, without a buffer and without waiting.

    Raise an OSError, or a ValueError if `path` is not a regular file but, for example, a pipe.
    """
    file = FileIO(path, opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return file
    file.close()
    raise ValueError(f"{path}: not a file")


def readable_by_others(path: Path) -> bool:
    """Check whether other users can read a file of this user; a missing file is not readable.

    A file of another owner may be open to the group: Kubernetes gives a Secret's files to root and
    lets the pod's group read them.
    """
    try:
        status = path.stat()
    except OSError:
        return False
    group = stat.S_IRGRP if status.st_uid == os.geteuid() else 0
    return bool(status.st_mode & (stat.S_IROTH | group))


@contextmanager
def atomic_file(path: Path, mode: int = 0o666) -> Iterator[IO[bytes]]:
    """Write a file under a temporary name, and rename the complete file to `path`.

    `mode` are the permissions from its creation, minus the umask. Other users may write to the
    folder: a symbolic link at `path` is replaced, and nobody can guess the temporary name. If the
    file cannot be written, raise an OSError; an existing file then stays unchanged.
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


def write_atomically(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Write a whole file through `atomic_file`."""
    with atomic_file(path, mode) as file:
        file.write(data)
