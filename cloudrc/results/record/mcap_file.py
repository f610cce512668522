# SPDX-License-Identifier: Apache-2.0

"""Write an MCAP file: the same bytes as the writer of the package mcap, in less time.

The package makes an object of each message, and packs each of its numbers alone. Here a message is
packed at once, and a file without an index keeps no list of its chunks.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from io import BufferedWriter, RawIOBase
from struct import Struct, pack
from typing import IO, Any

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

CHUNK_BYTES = 1024 * 1024
"""Size at which a chunk ends [bytes]."""
COMPRESSION = "zstd"
HEAD, MESSAGE = Struct("<BQ"), Struct("<HIQQ")
"""Begin of a record: opcode, length [bytes]; of a message: channel, number, two times [ns]."""
_pack_message = Struct("<BQHIQQ").pack  # head, channel, number, log time, publish time
_INDEX_BYTES = Struct("<HI").size


def bytes_of(*records: Any) -> bytes:
    """Return the bytes of records of the package mcap."""
    builder: Any = RecordBuilder()  # without type annotations
    for record in records:
        record.write(builder)
    found: bytes = builder.end()
    return found


@dataclass
class _Chunk:
    """The chunk that is being filled."""

    parts: list[bytes] = field(default_factory=list)
    size: int = 0  # of the parts [bytes]
    start_ns: int = 0  # smallest and largest log time of its messages [ns]
    end_ns: int = 0
    # Channel -> log time [ns] and place in the chunk [bytes] of each message, one after the other.
    indices: dict[int, list[int]] = field(default_factory=dict)


class McapFile:
    """An MCAP file that is being written; every method may raise an OSError."""

    def __init__(self, stream: IO[bytes] | RawIOBase, library: str, *, index: bool) -> None:
        """Begin a file of the profile `ros2`; without `index`, it gets no index of its messages.

        `library` is the name of the program that writes.
        """
        self._stream: Any = BufferedWriter(stream) if isinstance(stream, RawIOBase) else stream
        self._index, self._crc, self._chunk = index, 0, _Chunk()
        self._schemas, self._channels = list[Schema](), list[Channel]()
        self._chunks = list[ChunkIndex]()
        self._attached, self._noted = list[AttachmentIndex](), list[MetadataIndex]()
        self._counts: Statistics = Statistics(0, 0, {}, 0, 0, 0, 0, 0, 0)
        self._write(MCAP0_MAGIC)
        self._write(bytes_of(Header("ros2", library)))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema; return its number."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._add(bytes_of(schema))
        return len(self._schemas)

    def add_channel(
        self, topic: str, encoding: str, schema: int, metadata: Mapping[str, str]
    ) -> int:
        """Add a channel with the number of its schema; return its own number."""
        number = len(self._channels) + 1
        channel = Channel(number, topic, encoding, dict(metadata), schema)
        self._channels.append(channel)
        self._add(bytes_of(channel))
        return number

    def add_message(self, channel: int, number: int, now_ns: int, data: bytes) -> None:
        """Add a message with its sequence number; `now_ns` is both of its times [ns]."""
        chunk = self._chunk
        if not chunk.indices or now_ns < chunk.start_ns:
            chunk.start_ns = now_ns
        if now_ns > chunk.end_ns:
            chunk.end_ns = now_ns
        index = chunk.indices.get(channel)
        if index is None:
            index = chunk.indices[channel] = []
        index += now_ns, chunk.size
        length = MESSAGE.size + len(data)
        head = _pack_message(Opcode.MESSAGE, length, channel, number, now_ns, now_ns)
        chunk.parts += head, data
        chunk.size += HEAD.size + length
        if chunk.size > CHUNK_BYTES:
            self._end_chunk()

    def add_metadata(self, name: str, metadata: Mapping[str, str]) -> None:
        """Add metadata, at once."""
        offset, data = self._stream.tell(), bytes_of(Metadata(name, dict(metadata)))
        self._counts.metadata_count += 1
        self._noted.append(MetadataIndex(offset=offset, length=len(data), name=name))
        self._write(data)

    def attach(self, name: str, kind: str, log_time_ns: int, content: bytes) -> None:
        """Attach a file of a media type, at once; `log_time_ns` is in [ns]."""
        offset = self._stream.tell()
        data = bytes_of(Attachment(0, log_time_ns, name, kind, content))
        self._counts.attachment_count += 1
        place = AttachmentIndex(offset, len(data), log_time_ns, 0, len(content), name, kind)
        self._attached.append(place)
        self._write(data)

    def flush(self) -> None:
        """Complete the present chunk and pass it to the operating system."""
        self._end_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the summary; the caller closes the stream."""
        self._end_chunk()
        self._write(bytes_of(DataEnd(self._crc)))
        start, summary, offsets = self._stream.tell(), b"", list[SummaryOffset]()
        counts = self._counts
        counts.schema_count, counts.channel_count = len(self._schemas), len(self._channels)
        groups: list[tuple[Opcode, list[Any]]] = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, [counts]),
            *([(Opcode.CHUNK_INDEX, self._chunks)] if self._index else []),
            (Opcode.ATTACHMENT_INDEX, self._attached),
            (Opcode.METADATA_INDEX, self._noted),
        ]
        for opcode, records in groups:
            group = bytes_of(*records)
            offsets.append(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
        offset = start + len(summary)
        summary += bytes_of(*offsets)
        # The checksum has the head of the footer, too: opcode, length, and both places.
        places = pack("<BQQQ", Opcode.FOOTER, 8 + 8 + 4, start, offset)
        self._stream.write(summary)
        self._stream.write(bytes_of(Footer(start, offset, zlib.crc32(places, zlib.crc32(summary)))))
        self._stream.write(MCAP0_MAGIC)
        self._stream.flush()

    def _write(self, data: bytes) -> None:
        self._crc = zlib.crc32(data, self._crc)
        self._stream.write(data)

    def _add(self, record: bytes) -> None:
        """Add a schema or a channel to the present chunk."""
        self._chunk.parts.append(record)
        self._chunk.size += len(record)
        if self._chunk.size > CHUNK_BYTES:
            self._end_chunk()

    def _end_chunk(self) -> None:
        """Write the present chunk, if it has messages."""
        chunk, counts = self._chunk, self._counts
        if not chunk.indices:
            return
        self._chunk, data = _Chunk(), b"".join(chunk.parts)
        is_first = not counts.chunk_count
        counts.chunk_count += 1
        earlier = chunk.start_ns < counts.message_start_time
        counts.message_start_time = (
            chunk.start_ns if is_first or earlier else counts.message_start_time
        )
        counts.message_end_time = max(counts.message_end_time, chunk.end_ns)
        for channel, index in chunk.indices.items():
            of_channel = counts.channel_message_counts.get(channel, 0) + len(index) // 2
            counts.channel_message_counts[channel] = of_channel
            counts.message_count += len(index) // 2

        compressed = zstandard.compress(data)
        place = self._stream.tell()
        times = chunk.end_ns, chunk.start_ns
        written = bytes_of(Chunk(COMPRESSION, compressed, *times, zlib.crc32(data), len(data)))
        self._write(written)
        if not self._index:
            return
        first = end = self._stream.tell()
        places, parts = {}, list[bytes]()
        for channel, index in chunk.indices.items():
            places[channel], length = end, 8 * len(index)
            head = pack("<BQHI", Opcode.MESSAGE_INDEX, _INDEX_BYTES + length, channel, length)
            parts += head, pack(f"<{len(index)}Q", *index)
            end += len(head) + length
        self._write(b"".join(parts))
        sizes = len(compressed), chunk.end_ns, end - first, places, chunk.start_ns, len(data)
        self._chunks.append(ChunkIndex(len(written), place, COMPRESSION, *sizes))
