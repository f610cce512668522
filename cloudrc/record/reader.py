"""Read or repair an MCAP file, up to its end or to its first damaged part.

A killed process leaves a file without an end; this module reads it up to its last complete chunk.
The package `mcap` parses the format. This module limits the unpacked size, and describes in words
what is missing.
"""

from __future__ import annotations

import json
import os
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BufferedReader, BytesIO
from itertools import pairwise
from pathlib import Path

import lz4.frame
import zstandard
from mcap import records as mcap
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import MCAP0_MAGIC

from cloudrc.errors import BadInputError, to_one_line
from cloudrc.files import open_file
from cloudrc.record.columns import Recording
from cloudrc.record.ros import is_known
from cloudrc.record.topics import TOPICS, VIEWS
from cloudrc.record.writer import CHANGED, CLOCK, COUNTS, MISSING

UNPACKED_MAX = 64
"""Largest ratio of a recording's size in memory to its size in the file; a file below 1 MiB counts
as 1 MiB. Recordings of flights need a ratio of 10, recordings of an idle robot 30."""
MESSAGE_COST = 128
"""Memory for a message's Python objects, in addition to its content [bytes]."""
LISTED_MAX = 3
"""Largest number of topics that an error message lists."""
LOSSY_SHARE_MAX = 0.999
"""Largest value of `Recovery.share` if something is missing [1]."""
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


