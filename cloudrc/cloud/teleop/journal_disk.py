"""The disk as the journal needs it: paths and bytes come in, what the kernel says comes out.

In one place, so that a test can put a disk there that is full, forgets or breaks off at any step.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path

from cloudrc.files import read

SIZE_MAX = 1 << 30
"""Longest journal that is read [bytes].

What a start leaves in it are a hundred missions that have ended and those that wait: at the API's
10,000 waypoints each, 0.4 GB. The paper's mission, flown every minute, adds 6 MB a day: from there
to here it takes three months without a restart.
"""


class Disk:
    """The machine's own disk; every method raises OSError if the kernel refuses."""

    def __init__(self) -> None:
        """Begin without a lock."""
        self._folders: dict[int, int] = {}  # by lock file, the folder that is locked with it

    def lock(self, path: Path) -> int:
        """Lock a file beside `path` for this process alone, or its folder where none can be made.

        The folder is made if it is not there. Who has a file shares the folder.

        Raises:
            BlockingIOError: If another process has it.
            ValueError: If it is no file, as a device is none.
        """
        if path.exists() and not (path.is_file() or path.is_dir()):  # a folder says so when opened
            raise ValueError(f"{path}: not a file")
        path.parent.mkdir(parents=True, exist_ok=True)
        folder, file = os.open(path.parent, os.O_RDONLY), -1
        try:
            with suppress(OSError):
                file = os.open(f"{path}.lock", os.O_RDWR | os.O_CREAT, 0o600)
            # Who has the folder alone keeps out who finds room for a lock file later, too.
            how = fcntl.LOCK_EX if file < 0 else fcntl.LOCK_SH
            fcntl.flock(folder, how | fcntl.LOCK_NB)
            if file < 0:
                return folder
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            for each in (folder, file):
                if each >= 0:
                    os.close(each)
            raise
        self._folders[file] = folder
        return file

    def open(self, path: Path, *, new: bool = False) -> int:
        """Open a file to append to it, made if it is not there; emptied if it shall be `new`."""
        emptied = os.O_TRUNC if new else 0
        return os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | emptied, 0o600)

    def read(self, path: Path) -> bytes:
        """Everything that a file holds; ValueError if it is none, or longer than `SIZE_MAX`."""
        return read(path, SIZE_MAX)

    def write(self, file: int, data: bytes) -> int:
        """Append; say how many bytes were taken."""
        return os.write(file, data)

    def size(self, file: int) -> int:
        """Length of an open file [bytes]."""
        return os.fstat(file).st_size

    def truncate(self, file: int, size: int) -> None:
        """Cut an open file to a length [bytes]."""
        os.ftruncate(file, size)

    def sync(self, file: int) -> None:
        """Wait until what was written survives the machine."""
        os.fsync(file)

    def replace(self, new: Path, path: Path) -> None:
        """Put a file in the place of another, in one step."""
        new.replace(path)

    def sync_folder(self, folder: Path) -> None:
        """Wait until the names in a folder survive the machine."""
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def remove(self, path: Path) -> None:
        """Delete a file, if it is there."""
        path.unlink(missing_ok=True)

    def close(self, file: int) -> None:
        """Let an open file or lock go."""
        os.close(file)
        if (folder := self._folders.pop(file, None)) is not None:
            os.close(folder)
