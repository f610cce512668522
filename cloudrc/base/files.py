# SPDX-License-Identifier: Apache-2.0

"""Read and write files that other processes write or read at the same time.

Reading never blocks. Writing replaces the file in one step.
"""

from __future__ import annotations

import json
import os
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedReader, FileIO
from pathlib import Path
from typing import IO, Any

SIZE_MAX = 1 << 20
"""Default size limit of a file that is read [bytes]: the size limit of a ConfigMap."""
_AT_ONCE = getattr(os, "O_NONBLOCK", 0)  # Windows has no such flag, and no pipes in its folders


class TooLongError(ValueError):
    """A file is larger than the size limit for reading."""


def version(path: Path | str) -> tuple[int, int, int] | None:
    """Return a value that changes with a file's content or permissions; None without a file."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_ctime_ns, status.st_ino, status.st_size


class Watched:
    """A file that another process replaces; tells whether it is new."""

    def __init__(self, path: Path, period_ns: int) -> None:
        """Watch `path`, which may not exist yet, with `period_ns` [ns] between two looks."""
        self.path, self._period_ns, self._due_ns = path, period_ns, 0
        self._seen: tuple[int, int, int] | None = None

    def is_new(self, now_ns: int, *, at_once: bool = False) -> bool:
        """Return whether there is another content since the last look; look if it is time.

        `now_ns` is the time [ns]. With `at_once`, look before the period is over, too.
        """
        if now_ns < self._due_ns and not at_once:
            return False
        self._due_ns = now_ns + self._period_ns
        before, self._seen = self._seen, version(self.path)
        return self._seen not in (None, before)


def read(path: Path, size_max: int = SIZE_MAX) -> bytes:
    """Read a whole file of at most `size_max` bytes; never block, even if the file is a pipe.

    Raise an OSError if the file cannot be read, a ValueError if it is no regular file, and a
    TooLongError if it is too large.
    """
    with BufferedReader(open_file(path)) as file:
        status = os.fstat(file.fileno())
        # read() allocates its argument at once: ask for the size of the file plus room to grow.
        long = status.st_size > size_max
        data = b"" if long else file.read(min(size_max, status.st_size + SIZE_MAX) + 1)
    if long or len(data) > size_max:
        raise TooLongError(f"{path}: longer than {size_max} bytes")
    return data


def read_json(path: Path, size_max: int = SIZE_MAX) -> dict[str, Any]:
    """Read a file with a JSON object; {} if there is none that can be read."""
    with suppress(OSError, ValueError, RecursionError):
        document = json.loads(read(path, size_max))
        return document if isinstance(document, dict) else {}
    return {}


def open_file(path: Path) -> FileIO:
    """Open a file for reading, unbuffered; never block, even if the file is a pipe.

    Raise an OSError if it cannot be opened, or a ValueError if it is no regular file.
    """
    file = FileIO(path, opener=lambda name, flags: os.open(name, flags | _AT_ONCE))
    if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        return file
    file.close()
    raise ValueError(f"{path}: not a file")


def who_may_write(path: Path) -> str:
    """Say which other user could change the file or folder at `path`; "" if there is none.

    Whoever may write to a folder above could put another one in its place, except in a folder with
    the sticky bit, such as /tmp. Root may do everything and is not meant. Raise an OSError if
    nothing is at `path`.
    """
    path = Path(os.path.abspath(path))
    path.stat()  # raises for a circle of symbolic links
    for place in (*reversed(path.parents), path):
        status = place.lstat()
        if status.st_uid not in (0, os.geteuid()):
            return f"another user owns {place}"
        if stat.S_ISLNK(status.st_mode):
            if found := who_may_write(place.parent.resolve() / place.readlink()):
                return found
        elif place != path and status.st_mode & stat.S_ISVTX:
            continue
        elif status.st_mode & stat.S_IWOTH:
            return f"everybody may write to {place}"
        elif status.st_mode & stat.S_IWGRP and not _is_group_of_one(status.st_gid):
            return f"a group may write to {place}"
    return ""


def make_own_folder(path: Path) -> str:
    """Make a folder if it is missing, for this user alone; return what `who_may_write` says.

    Missing folders above are made in the same way, whatever the umask. May raise an OSError.
    """
    for place in (*reversed(path.parents), path):
        if not place.is_dir():
            place.mkdir(mode=0o700, exist_ok=True)  # another process may be faster
    return who_may_write(path)


def _is_group_of_one(gid: int) -> bool:
    """Return whether a group is the one that many systems make for this user alone."""
    import grp  # here, because Windows, where the link is a library, has none of these
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(gid)
    except KeyError:
        return False
    return (gid, group.gr_name) == (user.pw_gid, user.pw_name) and not group.gr_mem


def warn_if_readable(path: Path, warn: Callable[[str], None]) -> None:
    """Call `warn` with one line if other users can read or change the secret in this file.

    If another user owns the file, its group may read it: Kubernetes gives the files of a Secret to
    root, and lets the pod's group read them.
    """
    if path.exists():  # else its reader reports it
        status = path.stat()
        group = stat.S_IRGRP if status.st_uid == os.geteuid() else 0
        masks = {"read": stat.S_IROTH | group, "changed": stat.S_IWOTH | stat.S_IWGRP}
        if allowed := [verb for verb, mask in masks.items() if status.st_mode & mask]:
            warn(
                f"warning: {path} can be {' and '.join(allowed)} by others: chmod 600 {path}",
            )


@contextmanager
def at_place(place: Path | str) -> Iterator[None]:
    """Let an OSError that names no file, such as a full disk, name the `place` of the writing."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(place)
        raise


def try_lock(file: IO[Any] | int, *, shared: bool = False) -> bool | None:
    """Lock a file until it is closed, for this process alone or `shared` with others of its kind.

    Return False if another process has it. None: the file system has no locks.
    """
    import fcntl  # here, because Windows, where the link is a library, has none

    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True


@contextmanager
def atomic_file(path: Path, mode: int = 0o666) -> Iterator[IO[bytes]]:
    """Write a file under a temporary name, then rename it to `path`; readers see no partial file.

    `mode` is the file's permissions, minus the umask. Other users may write to the folder, so a
    symbolic link at `path` is replaced, and the temporary name is random. If writing fails, the
    existing file stays unchanged, and an OSError that names `path` is raised.
    """
    new = path.with_name(f".{path.name}.{os.urandom(8).hex()}")
    alone = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    try:
        with open(os.open(new, alone, mode), "wb") as file:
            yield file
        new.replace(path)
    except OSError as error:
        if error.filename in (None, str(new)):
            error.filename = str(path)  # the user knows no temporary name
        raise
    finally:
        if new.exists():  # writing failed
            new.unlink()


def write_atomically(path: Path, data: bytes, mode: int = 0o666) -> None:
    """Replace a file in one step, with the permissions `mode` minus umask; may raise an OSError."""
    with atomic_file(path, mode) as file:
        file.write(data)


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write plain values as JSON, as `write_atomically` does; a number must be finite."""
    text = json.dumps(document, indent=2, allow_nan=False, ensure_ascii=False)
    write_atomically(path, f"{text}\n".encode())
