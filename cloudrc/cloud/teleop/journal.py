"""The journal of missions: entries come in and are on the disk when `append` returns.

Append-only text, one entry per line: CRC-32 of the JSON (8 hex digits), its length in bytes, the
JSON. What a crash has torn off at the end is cut when the journal is opened again, and reported.
A lock keeps a second process out: during a change of pods an old and a new teleop can overlap.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import zlib
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias

from cloudrc.errors import CloudrcError

Entry: TypeAlias = dict[str, Any]
"""What JSON can hold; numbers may also be infinite."""

_LINE = re.compile(rb"([0-9a-f]{8}) (\d{1,9}) (.*)", re.DOTALL)


class JournalLockedError(CloudrcError):
    """Another process has the journal open."""


class Journal:
    """An open journal, locked until it is closed or its process ends.

    Attributes:
        entries: Those that were there when it was opened, oldest first.
        trouble: What was wrong with the file and what has been done about it; "" if nothing.
    """

    def __init__(self, path: Path) -> None:
        """Open, lock, read, and cut off what cannot be read.

        Raises:
            JournalLockedError: If another process has it.
            OSError: If the file cannot be opened or written.
        """
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = os.open(f"{path}.lock", os.O_RDWR | os.O_CREAT, 0o600)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._lock)
            raise JournalLockedError(
                f"{path}: another teleop has this journal open; waiting until it ends"
            ) from None
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o600)
        _sync_folder(path.parent)
        data = path.read_bytes()
        self.entries, good, lost = parse(data)
        self.trouble = ""
        if good < len(data):
            self._mend(data, good, lost)

    def append(self, entry: Entry) -> None:
        """Write an entry; it survives the process and the machine from here on.

        Raises:
            OSError: If the disk refuses; the journal is then as before.
        """
        size = os.fstat(self._file).st_size
        try:
            _write(self._file, to_line(entry))
        except OSError:
            os.ftruncate(self._file, size)
            raise

    def rewrite(self, entries: Iterable[Entry]) -> None:
        """Replace all entries, in one step: a crash leaves the old or the new ones."""
        new = self._path.with_name(f"{self._path.name}.new")
        file = os.open(new, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND, 0o600)
        _write(file, b"".join(map(to_line, entries)))
        new.replace(self._path)
        _sync_folder(self._path.parent)
        os.close(self._file)
        self._file = file

    def close(self) -> None:
        """Let the next one in."""
        os.close(self._file)
        os.close(self._lock)

    def __enter__(self) -> Journal:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _mend(self, data: bytes, good: int, lost: int) -> None:
        """Keep the readable entries; if more than a torn end is lost, keep a copy, too."""
        self.trouble = f"{self._path}: {len(data) - good} bytes of a torn entry were cut off"
        if lost:
            copy = self._path.with_name(f"{self._path.name}.damaged")
            copy.write_bytes(data)
            self.trouble = f"{self._path}: {lost} damaged entries were left out; see {copy}"
        self.rewrite(self.entries)


def to_line(entry: Entry) -> bytes:
    """Write an entry as its line."""
    text = json.dumps(entry, separators=(",", ":")).encode()
    return b"%08x %d %s\n" % (zlib.crc32(text), len(text), text)


def parse(data: bytes) -> tuple[list[Entry], int, int]:
    """Read a journal's bytes.

    Returns:
        Every entry that is whole; how many bytes belong to whole lines; how many damaged lines
        there are that are not just the torn end.
    """
    entries: list[Entry] = []
    good = damaged = bad_since = 0
    for line in data.splitlines(keepends=True):
        entry = _entry(line)
        if entry is None:
            bad_since += 1
            continue
        damaged, bad_since = damaged + bad_since, 0
        entries.append(entry)
        good += len(line)
    return entries, good, damaged


def _entry(line: bytes) -> Entry | None:
    match = _LINE.fullmatch(line.removesuffix(b"\n"))
    if match is None or not line.endswith(b"\n"):
        return None
    crc, length, text = match.groups()
    if len(text) != int(length) or zlib.crc32(text) != int(crc, 16):
        return None
    try:
        entry = json.loads(text)
    except ValueError:
        return None
    return entry if isinstance(entry, dict) else None


def _write(file: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]
    os.fsync(file)


def _sync_folder(folder: Path) -> None:
    """A new name is on the disk only when its folder is."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
