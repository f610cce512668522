"""The journal of missions: entries come in and are on the disk when `append` returns.

Append-only, see `journal_format`. What a crash has torn off at the end is cut when the journal is
opened again, damage in the middle is left out, and both are reported. A lock keeps a second process
out: during a change of pods an old and a new teleop can overlap. A disk that is full or read-only
refuses entries, and takes them again once it can.

The disk as the journal needs it: paths and bytes come in, what the kernel says comes out.

In one place, so that a test can put a disk there that is full, forgets or breaks off at any step.

The journal's bytes: entries come in, records go out; bytes come in, every whole entry goes out.

    file    MAGIC, then records
    record  MARK, length, number, CRC-32 of length, number and payload; then the payload: JSON

All numbers are little-endian. The payload is plain ASCII and the mark begins with a byte that is
not, so after damage the next record is found by its mark. Numbers rise by one from record to record
of a file: what is missing between two of them is known to be lost.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import zlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from cloudrc.errors import BadInputError, CloudrcError
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


Entry: TypeAlias = dict[str, Any]
"""What JSON can hold; numbers may also be infinite."""

MAGIC = b"\x93CRJ\r\n\x1a\n"
"""As PNG's: damage by a transfer as text is seen."""
MARK = b"\xc5JE\x01"
LENGTH_MAX = 4 << 20
"""Longer than any entry [bytes]; a damaged length is not believed beyond it."""
_FIELDS = len(MARK), 4, 8, 4
HEAD = sum(_FIELDS)
"""Length of what stands before the payload [bytes]."""
_LENGTH, _NUMBER, _CRC = slice(4, 8), slice(8, 16), slice(16, HEAD)


class Parsed(NamedTuple):
    """What a journal's bytes hold.

    Attributes:
        entries: Every one that is whole, oldest first.
        number: Of the last one; 0 if there is none.
        end: Where it ends, or the magic if there is none.
        torn: How many bytes follow.
        lost: How many entries before it are damaged or missing.
        known: Whether the bytes begin as a journal does, or are a torn beginning of one.
    """

    entries: list[Entry]
    number: int
    end: int
    torn: int
    lost: int
    known: bool


def to_record(number: int, entry: Entry) -> bytes:
    """Write an entry as the record of this number, from 1."""
    payload = json.dumps(entry, separators=(",", ":")).encode("ascii")
    counted = len(payload).to_bytes(4, "little") + number.to_bytes(8, "little")
    crc = zlib.crc32(payload, zlib.crc32(counted))
    return b"".join((MARK, counted, crc.to_bytes(4, "little"), payload))


def to_bytes(entries: Iterable[Entry]) -> bytes:
    """Write a whole journal."""
    return b"".join((MAGIC, *(to_record(number, e) for number, e in enumerate(entries, 1))))


def parse(data: bytes) -> Parsed:
    """Read a journal's bytes, whatever they are; never raises."""
    known = data.startswith(MAGIC) or MAGIC.startswith(data)
    entries: list[Entry] = []
    end = len(MAGIC) if data.startswith(MAGIC) else 0
    number = 0
    at = data.find(MARK, end)
    while at >= 0:
        found = _record_at(data, at, number)
        if found is None:
            at = data.find(MARK, at + 1)
            continue
        entry, number, end = found
        entries.append(entry)
        at = data.find(MARK, end)
    return Parsed(entries, number, end, len(data) - end, number - len(entries), known)


def _record_at(data: bytes, at: int, newest: int) -> tuple[Entry, int, int] | None:
    """Entry, number and end of the record there, if it is whole and newer than the newest."""
    head = data[at : at + HEAD]
    length = int.from_bytes(head[_LENGTH], "little")
    number = int.from_bytes(head[_NUMBER], "little")
    after = at + HEAD + length
    if length > LENGTH_MAX or after > len(data) or number <= newest:
        return None
    # A payload is ASCII and has no mark in it: of those forged into each other one is summed.
    if data.find(MARK, at + HEAD, after) != -1:
        return None
    payload = data[at + HEAD : after]
    crc = zlib.crc32(payload, zlib.crc32(head[4:16]))
    if crc != int.from_bytes(head[_CRC], "little"):
        return None
    try:
        entry = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    return (entry, number, after) if isinstance(entry, dict) else None


REFUSED = (errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOSPC, errno.EDQUOT)
"""A disk that can only be read, or is full: what is there still counts."""
NO_FILE = -1


class JournalLockedError(CloudrcError):
    """Another process has the journal open."""


