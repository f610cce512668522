"""Read or repair an MCAP file: all of it, or what a kill or damage has left.

A killed process leaves a file without an end; this module reads it up to its last complete chunk.
In a damaged file, it goes on behind the damage: the file's index says where, or a search finds the
next intact part. The package `mcap` parses the format. This module limits the unpacked size, and
describes in words what is missing.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BufferedReader, BytesIO
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import lz4.frame
import zstandard
from mcap import records as mcap
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import MCAP0_MAGIC

from cloudrc.errors import BadInputError, to_one_line
from cloudrc.files import open_file
from cloudrc.record.content import FOLLOWED, Content
from cloudrc.record.holes import END_NS, SOMEWHERE, Hole, between, of_metadata, union
from cloudrc.record.ros import converter
from cloudrc.record.topics import TOPICS, VIEWS
from cloudrc.record.writer import CHANGED, CLOCK, COUNTS, MISSING
from cloudrc.renamed import with_new_columns

UNPACKED_MAX = 64
"""Largest ratio of a recording's size in memory to its size in the file; a file below 1 MiB counts
as 1 MiB. Recordings of flights need a ratio of 10, recordings of an idle robot 30."""
MESSAGE_COST = 128
"""Memory for a message's Python objects, in addition to its content [bytes]."""
LISTED_MAX = 3
"""Largest number of topics or damaged places that an error message lists."""
UNKNOWN = "unknown"
"""In place of the topic of messages whose topic is lost."""
RECORD_HEAD_SIZE = 9
"""Size of a record's opcode and length [bytes]."""
_BEGINNING = re.compile(
    b"(?s)[%c%c%c%c%c](?=.{4}\\0{4})"
    % (
        Opcode.CHUNK,
        Opcode.MESSAGE_INDEX,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
        Opcode.DATA_END,
    )
)
"""Where a record may begin behind damage: its opcode, then a length below 4 GiB."""
_SELF_CHECKED = mcap.Chunk | mcap.Attachment | mcap.Footer
"""Records with a checksum, or with a fixed text behind them."""
KINDS = {
    b"": "is empty; name a recording (.mcap)",
    b"#ROSBAG V": "is a ROS 1 bag, not an MCAP file; convert it with: rosbags-convert",
    b"SQLite format 3": "is an SQLite file, not MCAP; convert it with: ros2 bag convert",
}
"""First bytes of a file that is not MCAP -> text of the error about the file."""


class NothingReadableError(BadInputError):
    """The file contains no readable message, for example because the process was killed early."""


class _StopError(Exception):
    """The reader cannot go on, although the file may be intact; the text says why."""


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {
    "": lambda data, size: data,
    "zstd": lambda data, size: (
        zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True).read(size)
    ),
    "lz4": lambda data, size: lz4.frame.LZ4FrameDecompressor().decompress(data, size),
}
"""Compression -> function that unpacks up to a given size [bytes]. The functions of `mcap` are not
used, because they allocate whatever size the file claims."""


class FilePart(NamedTuple):
    """A chunk, an attachment or a metadata record of a file."""

    start: int  # position in the file [bytes]
    size: int  # [bytes]
    content: str  # what the index says about its content; "" if nothing


