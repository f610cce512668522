"""The journal of missions: entries come in and are on the disk when `append` returns.

Append-only, see `journal_format`. What a crash has torn off at the end is cut when the journal is
opened again, damage in the middle is left out, and both are reported. A lock keeps a second process
out: during a change of pods an old and a new teleop can overlap. A disk that is full or read-only
refuses entries, and takes them again once it can.
"""

from __future__ import annotations

import errno
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from cloudrc.cloud.teleop.journal_disk import Disk
from cloudrc.cloud.teleop.journal_format import MAGIC, Entry, Parsed, parse, to_bytes, to_record
from cloudrc.errors import BadInputError, CloudrcError

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
