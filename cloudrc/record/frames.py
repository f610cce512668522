"""MCAP's records as bytes: where one begins and ends, and what it holds, within bounds.

A file may come from a killed process, a bad disk or somebody who means harm: no length in it is
believed before it is compared with what is there and with a limit.
"""

from __future__ import annotations

import io
import re
import struct
import zlib
from collections.abc import Iterator
from typing import IO, Any

from cloudrc.record.packages import missing

try:
    import zstandard
    from mcap import records as kinds
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Chunk, McapRecord
except ImportError as error:
    raise missing(error) from error

RECORD_MAX = 64 << 20
"""Longest record that is read [bytes]."""
CHUNK_MAX = 16 << 20
"""Longest chunk after decompression [bytes]; ours are closed after 1 MiB, those of others 4."""
DEFINITION_MAX = 1 << 20
"""Longest schema or channel [bytes]: the parts of one become many objects."""
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
_MARK_OFFSET = 37  # of the name of its compression, from a chunk's first byte
_BLOCK_MIN, _BLOCK_MAX = 1 << 12, 1 << 20
"""Searched at a time [bytes]: little at first, for there may be a break after every chunk."""


class DamagedError(ValueError):
    """Bytes that are not the record that they claim to be."""


class _Exact(io.BytesIO):
    """Bytes of which nobody gets fewer than asked for; mcap's reader would take what there is."""

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        if size is None or size < 0 or len(data) < size:
            raise DamagedError("too short")
        return data


def parse(opcode: int, payload: bytes) -> McapRecord | None:
    """Read one record.

    Returns:
        The record, or None if it is of a kind that nobody needs.

    Raises:
        DamagedError: If it is not what it claims to be.
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
    except Exception as error:  # whatever a record of nonsense brings up in the library
        raise DamagedError(f"{type(error).__name__}: {error}") from error
    if opcode == Opcode.ATTACHMENT:
        (crc,) = struct.unpack("<I", payload[-4:])
        if crc and crc != zlib.crc32(payload[:-4]):
            raise DamagedError("checksum")
    return record


def unpack(chunk: Chunk) -> Iterator[McapRecord]:
    """Take a chunk apart, all of which is looked at first: millions of records may be in it.

    Returns:
        Its records, each read when it is asked for.

    Raises:
        DamagedError: At once, if its checksum or anything in it is wrong, or it is longer than
            CHUNK_MAX.
    """
    data = _decompressed(chunk)
    if len(data) != chunk.uncompressed_size:
        raise DamagedError("length")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise DamagedError("checksum")
    for opcode, start, end in _inside(data):
        if opcode == Opcode.MESSAGE:
            if end - start < _MESSAGE.size:
                raise DamagedError("too short")
        elif opcode in _DEFINITIONS:
            parse(opcode, data[start:end])
        elif opcode in _CLASSES:
            raise DamagedError("a record that has no place in a chunk")
    records = (parse(opcode, data[start:end]) for opcode, start, end in _inside(data))
    return (record for record in records if record is not None)


def _inside(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, first byte and the byte after the last of each record's payload."""
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
    """Never more than the chunk says, and it may not say more than CHUNK_MAX."""
    size = chunk.uncompressed_size
    if size > CHUNK_MAX:
        raise DamagedError("too long")
    if chunk.compression == "":
        return chunk.data
    if chunk.compression != "zstd":
        raise DamagedError(f"compression {chunk.compression}")
    try:
        # Not `decompress`: it believes the length in the frame and makes room for it at once.
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            data: bytes = reader.read(size + 1)
    except zstandard.ZstdError as error:
        raise DamagedError("compression") from error
    return data


def next_chunk(stream: IO[bytes], start: int, size: int) -> int | None:
    """Find where, from `start` on, the next record is that looks like a chunk.

    Args:
        stream: The file; is left anywhere.
        start: First byte that may belong to it.
        size: Of the file [bytes].
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
    """Where the names of compressions stand, in the order of the file."""
    length = _BLOCK_MIN
    while start < size:
        stream.seek(start)
        block = stream.read(length + _MARK_MAX - 1)
        for mark in _MARK.finditer(block):
            if mark.start() < length:
                yield start + mark.start()
        start += length
        length = min(2 * length, _BLOCK_MAX)
