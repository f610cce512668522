"""Read an MCAP file, even if it is torn or damaged, as far as it is readable.

A killed process leaves a file without an end, which is read up to the last complete chunk. Damaged
parts are skipped and counted by kind; the scan continues at the next chunk. A file may also be
hostile, so each length in it is checked against the file and a limit before it is used. Memory is
bounded by one record.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BufferedReader
from itertools import chain
from pathlib import Path
from typing import IO, Any

from cloudrc.errors import BadInputError, to_one_line
from cloudrc.files import open_file
from cloudrc.record import missing
from cloudrc.record.ros import is_known
from cloudrc.record.topics import TOPICS
from cloudrc.record.writer import MISSING

try:
    import zstandard
    from mcap import records as kinds
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import (
        Attachment,
        Channel,
        Chunk,
        DataEnd,
        Footer,
        McapRecord,
        Message,
        MessageIndex,
        Metadata,
        Schema,
        Statistics,
    )
except ImportError as error:
    raise missing(error) from error

RECORD_MAX = 64 << 20
"""Longest record that is read [bytes]."""
CHUNK_MAX = 16 << 20
"""Longest chunk after decompression [bytes]; ours end after 1 MiB, those of other tools after 4."""
DEFINITION_MAX = 1 << 20
"""Longest schema or channel [bytes]; its parts become many objects in memory."""
HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
MAGIC = b"\x89MCAP0\r\n"

_CLASSES: dict[int, Any] = {
    Opcode.HEADER: kinds.Header,
    Opcode.SCHEMA: kinds.Schema,
    Opcode.CHANNEL: kinds.Channel,
    Opcode.CHUNK: kinds.Chunk,
    Opcode.MESSAGE_INDEX: kinds.MessageIndex,
    Opcode.ATTACHMENT: kinds.Attachment,
    Opcode.METADATA: kinds.Metadata,
    Opcode.STATISTICS: kinds.Statistics,
    Opcode.DATA_END: kinds.DataEnd,
    Opcode.FOOTER: kinds.Footer,
}
_DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_MARK = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")
_MARK_MAX = 8
_MARK_OFFSET = 37  # from a chunk's first byte to the name of its compression
_BLOCK_MIN, _BLOCK_MAX = 1 << 12, 1 << 20
"""Smallest and largest block of a search for chunks [bytes]. The first block is small, since each
chunk may be damaged; each further one is twice as large."""


class DamagedError(ValueError):
    """Bytes that are not a valid record of their kind."""


class _Exact(io.BytesIO):
    """Bytes whose `read` fails at the end; mcap's reader would accept fewer bytes."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is None or size < 0 or len(data) < size:
            raise DamagedError("too short")
        return data


def parse(opcode: int, payload: bytes) -> McapRecord | None:
    """Parse one record.

    Returns:
        The record, or None for a kind that is not used.

    Raises:
        DamagedError: If the bytes are not a valid record.
    """
    try:
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(payload)
            data = payload[_MESSAGE.size :]
            return kinds.Message(channel, log_time, data, publish_time, sequence)
        if opcode not in _CLASSES:
            return None
        if opcode in _DEFINITIONS and len(payload) > DEFINITION_MAX:
            raise DamagedError("too long")
        record: McapRecord = _CLASSES[opcode].read(ReadDataStream(_Exact(payload)))
    except DamagedError:
        raise
    except Exception as error:  # the library may raise anything on a malformed record
        raise DamagedError(f"{type(error).__name__}: {error}") from error
    if opcode == Opcode.ATTACHMENT:
        (crc,) = struct.unpack("<I", payload[-4:])
        if crc and crc != zlib.crc32(payload[:-4]):
            raise DamagedError("checksum")
    return record


def unpack(chunk: Chunk) -> Iterator[McapRecord]:
    """Split a chunk into its records, after a check of all of it.

    Returns:
        Its records, parsed one at a time, since a chunk may hold millions.

    Raises:
        DamagedError: If its checksum or anything in it is wrong, or it is longer than CHUNK_MAX;
            raised before the first record.
    """
    data = _decompressed(chunk)
    if len(data) != chunk.uncompressed_size:
        raise DamagedError("length")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise DamagedError("checksum")
    for opcode, start, end in _payloads(data):
        if opcode == Opcode.MESSAGE:
            if end - start < _MESSAGE.size:
                raise DamagedError("too short")
        elif opcode in _DEFINITIONS:
            parse(opcode, data[start:end])
        elif opcode in _CLASSES:
            raise DamagedError("a chunk must not hold this record")
    records = (parse(opcode, data[start:end]) for opcode, start, end in _payloads(data))
    return (record for record in records if record is not None)