class _File:
    """Reads one MCAP file, including its chunks, up to the first damaged part."""

    def __init__(self, path: Path) -> None:
        """Read a file; raise a BadInputError if it cannot be read or is not MCAP."""
        self.recording = Recording(source=str(path))
        self.position = 0  # end of the last intact record in the file [bytes]
        self.data_ended = False  # whether all messages were read; only the index follows
        self.ended = False  # whether the whole file was read
        self.fault = ""  # why reading stopped or what is wrong, in words; "" if nothing is wrong
        self.cut = False  # whether the file breaks off at the fault, as after a kill
        self.total = 0  # number of messages, also of other programs, read or stated by the index
        self.channels: dict[int, mcap.Channel] = {}
        self.ours: dict[int, bool] = {}  # whether cloudrc records a channel's topic in this layout
        self._schemas: dict[int, mcap.Schema] = {}
        self._sequences = array("L")
        try:
            self._stream = BufferedReader(open_file(path))
        except (OSError, ValueError) as error:  # ValueError: a pipe or a device
            reason = getattr(error, "strerror", "not a file")
            raise BadInputError(
                f"{path}: cannot be read: {reason}; name a recording (.mcap)"
            ) from error
        with self._stream:
            self.size = os.fstat(self._stream.fileno()).st_size  # [bytes]
            self._room = UNPACKED_MAX * max(self.size, 1 << 20)
            head = self._stream.peek(16)
            if not head.startswith(MCAP0_MAGIC):
                kind = next((k for k in KINDS if k and head.startswith(k)), head[:16].strip(b"\0"))
                text = KINDS.get(kind, "is not an MCAP file; name a recording (.mcap)")
                raise (BadInputError if kind else NothingReadableError)(f"{path}: {text}")
            self._read()
        if not self.data_ended and not self.recording.messages:
            raise NothingReadableError(
                f"{path}: holds no readable message: {self.fault}; name another recording"
            )
        self._sort()
        _note(self)

    def _read(self) -> None:
        try:
            for record in self._records():
                self._store(record)
        except CRCValidationError as error:
            self.fault = "damaged: a checksum is wrong"
            self.data_ended |= isinstance(error.record, mcap.DataEnd)
        except (EndOfFile, RecordLengthLimitExceeded):  # a record longer than the rest of the file
            self.fault, self.cut = "cut short", True
        except _StopError as error:
            self.fault = str(error)
        except OSError as error:
            self.fault = f"unreadable: {error.strerror}"
        except Exception:  # the library may raise anything on damaged bytes
            self.cut = self._stream.tell() >= self.size
            self.fault = "cut short" if self.cut else "damaged"

    def _records(self) -> Iterator[mcap.McapRecord]:
        reader = StreamReader(
            self._stream, emit_chunks=True, validate_crcs=True, record_size_limit=self.size
        )
        for record in reader.records:
            if isinstance(record, mcap.Chunk):
                yield from self._unpack(record)
            elif not self.data_ended:  # records after the data repeat the definitions
                yield record
            if isinstance(record, mcap.Statistics):
                self.total = max(self.total, record.message_count)
            self.data_ended |= isinstance(record, mcap.DataEnd)
            self.position = self._stream.tell()
        self.position = self._stream.tell()
        self.ended = self.data_ended = True
        if self.position < self.size:
            self.fault = "something follows its end"

    def _store(self, record: mcap.McapRecord) -> None:
        """Store a record; raise a KeyError for a message whose channel is not defined."""
        recording = self.recording
        if isinstance(record, mcap.Message):
            self._take_room(MESSAGE_COST)
            self.total += 1
            topic = self.channels[record.channel_id].topic
            if record.channel_id not in self.ours:
                self.ours[record.channel_id] = self._is_ours(self.channels[record.channel_id])
            if self.ours[record.channel_id] and topic in VIEWS:
                recording.views.append((topic, record.log_time, record.data))
            elif self.ours[record.channel_id]:
                recording.messages.append((topic, record.log_time, record.data))
                self._sequences.append(record.sequence)
        elif isinstance(record, mcap.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, mcap.Channel):
            self.channels[record.id] = record
        elif isinstance(record, mcap.Metadata):
            recording.metadata.update(record.metadata)
        elif isinstance(record, mcap.Attachment):
            recording.attachments[record.name] = record.data

    def _is_ours(self, channel: mcap.Channel) -> bool:
        """Check whether a channel's topic and layout are those that cloudrc records."""
        topic, schema = TOPICS.get(channel.topic), self._schemas.get(channel.schema_id)
        ros_type = topic.ros_type if topic else VIEWS.get(channel.topic)
        if schema is None or ros_type is None or schema.name != ros_type:
            return False
        return is_known(ros_type, schema.data.decode("utf-8", "replace"))

    def _sort(self) -> None:
        messages = self.recording.messages
        if late := sum(after[1] < before[1] for before, after in pairwise(messages)):
            keys = zip((message[1] for message in messages), self._sequences, strict=True)
            order = [row for _, row in sorted(zip(keys, range(len(messages)), strict=True))]
            self.recording.messages = [messages[row] for row in order]
            self.recording.remarks += (f"was not in order of time: {late} messages were sorted",)

    @property
    def unread(self) -> int:
        """Size of the unread part of the file [bytes]; 0 if only the file's index is damaged."""
        return 0 if self.data_ended and not self.ended else self.size - self.position

    @property
    def lost(self) -> int:
        """Number of messages in the file that are not in `recording`."""
        return self.total - len(self.recording.messages) - len(self.recording.views)

    def _take_room(self, size: int) -> None:
        self._room -= size
        if self._room < 0:
            raise _StopError(f"unpacks to more than {UNPACKED_MAX} times its size")

    def _unpack(self, chunk: mcap.Chunk) -> Iterator[mcap.McapRecord]:
        size = chunk.uncompressed_size
        self._take_room(size)
        if chunk.compression not in _UNPACK:
            raise _StopError(
                f"its chunks are compressed by {to_one_line(chunk.compression)!r}; cloudrc reads"
                " zstd and lz4: convert it with: mcap compress"
            )
        data = _UNPACK[chunk.compression](chunk.data, size + 1)
        if len(data) != size:
            raise ValueError("the chunk is not as long as it states")
        if chunk.uncompressed_crc not in (0, checksum := zlib.crc32(data)):
            raise CRCValidationError(chunk.uncompressed_crc, checksum, chunk)
        stream = BytesIO(data)
        # `emit_chunks`: the library would unpack a chunk inside a chunk without a limit.
        records = StreamReader(stream, skip_magic=True, emit_chunks=True).records
        try:
            while stream.tell() < size:  # one at a time: a chunk may hold millions
                yield next(records)
        except EndOfFile as error:
            raise ValueError("a record is not as long as it states") from error


def read(path: Path) -> Recording:
    """Read an MCAP file up to its end or to its first damaged part, for `Recording.read`."""
    return _File(path).recording


