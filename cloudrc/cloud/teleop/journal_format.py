"""The journal's bytes: entries come in, records go out; bytes come in, every whole entry goes out.

    file    MAGIC, then records
    record  MARK, length, number, CRC-32 of length, number and payload; then the payload: JSON

All numbers are little-endian. The payload is plain ASCII and the mark begins with a byte that is
not, so after damage the next record is found by its mark. Numbers rise by one from record to record
of a file: what is missing between two of them is known to be lost.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable
from typing import Any, NamedTuple, TypeAlias

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
