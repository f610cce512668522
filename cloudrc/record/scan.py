"""A recording as far as it goes: an MCAP file of any worth goes in, its whole records come out.

What cannot be read is left out and counted by kind; after a break in the chain of records the scan
goes on at the next chunk. Memory stays bounded by one record.
"""

from __future__ import annotations

import io
import os
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO

from cloudrc.record.frames import HEAD, MAGIC, RECORD_MAX, DamagedError, next_chunk, parse, unpack
from cloudrc.record.packages import missing

try:
    from mcap.opcode import Opcode
    from mcap.records import (
        Channel,
        Chunk,
        DataEnd,
        Footer,
        McapRecord,
        MessageIndex,
        Schema,
        Statistics,
    )
except ImportError as error:
    raise missing(error) from error

KNOWN = {int(opcode) for opcode in Opcode}
NAMES: dict[int, str] = {
    Opcode.CHUNK: "chunks",
    Opcode.ATTACHMENT: "attachments",
    Opcode.METADATA: "metadata",
    Opcode.MESSAGE: "messages",
}
ROOM_MIN, ROOM_SHARE = 16 << 20, 64
"""So much is unpacked of any file [bytes], and so many times the size of a longer one [1].

A writer's index alone takes 16 bytes of the file for each message, of which the longest has 750.
"""
RECORD_COST = 128
"""Taken for each record beside its bytes: in memory it is an object [bytes]."""
OF_THE_END = (DataEnd, Footer, Statistics)
"""Kinds that have no place in the data."""
DATA_END_SIZE = 4
END_SIZE = HEAD.size + 20 + len(MAGIC)
"""Of footer and closing magic [bytes]."""


@dataclass(slots=True)
class Summary:
    """What the end of a whole file repeats; its checksum was right.

    Attributes:
        start: Its first byte.
        definitions: Schemas and channels.
        messages: How many the file holds; None if it does not say.
    """

    start: int
    definitions: list[McapRecord] = field(default_factory=list)
    messages: int | None = None


class TooMuchError(ValueError):
    """A file that unpacks to more than any recording does."""