@dataclass(slots=True)
class _Found:
    """What a search has found in a damaged file."""

    parts: list[FilePart] = field(default_factory=list)  # intact records, by position
    holes: list[FilePart] = field(default_factory=list)  # damage between them, by position
    size: int = 0  # size of the file up to its end, or up to its last intact record [bytes]
    data_ended: bool = False  # whether nothing is missing behind the last part
    ended: bool = False  # whether the file has an end
    channels: dict[int, mcap.Channel] = field(default_factory=dict)  # as the index says
    schemas: dict[int, mcap.Schema] = field(default_factory=dict)  # as the index says
    statistics: mcap.Statistics | None = None  # as the index says
    index: int = 0  # where the index begins, behind the data [bytes]; 0: not found
    attachments: set[str] = field(default_factory=set)  # names, as the index says
    chunks: set[bytes] = field(default_factory=set)  # contents of the intact chunks

    def take(self, record: mcap.McapRecord, content: bytes, position: int) -> None:
        """Note the intact record at `position`, whose bytes are `content`."""
        part = FilePart(position, len(content), "")
        if isinstance(record, mcap.Footer):
            self.ended = self.data_ended = True
            self.index = self.index or record.summary_start
        elif isinstance(record, mcap.DataEnd):
            self.data_ended, self.index = True, position + len(content)
        elif content in self.chunks:  # inserted bytes repeat it
            self.holes.append(part)
        elif not self.index:
            self.parts.append(part)
            if isinstance(record, mcap.Chunk):
                self.chunks.add(content)

    def read_index(self, data: bytes) -> None:
        """Read the index up to the file's end, unless its checksum is wrong."""
        start = self.index
        checked = data[start : self.size - len(MCAP0_MAGIC) - 4]  # up to the checksum itself
        checksum = int.from_bytes(data[start + len(checked) :][:4], "little")
        if not 0 < start < self.size or checksum not in (0, zlib.crc32(checked)):
            return
        stream = BytesIO(data[start : self.size])
        contents: dict[int, str] = {}  # position of a part -> its content, in words
        with suppress(Exception):  # without a checksum, the bytes may be anything
            for record in StreamReader(stream, skip_magic=True, emit_chunks=True).records:
                self._store(record, contents)
        # If bytes were lost or inserted, the positions hold up to the first damage only.
        self.holes = [FilePart(at, size, contents.get(at, was)) for at, size, was in self.holes]

    def _store(self, record: mcap.McapRecord, contents: dict[int, str]) -> None:
        if isinstance(record, mcap.ChunkIndex):
            times = record.message_start_time * 1e-9, record.message_end_time * 1e-9
            contents[record.chunk_start_offset] = f"{times[0]:.2f} to {times[1]:.2f} s"
        elif isinstance(record, mcap.AttachmentIndex):
            self.attachments.add(record.name)
        elif isinstance(record, mcap.Channel):
            self.channels[record.id] = record
        elif isinstance(record, mcap.Schema):
            self.schemas[record.id] = record
        elif isinstance(record, mcap.Statistics):
            self.statistics = record


