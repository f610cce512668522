"""Lock the folder of a run or sweep, so that no two commands write into it at the same time.

A command that flies all flights locks the folder for itself; shards lock it together, and each its
own number. The kernel releases the locks when a process ends. Nothing else opens the locked files:
on NFS, a process loses its lock when it closes any other handle of the file.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from cloudrc.errors import BadInputError

LOCK = ".lock"
"""File that each command locks; the names of further locks begin so."""
ALONE, TOGETHER = fcntl.LOCK_EX | fcntl.LOCK_NB, fcntl.LOCK_SH | fcntl.LOCK_NB
_claims = dict[tuple[int, int], int]()
"""Folders that this process has claimed and not yet written into: device, inode -> open handle."""


def claim_folder(folder: Path, *, is_shared: bool) -> bool:
    """Return whether a folder is empty, and no other process is about to write into it.

    With `is_shared`, other shards may be. The folder stays locked until something is in it. The
    lock leaves no file, so that a folder without a result can be used again. If the file system has
    no locks, nothing is locked.
    """
    for identity, handle in [*_claims.items()]:
        if os.listdir(handle):  # so nobody takes this folder for a new one
            os.close(_claims.pop(identity))
    found = folder.stat()
    identity = found.st_dev, found.st_ino
    if identity in _claims:
        return True
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    if not _try_lock(handle, TOGETHER if is_shared else ALONE) or os.listdir(handle):
        os.close(handle)
        return False
    _claims[identity] = handle
    return True


@contextmanager
def lock_folder(folder: Path, shard: int | None = None, count: int = 1) -> Iterator[str]:
    """Lock a folder for shard number `shard` of `count`, or for one command alone if it is None.

    Yield a warning if the file system has no locks, else "".

    Raises:
        BadInputError: If another command flies the same flights into the folder.
    """
    warnings = [""]
    with ExitStack() as stack:

        def lock(name: str, how: int, who: str) -> None:
            file = stack.enter_context((folder / name).open("a+"))
            try:
                fcntl.flock(file, how)
            except BlockingIOError:
                raise BadInputError(
                    f"--out {folder}: {who} into it now; wait for its end"
                ) from None
            except OSError as error:
                text = f"{folder}: its file system has no locks ({error.strerror}); do not start "
                warnings.append(f"{text}the same sweep or shard twice at the same time")

        lock(LOCK, TOGETHER if shard else ALONE, "another command flies")
        if shard:
            lock(_name(shard, count), ALONE, f"another command flies shard {shard} of {count}")
            for other in folder.glob(_name("*", "*")):  # has some of our flights
                if not other.name.endswith(f"-{count}"):
                    lock(other.name, TOGETHER, f"shards of another number than {count} fly")
        yield warnings[-1]


def _try_lock(file: int, how: int) -> bool:
    """Return whether no other process has locked a folder, or there are no locks."""
    try:
        fcntl.flock(file, how)
    except BlockingIOError:
        return False
    except OSError:  # `lock_folder` warns
        pass
    return True


def _name(shard: int | str, count: int | str) -> str:
    return f"{LOCK}-{shard}-of-{count}"
