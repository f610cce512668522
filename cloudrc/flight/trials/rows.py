# SPDX-License-Identifier: Apache-2.0

"""Keep the result of each trial as a row: one line of JSON in a file of its folder.

A row has no wall-clock times, so equal trials give equal rows.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from cloudrc.base import files
from cloudrc.base.errors import StateError

Row = dict[str, Any]
"""Result of a trial: `key`, `point` (axis -> value), `seed`, `verdict`, `failures` (codes), `text`
(the first failure in words), `numbers` (metric -> value), `records_sha256`, and `code`, the hash of
cloudrc's own code."""
FIELDS = {"key", "point", "seed", "verdict", "failures", "text", "numbers", "records_sha256"}
SIZE_MAX = 1 << 32
"""Largest file of rows [bytes]: a million flights."""


class Rows:
    """The rows of trials by their keys; with a folder, those that its files have.

    Each shard of the work, or each pod, appends to a file of its own.
    """

    def __init__(self, folder: Path | None = None, shard: int | str | None = None) -> None:
        """Read the rows in `folder`; None: keep them in memory alone. `shard` names its file."""
        self.kept: dict[str, Row] = read_rows(folder) if folder else {}
        self._path = folder and folder / f"rows{f'-{shard}' if shard else ''}.jsonl"
        if self._path and self._path.exists():
            # A killed command has left half a line at the end.
            os.truncate(self._path, files.read(self._path, SIZE_MAX).rfind(b"\n") + 1)

    def add(self, row: Row) -> None:
        """Add a row, unless one of its key is there."""
        if row["key"] not in self.kept:
            self._write(row)
            self.kept[row["key"]] = row

    def _write(self, row: Row) -> None:
        if self._path:
            with files.at_place(self._path), self._path.open("ab") as file:
                file.write(line_of(row))


def line_of(row: Row) -> bytes:
    """Return a row as a line of a file."""
    return f"{json.dumps(row, allow_nan=False)}\n".encode()


def read_rows(folder: Path) -> dict[str, Row]:
    """Read the rows of all files of a folder: key -> row; ignore an unfinished last line.

    Raise a StateError if a line is not a row.
    """
    found: dict[str, Row] = {}
    for path in sorted(folder.glob("rows*.jsonl")):
        take_lines(files.read(path, SIZE_MAX), path, found)
    return found


def take_lines(data: bytes, place: object, found: dict[str, Row]) -> None:
    """Add the rows in the content of a file to those found before; `place` names the file."""
    *lines, _ = data.split(b"\n")
    for number, line in enumerate(lines, start=1):
        row = parse_row(line)
        if row is None:
            text = "is not a row; delete this line to play its trial again"
            raise StateError(f"{place}:{number}: {text}")
        found.setdefault(row["key"], row)


def parse_row(line: bytes | str) -> Row | None:
    """Parse a line of JSON as a row; return None if it is not a row."""
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) and row.keys() >= FIELDS else None