class File:
    """Reads one MCAP file, including its chunks, and goes on behind damaged parts if it can.

    The records of an intact file are read in their order. In a damaged file, a search finds the
    next intact record: lost or inserted bytes have moved it, so that no index says where it is.
    """

    def __init__(self, path: Path) -> None:
        """Read a file; raise a BadInputError if it cannot be read or is not MCAP."""
        self._path = path
        self._unreadable = ""  # in words: why cloudrc cannot unpack some chunks
        try:
            self._stream = BufferedReader(open_file(path))
        except (OSError, ValueError) as error:  # ValueError: a pipe or a device
            reason = getattr(error, "strerror", "not a file")
            raise BadInputError(
                f"{path}: cannot be read: {reason}; name a recording (.mcap)"
            ) from error
        with self._stream:
            self.size = os.fstat(self._stream.fileno()).st_size  # [bytes]
            self._clear()
            self._read()
        if not self.content.messages and (self.gaps or not self.data_ended):
            damage = _describe(self.gaps) if self.gaps else ""
            reasons = [self._unreadable or damage, self.fault]
            reason = "; ".join(filter(None, reasons))
            raise NothingReadableError(
                f"{path}: holds no readable message: {reason}; name another recording"
            )
        self._sort()
        _note(self)

    def _clear(self) -> None:
        self.content = Content(source=str(self._path))
        self.position = 0  # end of the last intact record in the file [bytes]
        self.data_ended = False  # whether all messages were read; only the index follows
        self.ended = False  # whether the whole file was read
        self._is_proven = False  # whether a checksum proves all that is before the index
        self.fault = ""  # why reading stopped or what is wrong, in words; "" if nothing is wrong
        self.cut = False  # whether the file breaks off at the fault, as after a kill
        self.gaps = list[FilePart]()  # what was left out
        self.listed = set[str]()  # names of attachments in the index of a damaged file
        # Position, first and last log time [ns] of each part with messages; of a damaged file only.
        self.spans = list[tuple[int, int, int]]()
        self.read = Counter[int]()  # channel -> number of messages, also of other programs
        self.statistics: mcap.Statistics | None = None
        self.channels: dict[int, mcap.Channel] = {}
        # Channel -> converter of its messages; None if cloudrc does not record its topic so.
        self.ours: dict[int, Callable[[bytes], bytes] | None] = {}
        self._schemas: dict[int, mcap.Schema] = {}
        self.nameless = set[int]()  # positions of parts with messages whose topic is lost
        self._sequences = array("L")
        self._room = UNPACKED_MAX * max(self.size, 1 << 20)

    def _read(self) -> None:
        head = self._stream.peek(16)[:16]
        begins = head.startswith(MCAP0_MAGIC)
        may_be_damaged = not begins or self._try(self._read_records)
        index_is_wrong = self.fault.startswith("damaged") or not self._is_counted()
        if self._is_proven and not self.gaps and index_is_wrong:
            self.content.remarks += ("had a damaged index: all its messages were read",)
            self.fault, self.statistics = "", None
        if self.gaps and self.data_ended:  # thus the checksum of all data is wrong, too
            self.fault = ""
        found = None
        if may_be_damaged and (self.gaps or not self.data_ended):
            with suppress(_StopError):
                found = self._search(len(MCAP0_MAGIC) if begins else 0)
        if found:
            self._clear()
            self._try(lambda: self._read_parts(found))
        elif not begins:
            kind = next((k for k in KINDS if k and head.startswith(k)), head.strip(b"\0"))
            text = KINDS.get(kind, "is not an MCAP file; name a recording (.mcap)")
            raise (BadInputError if kind else NothingReadableError)(f"{self._path}: {text}")

    def _try(self, read: Callable[[], None]) -> bool:
        """Read; note an error as the fault. Return whether the file's bytes may be the cause."""
        try:
            read()
            return bool(self.gaps)
        except CRCValidationError:
            self.fault = "damaged: a checksum is wrong"
        except (EndOfFile, RecordLengthLimitExceeded):  # a record longer than the rest of the file
            self.fault, self.cut = "cut short", True
        except _StopError as error:
            self.fault = str(error)
            return False
        except OSError as error:
            self.fault = f"unreadable: {error.strerror}"
            return False
        except Exception:  # the library may raise anything on damaged bytes
            self.cut = self._stream.tell() >= self.size
            self.fault = "cut short" if self.cut else "damaged"
        return True

    def _read_records(self) -> None:
        reader = StreamReader(
            self._stream, emit_chunks=True, validate_crcs=True, record_size_limit=self.size
        )
        for record in reader.records:
            end = self._stream.tell()
            if isinstance(record, mcap.Chunk):
                self._store_chunk(record, FilePart(self.position, end - self.position, ""))
            elif not self.data_ended:  # records after the data repeat the definitions
                self._store(record)
            if isinstance(record, mcap.Statistics):
                self.statistics = record
            if isinstance(record, mcap.DataEnd):
                self.data_ended = True
                self._is_proven = bool(record.data_section_crc)  # a wrong one is an error
            self.position = end
        self.position = self._stream.tell()
        self.ended = self.data_ended = True
        self._see_what_follows()

    def _see_what_follows(self) -> None:
        """Note what follows the end of the file: another recording, or bytes that add nothing."""
        self._stream.seek(self.position)
        rest = self._stream.read()
        has_records = MCAP0_MAGIC in rest or self._next_intact(rest, 0) < len(rest)
        if has_records and not self._is_repeated_by(rest):
            self.fault = FOLLOWED
        elif rest:
            self.content.remarks += (f"had {len(rest)} bytes behind its end, which were left out",)
            self.position = self.size

    def _is_repeated_by(self, rest: bytes) -> bool:
        """Return whether what follows the file is the same file again, or its beginning."""
        self._stream.seek(0)
        own = self._stream.read(self.position)
        return (own * (len(rest) // len(own) + 1)).startswith(rest)

    def _read_parts(self, found: _Found) -> None:
        """Read the intact parts of a damaged file."""
        self.channels |= found.channels
        self._schemas |= found.schemas
        self.statistics, self.gaps, self.listed = found.statistics, found.holes, found.attachments
        kinds = Counter[type]()
        for part in found.parts:
            self.position = part.start
            self._stream.seek(part.start)
            record = _parse(self._stream.read(part.size))
            kinds[type(record)] += 1
            before = len(self.content.messages)
            if isinstance(record, mcap.Chunk):
                self._store_chunk(record, part)
            else:
                self._store(record)
            if times := [message[1] for message in self.content.messages[before:]]:
                self.spans.append((part.start, min(times), max(times)))
        self.position, self.ended, self.data_ended = found.size, found.ended, found.data_ended
        if not self.data_ended:
            self.fault, self.cut = "cut short", True
        elif not self.gaps:
            self.fault = "damaged outside of its messages"
        elif self._has_all(kinds):
            self.content.remarks += (f"was {_describe(self.gaps)}; nothing is missing",)
            self.gaps = []
        if self.ended:
            self._see_what_follows()

    def _has_all(self, kinds: Counter[type]) -> bool:
        """Return whether all that the index counts was read; `kinds`: of records.

        The header may be damaged, since a copy gets its own.
        """
        counts = self.statistics
        return (
            counts is not None
            and self._is_counted()
            and kinds[mcap.Attachment] >= counts.attachment_count
            and kinds[mcap.Metadata] >= counts.metadata_count
        )

    def _is_counted(self) -> bool:
        """Return whether as many messages were read as the index counts, if it does."""
        counts = self.statistics
        return counts is None or self.read == Counter(counts.channel_message_counts)

    def _search(self, position: int) -> _Found | None:
        """Find the intact parts of a file from `position` on; None if there is none."""
        self._stream.seek(0)
        data, found = self._stream.read(), _Found()
        listed: dict[int, list[tuple[int, int]]] | None = None  # messages of the chunk before
        while position < len(data) and not found.ended:
            record, end = self._parse_at(data, position)
            if isinstance(record, mcap.Chunk):
                listed = self._list_messages(record)
            if isinstance(record, mcap.MessageIndex) and not _is_index_of(record, listed):
                found.holes.append(FilePart(position, end - position, "an index of messages"))
            elif record is not None:
                found.take(record, data[position:end], position)
            else:
                if not self._is_intact(data, end):  # the length is damaged, too
                    end = self._next_intact(data, position + 1)
                if end == len(data):
                    break  # the rest is lost
                found.holes.append(FilePart(position, end - position, ""))
                listed = None  # it may have been a chunk
            position = end
        found.size = position
        if found.ended:
            found.size += len(MCAP0_MAGIC)
            found.read_index(data)
        return found if found.parts else None

    def _list_messages(self, chunk: mcap.Chunk) -> dict[int, list[tuple[int, int]]]:
        """Return channel -> time and position in the intact `chunk`, for each of its messages."""
        listed: dict[int, list[tuple[int, int]]] = {}
        for at, record in self._unpack(chunk):
            if isinstance(record, mcap.Message):
                listed.setdefault(record.channel_id, []).append((record.log_time, at))
        return listed

    def _next_intact(self, data: bytes, start: int) -> int:
        """Return where the next intact record begins, from `start` on; the end if there is none."""
        places = (match.start() for match in _BEGINNING.finditer(data, start))
        return next((place for place in places if self._is_intact(data, place)), len(data))

    def _is_intact(self, data: bytes, place: int) -> bool:
        """Return whether records begin at `place`, up to one that proves its own content."""
        record, end = self._parse_at(data, place)
        while record is not None and not isinstance(record, _SELF_CHECKED):
            record, end = self._parse_at(data, end)
        return record is not None

    def _parse_at(self, data: bytes, start: int) -> tuple[mcap.McapRecord | None, int]:
        """Parse the record at `start`, with its checksum; return it (None if damaged), its end."""
        self._take_room(MESSAGE_COST)
        size = int.from_bytes(data[start + 1 : start + RECORD_HEAD_SIZE], "little")
        end = start + RECORD_HEAD_SIZE + size
        if start + RECORD_HEAD_SIZE > len(data) or end > len(data):
            return None, end
        try:
            record = _parse(data[start:end])
            if isinstance(record, mcap.Chunk):
                for _ in self._unpack(record):
                    pass
        except _StopError:
            raise
        except Exception:  # the libraries may raise anything on damaged bytes
            return None, end
        if isinstance(record, mcap.Footer) and not data.startswith(MCAP0_MAGIC, end):
            return None, end
        return record, end

    def _store_chunk(self, chunk: mcap.Chunk, part: FilePart) -> None:
        """Store the records of a chunk; leave out a damaged chunk."""
        try:
            for _, record in self._unpack(chunk):
                self._store(record)
        except _StopError:
            raise
        except Exception:  # the libraries may raise anything on damaged bytes
            self.gaps.append(part)

    def _store(self, record: mcap.McapRecord) -> None:
        """Store a record."""
        content = self.content
        if isinstance(record, mcap.Message):
            self._take_room(MESSAGE_COST)
            self.read[record.channel_id] += 1
            if record.channel_id not in self.ours:
                self.ours[record.channel_id] = self._converter(self.channels.get(record.channel_id))
            convert = self.ours[record.channel_id]
            if convert is None:
                if record.channel_id not in self.channels:
                    self.nameless.add(self.position)
                return
            topic = self.channels[record.channel_id].topic
            if topic in VIEWS:
                content.views.append((topic, record.log_time, record.data))
            else:
                content.messages.append((topic, record.log_time, convert(record.data)))
                self._sequences.append(record.sequence)
        elif isinstance(record, mcap.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, mcap.Channel):
            self.channels[record.id] = record
        elif isinstance(record, mcap.Metadata):
            content.metadata.update(record.metadata)
        elif isinstance(record, mcap.Attachment):
            content.attachments[record.name] = record.data

    def _converter(self, channel: mcap.Channel | None) -> Callable[[bytes], bytes] | None:
        """Return the converter of a channel's messages; None if cloudrc does not record them so."""
        if channel is None:  # its definition is lost
            return None
        topic, schema = TOPICS.get(channel.topic), self._schemas.get(channel.schema_id)
        ros_type = topic.ros_type if topic else VIEWS.get(channel.topic)
        if schema is None or ros_type is None or schema.name != ros_type:
            return None
        return converter(ros_type, with_new_columns(schema.data.decode("utf-8", "replace")))

    def _sort(self) -> None:
        messages = self.content.messages
        if late := sum(after[1] < before[1] for before, after in pairwise(messages)):
            keys = zip((message[1] for message in messages), self._sequences, strict=True)
            order = [row for _, row in sorted(zip(keys, range(len(messages)), strict=True))]
            self.content.messages = [messages[row] for row in order]
            self.content.remarks += (f"was not in order of time: {late} messages were sorted",)

    @property
    def unread(self) -> int:
        """Size of the file's unread end [bytes]; 0 if only the file's index is damaged."""
        return 0 if self.data_ended and not self.ended else self.size - self.position

    @property
    def lost(self) -> list[int]:
        """Positions in the file at which messages may be lost."""
        tail = [] if self.data_ended else [self.position]
        return [*(part.start for part in self.gaps), *self.nameless, *tail]

    @property
    def left_out(self) -> int:
        """Size of the damaged parts that were left out [bytes]."""
        return sum(part.size for part in self.gaps)

    @property
    def stated(self) -> Counter[str]:
        """Number of messages in the file by topic, as far as they were read or the index knows."""
        counts = self.statistics.channel_message_counts if self.statistics else {}
        found = Counter[str]()
        for number in self.read.keys() | counts.keys():
            channel = self.channels.get(number)
            topic = to_one_line(channel.topic) if channel else UNKNOWN
            found[topic] += max(self.read[number], counts.get(number, 0))
        return found | _stored_counts(self.content)  # of both, the larger number

    @property
    def has_counts(self) -> bool:
        """Whether the writer's count of the messages is known."""
        return bool(_stored_counts(self.content))

    def _take_room(self, size: int) -> None:
        self._room -= size
        if self._room < 0:
            raise _StopError(f"unpacks to more than {UNPACKED_MAX} times its size")

    def _unpack(self, chunk: mcap.Chunk) -> Iterator[tuple[int, mcap.McapRecord]]:
        """Yield position in the unpacked chunk and content of each record."""
        size = chunk.uncompressed_size
        if size > self._room:  # a bomb, or a damaged number
            self._unreadable = f"it unpacks to more than {UNPACKED_MAX} times its size"
            raise ValueError(self._unreadable)
        if chunk.compression not in _UNPACK:
            self._unreadable = (
                f"its chunks are compressed by {to_one_line(chunk.compression)!r}; cloudrc reads"
                " zstd and lz4: convert it with: mcap compress"
            )
            raise ValueError(self._unreadable)
        data = _UNPACK[chunk.compression](chunk.data, size + 1)
        self._take_room(len(data))
        if len(data) != size:
            raise ValueError("the chunk is not as long as it states")
        if chunk.uncompressed_crc not in (0, checksum := zlib.crc32(data)):
            raise CRCValidationError(chunk.uncompressed_crc, checksum, chunk)
        stream = BytesIO(data)
        # `emit_chunks`: the library would unpack a chunk inside a chunk without a limit.
        records = StreamReader(stream, skip_magic=True, emit_chunks=True).records
        try:
            while stream.tell() < size:  # one at a time: a chunk may hold millions
                yield stream.tell(), next(records)
        except EndOfFile as error:
            raise ValueError("a record is not as long as it states") from error


def _is_index_of(index: mcap.MessageIndex, listed: dict[int, list[tuple[int, int]]] | None) -> bool:
    """Return whether an index may be that of a chunk, which has the messages `listed`, if known."""
    return listed is None or sorted(index.records) == sorted(listed.get(index.channel_id, []))


def _parse(data: bytes) -> mcap.McapRecord:
    """Parse one record of the data section; raise any error if the bytes are damaged."""
    stream = StreamReader(
        BytesIO(data), skip_magic=True, emit_chunks=True, record_size_limit=len(data)
    )
    record = next(stream.records)
    if isinstance(record, mcap.Attachment):
        # MCAP allows zero for "not computed", but in a damaged file it is a block of zeros.
        checksum = int.from_bytes(data[-4:], "little")
        if checksum != zlib.crc32(data[RECORD_HEAD_SIZE:-4]):
            raise CRCValidationError(checksum, 0, record)
    return record


def read(path: Path) -> Content:
    """Read an MCAP file without its damaged parts, for `Recording.read`."""
    return File(path).content


def _note(file: File) -> None:
    """Describe in words what a file lacks; store the texts in the file's `content`."""
    content, fault = file.content, file.fault
    metadata = content.metadata
    if file.data_ended and file.cut:
        content.remarks += ("had a torn index: all its messages were read",)
        fault = ""
    elif fault and not file.data_ended:
        count, until = len(content.messages), content.messages[-1][1] * 1e-9
        fault += f": {count} messages were read, the last at {until:.2f} s"
    damage = [_describe(file.gaps)] if file.gaps else []
    if lost := file.listed - content.attachments.keys():
        damage.append(f"attachments lost: {', '.join(map(to_one_line, sorted(lost)))}")
    if nameless := file.stated[UNKNOWN]:
        damage.append(f"damaged: the topic of {nameless} messages is not known")
    if fault and not file.cut:
        damage.append(fault)
    changed = list(_changes(file))
    if before := to_one_line(metadata.get(CHANGED, "")):  # known when the file was written
        changed.append(before)
    if changed:
        metadata[CHANGED] = "; ".join(changed)
    content.torn = fault if file.cut else ""
    content.lacking = "; ".join([*damage, *changed])
    content.told = to_one_line(metadata.get(MISSING, ""))
    content.holes = _holes(file)


def _holes(file: File) -> tuple[Hole, ...]:
    """Find the times in which messages are lost that cloudrc records."""
    content, known = file.content, of_metadata(file.content.metadata)
    found = set(known or ())
    if not _has_all_rows(file):
        found |= {between(file.spans, position) for position in file.lost}
        # Only a complete file has its counts; the holes in an incomplete one lack its lost end.
        if content.told and (known is None or not file.has_counts):
            found.add(Hole(content.messages[-1][1] if content.messages else 0, END_NS))
        if content.note and not found:
            found.add(SOMEWHERE)
    return union(found)


def _has_all_rows(file: File) -> bool:
    """Return whether nothing is lost but views, as the counts in the file prove."""
    read = Counter(topic for topic, _, _ in file.content.messages)
    lost = (file.stated - read).keys()
    if file.has_counts:
        return not lost & TOPICS.keys()
    is_ours = bool(file.content.metadata.get(CLOCK))  # else the index may be another program's
    return is_ours and file.statistics is not None and not lost & {*TOPICS, UNKNOWN}


def _describe(gaps: list[FilePart]) -> str:
    """Describe the damaged parts of a file in words."""
    shown = [
        f"byte {gap.start}" + f" ({gap.content})" * bool(gap.content) for gap in gaps[:LISTED_MAX]
    ]
    if more := len(gaps) - len(shown):
        shown.append(f"{more} more places")
    size = sum(gap.size for gap in gaps)
    return f"damaged at {', '.join(shown)}: {size} bytes were left out"


def _changes(file: File) -> Iterator[str]:
    """Describe what another program has removed from a file or added to it."""
    yield from _changed_topics(file)
    if not file.content.metadata.get(CLOCK):
        yield "the metadata of cloudrc, which names the clock, is not there"
    if file.data_ended and not file.gaps:
        yield from _changed(file.content)


def _changed_topics(file: File) -> Iterator[str]:
    """Describe topics of another layout and topics that are twice in a file.

    Topics that cloudrc does not record are no change: they become a remark of the content.
    """
    channels = Counter(
        (file.channels[n].topic, convert is not None)
        for n, convert in file.ours.items()
        if n in file.channels
    )
    others = {name for name, known in channels if not known}
    if foreign := sorted(others - TOPICS.keys()):
        told = f"has topics that cloudrc does not record: {list_some(foreign)}"
        file.content.remarks += (to_one_line(told),)
    if other := sorted(others & TOPICS.keys()):
        yield f"topics of another layout were left out: {', '.join(other)}"
    once = {name for name, topic in TOPICS.items() if topic.end != "either"}
    if double := [
        name for (name, known), n in channels.items() if known and n > 1 and name in once
    ]:
        yield f"two robots or two recordings are in one file: {', '.join(double)}"


def _stored_counts(content: Content) -> Counter[str]:
    """Return the number of messages by topic that the writer has noted; empty if it has not."""
    with suppress(ValueError, RecursionError):
        stored = json.loads(content.metadata.get(COUNTS) or "{}")
        if isinstance(stored, dict):
            return Counter({t: n for t in TOPICS if isinstance(n := stored.get(t), int)})
    return Counter()


def _changed(content: Content) -> Iterator[str]:
    """Describe how the messages of a complete file differ from the counts stored by its writer."""
    metadata, read = content.metadata, Counter(message[0] for message in content.messages)
    counts = _stored_counts(content)
    pairs = [(topic, read[topic], counts[topic]) for topic in TOPICS if counts]
    if wrong := [f"{found} of {n} on {topic}" for topic, found, n in pairs if found != n]:
        yield f"messages were removed or added: it holds {list_some(wrong)}"
    if metadata.get(COUNTS) == "" and MISSING not in metadata:
        yield "it was torn, and another program added an end"


def list_some(topics: list[str]) -> str:
    """List the first topics in words, and count the others."""
    more = len(topics) - LISTED_MAX
    return ", ".join(topics[:LISTED_MAX]) + f" and {more} more topics" * (more > 0)