def _note(file: _File) -> None:
    """Describe in words what a file lacks; store the texts in the file's `recording`."""
    recording, fault, metadata = file.recording, file.fault, file.recording.metadata
    changed = list[str]()
    if file.data_ended and file.cut:
        recording.remarks += ("had a torn index: all its messages were read",)
        fault = ""
    elif fault and not file.data_ended:
        count, until = len(recording.messages), recording.messages[-1][1] * 1e-9
        fault += f": {count} messages were read, the last at {until:.2f} s"
    channels = Counter((file.channels[number].topic, known) for number, known in file.ours.items())
    others = {name for name, known in channels if not known}
    if foreign := sorted(others - TOPICS.keys()):
        told = f"has topics that cloudrc does not record: {_list(foreign)}"
        recording.remarks += (to_one_line(told),)
    if other := sorted(others & TOPICS.keys()):
        changed.append(f"topics of another layout were left out: {', '.join(other)}")
    twice = [name for (name, known), n in channels.items() if known and n > 1 and name in TOPICS]
    if double := [name for name in twice if TOPICS[name].end != "either"]:
        changed.append(f"two robots or two recordings are in one file: {', '.join(double)}")
    if not metadata.get(CLOCK):
        changed.append("the metadata of cloudrc, which names the clock, is not there")
    if file.data_ended:
        changed += _changed(recording)
    if before := to_one_line(metadata.get(CHANGED, "")):  # known when the file was written
        changed.append(before)
    if changed:
        metadata[CHANGED] = "; ".join(changed)
    recording.torn, damage = (fault, "") if file.cut else ("", fault)
    recording.lacking = "; ".join(filter(None, [damage, *changed]))
    recording.told = to_one_line(metadata.get(MISSING, ""))


def _changed(recording: Recording) -> Iterator[str]:
    """Describe how the messages of a complete file differ from the counts stored by its writer."""
    metadata, read = recording.metadata, Counter(message[0] for message in recording.messages)
    counts: dict[str, int] = {}
    with suppress(ValueError, RecursionError):
        if isinstance(stored := json.loads(metadata.get(COUNTS) or "{}"), dict):
            counts = stored
    pairs = [(topic, read[topic], counts.get(topic, 0)) for topic in TOPICS if counts]
    if wrong := [f"{found} of {n} on {topic}" for topic, found, n in pairs if found != n]:
        yield f"messages were removed or added: it holds {_list(wrong)}"
    if metadata.get(COUNTS) == "" and MISSING not in metadata:
        yield "it was torn, and another program added an end"


def _list(topics: list[str]) -> str:
    more = len(topics) - LISTED_MAX
    return ", ".join(topics[:LISTED_MAX]) + f" and {more} more topics" * (more > 0)


@dataclass(slots=True)
class Recovery:
    """What `recover` has saved of a damaged recording, and what is lost."""

    complete: bool  # whether nothing is missing or doubtful
    share: float  # share of the messages that were kept, in [0, 1]; if unknown, of the bytes
    size: int  # size of the damaged file [bytes]
    kept: dict[str, int]  # number of objects in the new file, by kind
    dropped: dict[str, int]  # {"messages": number of lost messages}; {} if none or unknown
    bytes_lost: int  # number of bytes after the last intact record
    notes: list[str]  # what is missing or doubtful, in words
    index_is_new: bool  # whether the old file had no readable index


def recover(source: Path, target: Path) -> Recovery:
    """Write a complete copy of a recording that may be torn or damaged.

    The copy contains the topics that cloudrc records, the attachments, the metadata, and a note
    about what is missing. It ends before the first damaged part. Raise a BadInputError if the file
    has no readable message, or an OSError if the new file cannot be written.
    """
    file = _File(source)
    recording, lost = file.recording, file.lost
    if not recording.messages:
        reason = recording.note or "none is in it"
        raise BadInputError(f"{source}: holds no readable message: {reason}; nothing is written")
    missed = list[str]()
    if file.unread:
        missed.append(f"{file.unread} bytes after the last intact part were not read")
    if lost:
        missed.append(f"{lost} messages are lost, or of topics that cloudrc does not record")
    notes = [*filter(None, [recording.note]), *missed]
    recording.told = "; ".join(filter(None, [recording.told, *missed]))
    recording.write(target)
    count, topics = len(recording.messages), {topic for topic, _, _ in recording.messages}
    share = count / (count + lost) if lost else 1.0 - file.unread / file.size
    return Recovery(
        complete=not notes,
        share=min(share, LOSSY_SHARE_MAX) if notes else 1.0,
        size=file.size,
        kept={"messages": count, "attachments": len(recording.attachments), "topics": len(topics)},
        dropped={"messages": lost} if lost else {},
        bytes_lost=file.unread,
        notes=notes,
        index_is_new=not file.ended,
    )