def _payloads(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the opcode of each record, and the start and end of its payload."""
    at = 0
    while at < len(data):
        if at + HEAD.size > len(data):
            raise DamagedError("too short")
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        if length > len(data) - at:
            raise DamagedError("too short")
        yield opcode, at, at + length
        at += length


def _decompressed(chunk: Chunk) -> bytes:
    """Decompress a chunk to at most the size that it states, which is at most CHUNK_MAX."""
    size = chunk.uncompressed_size
    if size > CHUNK_MAX:
        raise DamagedError("too long")
    if chunk.compression == "":
        return chunk.data
    if chunk.compression != "zstd":
        raise DamagedError(f"compression {chunk.compression}")
    try:
        # Not `decompress`, which allocates the length that the frame states without a check.
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            data: bytes = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise DamagedError("compression") from error
    return data


def next_chunk(stream: IO[bytes], start: int, size: int) -> int | None:
    """Find the position of the next record from `start` on that looks like a chunk.

    Args:
        stream: The file; its position changes.
        start: First byte to search.
        size: Size of the file [bytes].
    """
    for place in _marks(stream, start + _MARK_OFFSET, size):
        at = place - _MARK_OFFSET
        stream.seek(at)
        head = stream.read(_MARK_OFFSET + 16)
        opcode, length = HEAD.unpack_from(head)
        name = 4 + int.from_bytes(head[_MARK_OFFSET : _MARK_OFFSET + 4], "little")
        stream.seek(place + name)
        data = int.from_bytes(stream.read(8), "little")
        whole = length == _MARK_OFFSET - HEAD.size + name + 8 + data
        if opcode == Opcode.CHUNK and whole and at + HEAD.size + length <= size:
            return at
    return None


def _marks(stream: IO[bytes], start: int, size: int) -> Iterator[int]:
    """Yield the positions of compression names, in the order of the file."""
    length = _BLOCK_MIN
    while start < size:
        stream.seek(start)
        block = stream.read(length + _MARK_MAX - 1)
        for mark in _MARK.finditer(block):
            if mark.start() < length:
                yield start + mark.start()
        start += length
        length = min(2 * length, _BLOCK_MAX)


KNOWN = {int(opcode) for opcode in Opcode}
NAMES: dict[int, str] = {
    Opcode.CHUNK: "chunks",
    Opcode.ATTACHMENT: "attachments",
    Opcode.METADATA: "metadata",
    Opcode.MESSAGE: "messages",
}
ROOM_MIN, ROOM_SHARE = 16 << 20, 64
"""Limit of the unpacked size of a file: `ROOM_MIN` [bytes] or `ROOM_SHARE` times its size [1].

A valid file stays below: its index takes 16 bytes for each message, and a message has at most 750.
"""
RECORD_COST = 128
"""Memory counted for each record's object, beside its bytes [bytes]."""
OF_THE_END = (DataEnd, Footer, Statistics)
"""Record types that must not occur in the data."""
DATA_END_SIZE = 4
"""Size of the payload of a data end record [bytes]."""
END_SIZE = HEAD.size + 20 + len(MAGIC)
"""Size of the footer and the closing magic [bytes]."""


@dataclass(slots=True)
class Summary:
    """The summary at the end of a complete file, with a valid checksum.

    Attributes:
        start: Position of its first byte.
        definitions: Schemas and channels.
        messages: Number of messages in the file; None if it is not stated.
    """

    start: int
    definitions: list[McapRecord] = field(default_factory=list)
    messages: int | None = None


class TooMuchError(ValueError):
    """A file that unpacks to more than any valid recording."""


class Scan:
    """One pass over a file.

    Attributes:
        summary: The summary of a complete file; None for another one.
        dropped: Number of damaged chunks, attachments, metadata and records, by kind; also of the
            messages that the index lists for a damaged chunk.
        skipped: Bytes that belong to no record [bytes].
        size: Size of the file [bytes].
        is_mcap: Whether the file begins with MCAP's magic.
        ended: Whether the end of the data was reached.
        checked: Whether the checksum over all data is right; None without a checksum.
        chunks: Number of intact chunks.
    """

    def __init__(self, stream: IO[bytes]) -> None:
        """Read the size and the summary of a file.

        Args:
            stream: The file, binary and seekable.
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
        """Return the summary's definitions; the chunk that holds them may be lost."""
        return self.summary.definitions if self.summary else []

    def records(self) -> Iterator[McapRecord]:
        """Yield every intact record of the data in order, including those in chunks.

        Raises:
            TooMuchError: If the file unpacks to more than any valid recording.
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
                # A record of this opcode elsewhere is damaged and not the end.
                if self.summary is None or at == end:
                    self._end(payload)
                    if self.summary is None:
                        self._count_rest(at)
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
                f"its {self.size} bytes unpack to more than those of any recording and would fill "
                "the memory; use another file"
            )

    def _end(self, payload: bytes) -> None:
        self.ended = True
        crc = int.from_bytes(payload, "little")
        if crc:
            self.checked = not self._broken and crc == self._crc

    def _count_rest(self, at: int) -> None:
        """Count the chunks and messages after the end, such as a second recording, as lost."""
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
        """Find the position to continue after the damage at `broken`; count what is skipped."""
        self._broken = True
        found = next_chunk(self._stream, broken + 1 if broken else 0, self.size)
        if found is not None and broken:
            self._note(opcode)  # if no chunk follows, only the end is missing
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


@dataclass(slots=True)
class Contents:
    """The contents of a file.

    Attributes:
        messages: Topic, log time [ns] and CDR bytes of each, in the order of the file.
        metadata: All metadata of the file; later values of a key replace earlier ones.
        attachments: The attached files by name.
        note: What is missing, in words; "" if nothing is missing.
    """

    messages: list[tuple[str, int, bytes]] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    note: str = ""


def read_contents(path: Path) -> Contents:
    """Read a file as far as it is readable.

    Args:
        path: An MCAP file, possibly torn.

    Returns:
        All messages of intact chunks.

    Raises:
        BadInputError: If nothing in it is readable, or it unpacks to more than any recording.
    """
    try:
        with BufferedReader(open_file(path)) as stream:
            collector = _Collector()
            scan = collector.pass_over(stream)
            if collector.came_late:
                collector = _Collector(collector)
                scan = collector.pass_over(stream)
    except OSError as error:
        raise BadInputError(
            f"{path}: cannot be read ({error.strerror}); name a recording (.mcap)"
        ) from error
    except TooMuchError as error:
        raise BadInputError(f"{path}: {error}") from error
    except ValueError as error:
        raise BadInputError(f"{error}; name a recording (.mcap)") from error
    contents = collector.finish(scan)
    if not scan.ended and not contents.messages:
        reason = "is cut short or damaged" if scan.is_mcap else "is not an MCAP file"
        raise BadInputError(
            f"{path}: holds no readable message: it {reason}; name another recording"
        )
    return contents


class _Collector:
    """Collects the contents of MCAP records.

    Attributes:
        contents: The contents collected so far.
        came_late: Whether a channel was defined after messages of its own. These messages are
            read in a second pass, which knows the channels of the first.
    """

    def __init__(self, before: _Collector | None = None) -> None:
        self.contents = Contents()
        self.came_late = False
        self._foreign: set[str] = set()
        self._types: dict[int, tuple[str, str]] = {}
        self._topics: dict[int, str] = dict(before._topics) if before else {}
        self._without_channel: set[int] = set()

    def pass_over(self, stream: IO[bytes]) -> Scan:
        """Collect the contents of a file."""
        scan = Scan(stream)
        for record in chain(scan.definitions(), scan.records()):
            self.take(record)
        return scan

    def take(self, record: McapRecord) -> None:
        contents = self.contents
        if isinstance(record, Message):
            topic = self._topics.get(record.channel_id)
            if topic is None:
                self._without_channel.add(record.channel_id)
            else:
                contents.messages.append((topic, record.log_time, record.data))
        elif isinstance(record, Schema):
            self._types[record.id] = record.name, record.data.decode("utf-8", "replace")
        elif isinstance(record, Channel):
            self._open(record)
        elif isinstance(record, Metadata):
            contents.metadata.update(record.metadata)
        elif isinstance(record, Attachment):
            contents.attachments[record.name] = record.data

    def _open(self, channel: Channel) -> None:
        ros_type, text = self._types.get(channel.schema_id, ("", ""))
        topic = TOPICS.get(channel.topic)
        known = topic is not None and topic.ros_type == ros_type and is_known(ros_type, text)
        if known:
            self._topics[channel.id] = channel.topic
            self.came_late |= channel.id in self._without_channel
        else:
            self._topics.pop(channel.id, None)
            self._foreign.add(channel.topic)

    def finish(self, scan: Scan) -> Contents:
        """Add the note to the contents."""
        messages, notes = self.contents.messages, []
        if not scan.ended:
            until = messages[-1][1] * 1e-9 if messages else 0.0
            notes.append(
                f"cut short: {len(messages)} messages were read, the last at {until:.2f} s"
            )
        elif scan.summary is None:
            notes.append(f"cut short in its index: all {len(messages)} messages were read")
        for kind, count in scan.dropped.items():
            if kind != "messages":
                notes.append(f"{count} damaged {kind} were left out")
        if scan.checked is False and not scan.dropped:
            notes.append("a byte outside the chunks is wrong")
        if self._foreign:
            names = to_one_line(", ".join(sorted(self._foreign)))
            notes.append(f"topics of another layout were left out: {names}")
        notes.append(to_one_line(self.contents.metadata.get(MISSING, "")))
        self.contents.note = "; ".join(filter(None, notes))
        return self.contents
