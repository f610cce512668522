"""Files of the shared folder that others read while they are written: whole, or not there."""

from __future__ import annotations

import os
import stat
from pathlib import Path

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
    with open(path, "rb", opener=_at_once) as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise ValueError(f"{path}: not a file")
        data = file.read(size_max + 1)
    if len(data) > size_max:
        raise TooLongError(f"{path}: longer than {size_max} bytes")
    return data


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)


def publish(path: Path, text: str) -> None:
    """Write a file in one step, as far as its readers can see.

    Args:
        path: The file; its folder exists.
        text: What stands in it from now on.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def publish_route(path: Path, route: tuple[str, int]) -> None:
    """Tell this pod's tunnel end where it has to send: one line HOST:PORT."""
    publish(path, f"{route[0]}:{route[1]}\n")


def withdraw(path: Path) -> None:
    """Remove a file, if it is there."""
    path.unlink(missing_ok=True)
