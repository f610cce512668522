"""Hash all records of a run, to compare runs: equal records give an equal SHA-256.

The records of each type are hashed in blocks of `BLOCK` records, in their order. A block is hashed
column by column, in the order of the record's fields: integers as little-endian 64-bit numbers,
floats as IEEE 754 doubles, truth values as one byte, and strings as UTF-8 after their 32-bit
length. A field that holds another record is replaced by the fields of that record. The result is
the hash over name, number of records and hash of each type, in the order of the names.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from enum import IntEnum
from functools import cache
from itertools import chain, repeat
from typing import Any, TypeAlias, get_args, get_origin, get_type_hints

from cloudrc.records import Record

Columns: TypeAlias = dict[str, Any]
"""Dotted path of a plain value in a record -> its column: an array of shape (n,), for vectors of
shape (n, k), or a tuple of n strings."""
_Fields: TypeAlias = tuple[tuple[str, Any, int], ...]

BLOCK = 200
"""Number of records that are converted to columns and hashed together."""
_CODES = {int: "<i8", float: "<f8", bool: "?", str: "s"}


class RecordHash:
    """Stores and hashes records; one call of `update` or many calls give the same hash."""

    def __init__(self) -> None:
        self._waiting: defaultdict[type, list[Record]] = defaultdict(list)
        self._blocks: defaultdict[type, list[Columns]] = defaultdict(list)

    def update(self, records: Iterable[Record]) -> None:
        """Add records to the hash, oldest first."""
        waiting = self._waiting
        for record in records:
            waiting[type(record)].append(record)
        for kind, block in waiting.items():
            while len(block) >= BLOCK:
                self._blocks[kind].append(to_columns(kind, block[:BLOCK]))
                del block[:BLOCK]

    def blocks(self) -> dict[type, list[Columns]]:
        """Return a mapping: type of record -> columns of each block of `BLOCK` records.

        The last block contains the remaining records, possibly none.
        """
        kinds = sorted(self._waiting, key=lambda kind: kind.__name__)
        return {kind: [*self._blocks[kind], to_columns(kind, self._waiting[kind])]
                for kind in kinds}  # fmt: skip

    def hexdigest(self) -> str:
        """Return the hash of all records so far, as 64 hexadecimal digits."""
        total = hashlib.sha256()
        for kind, blocks in self.blocks().items():
            digest = hashlib.sha256()
            for column in chain.from_iterable(block.values() for block in blocks):
                is_text = isinstance(column, tuple)
                digest.update(b"".join(map(_packed_string, column)) if is_text else column.data)
            count = sum(len(block["stamp_ns"]) for block in blocks)
            total.update(b"%s %d %s\n" % (kind.__name__.encode(), count, digest.digest()))
        return total.hexdigest()


def to_columns(kind: type, records: Sequence[Record]) -> Columns:
    """Convert n >= 0 records of one type to columns, in the order of the type's fields."""
    found: Columns = {}
    _convert(_fields(kind), "", records, found)
    return found


def _convert(
    fields: _Fields, prefix: str, records: Sequence[tuple[Any, ...]], found: Columns
) -> None:
    import numpy as np  # not above: a process that only writes a file needs no numpy

    count = len(records)
    columns = zip(*records, strict=True) if count else repeat(())
    for (name, kind, size), values in zip(fields, columns, strict=False):
        if isinstance(kind, tuple):
            _convert(kind, f"{prefix}{name}.", values, found)
        elif size:
            numbers = np.fromiter(chain.from_iterable(values), kind, size * count)
            found[prefix + name] = numbers.reshape(count, size)
        else:
            found[prefix + name] = values if kind == "s" else np.fromiter(values, kind, count)


@cache
def _fields(cls: type) -> _Fields:
    """List each field of a record: name, type, size of a vector (0 for other types)."""
    found = list[tuple[str, Any, int]]()
    for name, kind in get_type_hints(cls).items():
        if hasattr(kind, "_fields"):
            found.append((name, _fields(kind), 0))
        elif get_origin(kind) is tuple:
            found.append((name, "<f8", len(get_args(kind))))
        else:
            found.append((name, "<i8" if issubclass(kind, IntEnum) else _CODES[kind], 0))
    return tuple(found)


def _packed_string(text: str) -> bytes:
    data = text.encode("utf-8", "surrogatepass")
    return len(data).to_bytes(4, "little") + data


def messages_sha256(messages: Iterable[tuple[str, int, bytes]]) -> str:
    """Hash topic, log time [ns] and CDR bytes of a file's messages, in the order of the file.

    For runs in real time, whose records are not kept in memory.
    """
    sha256 = hashlib.sha256()
    for message in messages:
        add_message(sha256, *message)
    return sha256.hexdigest()


def add_message(sha256: hashlib._Hash, topic: str, log_time_ns: int, data: bytes) -> None:
    """Update a hash with topic, log time [ns] and CDR bytes of one message."""
    sha256.update(b"%s %d %d " % (topic.encode(), log_time_ns, len(data)))
    sha256.update(data)