class Journal:
    """An open journal, locked until it is closed or its process ends.

    Attributes:
        path: Of its file.
        entries: Those that were there when it was opened, oldest first.
        trouble: What was wrong with the file and what has been done about it; "" if nothing.
        repaired: Whether something was cut off or left out.
    """

    def __init__(self, path: Path, disk: Disk | None = None) -> None:
        """Open, lock, read, and cut off what cannot be read.

        Args:
            path: Of the file; its folder is made.
            disk: Where it is; None for the machine's own.

        Raises:
            JournalLockedError: If another process has it.
            BadInputError: If the file is something else, or longer than any journal.
            OSError: If there is no journal and none can be made.
        """
        self.path, self._disk = path, disk or Disk()
        self._file, self._named = NO_FILE, False
        self.trouble = ""
        try:
            self._lock = self._disk.lock(path)
        except BlockingIOError:
            raise JournalLockedError(
                f"{path}: another teleop has this journal open; waiting until it ends"
            ) from None
        except ValueError as error:
            raise _refused(error) from None
        try:
            found = self._read()
            self._mend(found)
        except BaseException:
            self.close()
            raise

    def append(self, entry: Entry) -> None:
        """Write an entry; it survives the process and the machine from here on.

        Raises:
            OSError: If the disk refuses; the journal is then as before.
        """
        disk, file = self._disk, self._opened()
        record = to_record(self._number + 1, entry)
        if not self._size:
            record = MAGIC + record
        try:
            if disk.size(file) != self._size:  # an attempt before this one could not be undone
                disk.truncate(file, self._size)
            self._write(file, record)
        except OSError:
            with suppress(OSError):
                disk.truncate(file, self._size)
                disk.sync(file)
            raise
        self._size += len(record)
        self._number += 1

    def rewrite(self, entries: Iterable[Entry]) -> None:
        """Replace all entries, in one step: a crash leaves the old or the new ones.

        Raises:
            OSError: If the disk refuses; the journal is then as before.
        """
        disk, new = self._disk, self.path.with_name(f"{self.path.name}.new")
        entries = list(entries)
        data = to_bytes(entries)
        file = disk.open(new, new=True)
        try:
            self._write(file, data)
            disk.replace(new, self.path)
        except OSError:
            disk.close(file)
            with suppress(OSError):
                disk.remove(new)
            raise
        if self._file != NO_FILE:
            disk.close(self._file)
        self._file, self._size, self._number = file, len(data), len(entries)
        self._named = False
        self._opened()

    def close(self) -> None:
        """Let the next one in."""
        if self._file != NO_FILE:
            self._disk.close(self._file)
        self._disk.close(self._lock)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _read(self) -> Parsed:
        """Open it to be written, if that can be; then read it."""
        try:
            self._opened()
        except OSError as error:
            if error.errno not in REFUSED:
                raise
            self._complain(f"{self.path}: {error.strerror}: missions are refused until it is not")
        return parse(self._bytes())

    def _bytes(self) -> bytes:
        try:
            return self._disk.read(self.path)
        except ValueError as error:
            raise _refused(error) from None

    def _opened(self) -> int:
        """The file, open to be written; tried again where the disk refused before."""
        if self._file == NO_FILE:
            self._file = self._disk.open(self.path)
        if not self._named:  # a name survives the machine once its folder is written
            self._disk.sync_folder(self.path.parent)
            self._named = True
        return self._file

    def _mend(self, found: Parsed) -> None:
        """Cut a torn end; where more is damaged keep a copy, and write what is whole anew."""
        if not (found.known or found.entries):
            raise BadInputError(f"--journal {self.path}: is no journal; name another file")
        self.entries, self._number = found.entries, found.number
        self._size = found.end
        damaged = found.lost or not found.known
        self.repaired = bool(found.torn or damaged)
        try:
            if damaged:
                self._leave_out(found)
            elif found.torn:
                text = f"{self.path}: {found.torn} bytes of a torn entry were cut off"
                self._complain(f"journal repaired: {text}")
                file = self._opened()
                self._disk.truncate(file, self._size)
                self._disk.sync(file)
        except OSError as error:
            self._complain(f"it could not be written: {error.strerror}")

    def _leave_out(self, found: Parsed) -> None:
        copy = self.path.with_name(f"{self.path.name}.damaged")
        lost = f"{found.lost} damaged entries were left out"
        what = lost if found.lost else "its head was damaged"
        self._complain(f"journal repaired: {self.path}: {what}; see {copy}")
        file = self._disk.open(copy, new=True)
        try:
            self._write(file, self._bytes())
        finally:
            self._disk.close(file)
        self.rewrite(self.entries)

    def _write(self, file: int, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[self._disk.write(file, bytes(view)) :]
        self._disk.sync(file)

    def _complain(self, text: str) -> None:
        self.trouble = "; ".join(filter(None, (self.trouble, text)))


def _refused(error: ValueError) -> BadInputError:
    """Say what to do about a path that is not read; the error names it."""
    return BadInputError(f"--journal {error}; move it away, or name another file")