class Scan:
    """One pass over a file.

    Attributes:
        summary: The file's own, if it is whole.
        dropped: What could not be read, by kind: chunks, attachments, metadata, records; and the
            messages that the index of a damaged chunk tells of.
        skipped: How many bytes belong to no record [bytes].
        size: Of the file [bytes].
        is_mcap: Whether it begins as one.
        ended: Whether the end of the data was reached.
        checked: Whether the checksum over all data is right; None if there is none to compare.
        chunks: How many whole ones there were.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        """Look at both ends of a file.

        Args:
            stream: Binary and seekable.
        """
        self._stream = stream
        self.size = stream.seek(0, os.SEEK_END)
        self.dropped: Counter[str] = Counter()
        self.skipped = 0
        self.is_mcap = self.ended = False
        self.checked: bool | None = None
        self.chunks = 0
        self.summary = self._read_summary()
        self._room = max(ROOM_MIN, ROOM_SHARE * self.size)
        self._crc = 0
        self._broken = self._lost_chunk = False

    def definitions(self) -> list[McapRecord]:
        """Give the schemas and channels of the index, should a chunk with them be lost."""
        return self.summary.definitions if self.summary else []

    def records(self) -> Iterator[McapRecord]:
        """Give every whole record of the data, those in chunks included, in their order.

        Raises:
            TooMuchError: If it is made to fill the memory.
        """
        stream, at = self._stream, len(MAGIC)
        stream.seek(0)
        magic = stream.read(at)
        self.is_mcap = magic == MAGIC
        self._crc, self._broken = zlib.crc32(magic), not self.is_mcap
        if self._broken:
            at = self._resume(0, 0)
        end = self.summary.start if self.summary else self.size
        while at < end and not self.ended:
            stream.seek(at)
            head = stream.read(HEAD.size)
            opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
            if not opcode or length > min(RECORD_MAX, self.size - at - HEAD.size):
                at = self._resume(at, opcode)
                continue
            payload = stream.read(length)
            at += HEAD.size + length
            if opcode == Opcode.DATA_END and length == DATA_END_SIZE and at <= end:
                # Anything else of this opcode is a damaged record, not the end.
                if self.summary is None or at == end:
                    self._end(payload)
                    if self.summary is None:
                        self._leave_out(at)
                    continue
            self._crc = zlib.crc32(payload, zlib.crc32(head, self._crc))
            yield from self._take(opcode, payload)

    def _take(self, opcode: int, payload: bytes) -> Iterator[McapRecord]:
        try:
            record = parse(opcode, payload)
            if isinstance(record, Chunk):
                self._lost_chunk = True
                inside = unpack(record)
                self._lost_chunk = False
                self.chunks += 1
                self._take_room(record.uncompressed_size)
                for each in inside:
                    self._take_room(RECORD_COST)
                    yield each
                return
        except DamagedError:
            self._note(opcode)
            return
        if isinstance(record, MessageIndex):
            if self._lost_chunk:
                self.dropped["messages"] += len(record.records)
        elif isinstance(record, OF_THE_END) or opcode not in KNOWN:
            self._note(opcode)
        elif record is not None:
            yield record

    def _take_room(self, size: int) -> None:
        self._room -= size
        if self._room < 0:
            raise TooMuchError(
                f"its {self.size} bytes unpack to more than those of any recording; it is made to "
                "fill the memory, use another one"
            )

    def _end(self, payload: bytes) -> None:
        self.ended = True
        crc = int.from_bytes(payload, "little")
        if crc:
            self.checked = not self._broken and crc == self._crc

    def _leave_out(self, at: int) -> None:
        """Count what lies behind the end, such as a second recording: only the first is kept."""
        stream, start = self._stream, next_chunk(self._stream, at, self.size)
        if start is None:
            return
        self.skipped += self.size - start
        self._lost_chunk = True
        while start + HEAD.size <= self.size:
            stream.seek(start)
            opcode, length = HEAD.unpack(stream.read(HEAD.size))
            start += HEAD.size + length
            if start > self.size or opcode not in KNOWN:
                break
            if opcode == Opcode.CHUNK:
                self._note(opcode)
            elif opcode == Opcode.MESSAGE_INDEX and length <= RECORD_MAX:
                for _ in self._take(opcode, stream.read(length)):  # counts what was in the chunk
                    pass

    def _note(self, opcode: int) -> None:
        self.dropped[NAMES.get(opcode, "records")] += 1

    def _resume(self, broken: int, opcode: int) -> int:
        """Where to go on after a break in the chain at `broken`; counts what lies between."""
        self._broken = True
        found = next_chunk(self._stream, broken + 1 if broken else 0, self.size)
        if found is not None and broken:
            self._note(opcode)  # else it is but the end that was never written
        at = self.size if found is None else found
        self.skipped += at - broken
        return at

    def _read_summary(self) -> Summary | None:
        stream, start = self._stream, self.size - END_SIZE
        if start < len(MAGIC):
            return None
        stream.seek(start)
        end = stream.read(END_SIZE)
        try:
            footer = parse(end[0], end[HEAD.size : -len(MAGIC)])
        except DamagedError:
            return None
        if not isinstance(footer, Footer) or not end.endswith(MAGIC):
            return None
        first = footer.summary_start or start
        if not len(MAGIC) < first <= start or start - first > RECORD_MAX:
            return None
        stream.seek(first)
        data = stream.read(start - first)
        crc = zlib.crc32(end[: HEAD.size + 16], zlib.crc32(data))
        if footer.summary_crc not in (0, crc):
            return None
        return _summary(first, data)


def _summary(start: int, data: bytes) -> Summary | None:
    summary, stream = Summary(start), io.BytesIO(data)
    try:
        while head := stream.read(HEAD.size):
            opcode, length = HEAD.unpack(head)
            record = parse(opcode, stream.read(min(length, len(data))))
            if isinstance(record, Schema | Channel):
                summary.definitions.append(record)
            elif isinstance(record, Statistics):
                summary.messages = record.message_count
    except (DamagedError, ValueError):
        return None
    except Exception:  # struct.error: a head that is cut short
        return None
    return summary
