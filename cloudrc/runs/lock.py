"""Lock the folder of a run or sweep, so that no two commands write into it at the same time.

A command that flies all flights locks the folder for itself; shards lock it together, and each its
own number. The kernel releases the locks when a process ends. Nothing else opens the locked files:
on NFS, a process loses its lock when it closes any other handle of the file.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.files import try_lock

LOCK = ".lock"
"""File that each command locks; the names of further locks begin so."""


@contextmanager
def lock_folder(folder: Path, shard: tuple[int, int] | None = None) -> Iterator[None]:
    """Lock a folder for a shard, a number and how many there are, or for one command alone.

    Raise a BadInputError if another command flies the same flights into the folder.
    """
    names = [LOCK, *(["{}-{}-of-{}".format(LOCK, *shard)] if shard else [])]
    with ExitStack() as stack:
        for name in names:
            file = stack.enter_context((folder / name).open("a+"))
            is_held = try_lock(file, shared=bool(shard) and name == LOCK)
            if is_held is False:
                text = "another command flies into it now; wait for its end"
                raise BadInputError(f"--out {folder}: {text}")
            if is_held is None:
                text = "%s: its file system has no locks; do not write into it twice at a time"
                logging.getLogger("cloudrc").warning(text, folder)
        yield
