"""Read or repair an MCAP file, from its start to its end or to its first damaged part.

A killed process leaves a file without an end; such a file is read up to its last complete chunk.
`Records` yields the records of any MCAP file; `read_contents` collects the topics of cloudrc, and
`recover` writes a complete copy. The package `mcap` parses the format. This module limits the
unpacked size of a file, and says in words what is missing.
"""

from __future__ import annotations

import json
import os
from array import array
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from io import BufferedReader
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, Self

from cloudrc import __version__
from cloudrc.errors import BadInputError, to_one_line
from cloudrc.files import atomic_file, open_file
from cloudrc.record import missing
from cloudrc.record.ros import is_known
from cloudrc.record.topics import TOPICS
from cloudrc.record.writer import CLOCK, COUNTS, METADATA, MISSING

try:
    import lz4.frame
    import zstandard
    from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
    from mcap.opcode import Opcode
    from mcap.records import (
        Attachment,
        Channel,
        Chunk,
        DataEnd,
        Header,
        McapRecord,
        Message,
        Metadata,
        Schema,
        Statistics,
    )
    from mcap.stream_reader import CRCValidationError, StreamReader, get_chunk_data_stream
    from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
except ImportError as error:
    raise missing(error) from error

UNPACKED_MAX = 64
"""Largest size of a recording in memory, as a multiple of its size in the file [1]. A file below
1 MiB counts as 1 MiB. Recordings of flights need a factor of 10, recordings of an idle robot 30."""
MESSAGE_COST = 128
"""Memory of a message's Python objects, in addition to the message's bytes [bytes]."""
CHANNELS_MAX = 65_535
"""Limit of the number of channels plus schemas in a file; MCAP numbers both with 16 bits."""
LISTED_MAX = 3
"""Largest number of topics that an error message lists."""
LOSSY_SHARE_MAX = 0.999
"""Largest value of `Recovery.share` if anything is missing [1]."""
KINDS = {
    b"": "is empty; name a recording (.mcap)",
    b"#ROSBAG V": "is a ROS 1 bag, not an MCAP file; convert it with: rosbags-convert",
    b"SQLite format 3": "is an SQLite file, not MCAP; convert it with: ros2 bag convert",
}
"""First bytes of files that are not MCAP, and the text of the error about them."""


class NothingReadableError(BadInputError):
    """Report a file without any readable message, such as after a kill at the start."""


class _TooMuchError(Exception):
    """Report that a file unpacks to more data than any recording may."""


class Records:
    """The records of one MCAP file: chunks are unpacked, so no chunk is among the records.

    Attributes:
        path: The file, for messages.
        size: Size of the file [bytes].
        position: Position behind the last intact record [bytes].
        chunks: Number of intact chunks.
        data_ended: Whether reading has reached the end of the data; only the index follows.
        ended: Whether reading has reached the end of the file.
        fault: Why reading stopped or what is wrong, in words; "" if nothing is wrong.
        cut: Whether the fault is at the end of the file, as after a kill of the process.
        stated: Number of messages according to the index; None if the index was not reached.
    """

    def __init__(self, path: Path) -> None:
        """Open a file; use `with` to close it.

        Raises:
            BadInputError: If the file cannot be opened.
        """
        self.path = path
        try:
            self._stream = BufferedReader(open_file(path))
        except OSError as error:
            raise BadInputError(
                f"{path}: cannot be read ({error.strerror}); name a recording (.mcap)"
            ) from error
        except ValueError as error:  # a pipe or a device
            raise BadInputError(f"{error}; name a recording (.mcap)") from error
        self.size = os.fstat(self._stream.fileno()).st_size
        self.position = self.chunks = 0
        self.data_ended = self.ended = self.cut = False
        self.fault = ""
        self._room = UNPACKED_MAX * max(self.size, 1 << 20)
        self.stated: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._stream.close()

    def __iter__(self) -> Iterator[McapRecord]:
        """Yield the records up to the file's end or its first damaged part.

        Raises:
            BadInputError: If the file is not MCAP or has an unknown compression.
        """
        head = self._stream.read(16)
        if not head.startswith(MCAP0_MAGIC):
            kind = next((one for one in KINDS if one and head.startswith(one)), head.strip(b"\0"))
            text = KINDS.get(kind, "is not an MCAP file; name a recording (.mcap)")
            raise (BadInputError if kind else NothingReadableError)(f"{self.path}: {text}")
        self._stream.seek(0)
        try:
            yield from self._read()
        except BadInputError:
            raise
        except CRCValidationError as error:
            self.fault = "damaged: a checksum is wrong"
            if isinstance(error.record, DataEnd):  # all was read
                self.data_ended = self.ended = True
                self.position = self.size
                self.fault = "damaged: a byte outside the chunks is wrong"
        except (EndOfFile, RecordLengthLimitExceeded):  # a record that ends behind the file
            self.fault, self.cut = "cut short", True
        except _TooMuchError:
            self.fault = f"unpacks to more than {UNPACKED_MAX} times its size, as no recording does"
        except OSError as error:
            self.fault = f"unreadable: {error.strerror}"
        except Exception:  # the library may raise anything on damaged bytes
            self.cut = self._stream.tell() >= self.size
            self.fault = "cut short" if self.cut else "damaged"

    def _read(self) -> Iterator[McapRecord]:
        reader = StreamReader(
            self._stream, emit_chunks=True, validate_crcs=True, record_size_limit=self.size
        )
        for record in reader.records:
            if isinstance(record, Chunk):
                yield from self._unpack(record)
                self.chunks += 1
            elif not self.data_ended:  # what follows repeats the definitions
                yield record
            if isinstance(record, Statistics):
                self.stated = record.message_count
            self.data_ended |= isinstance(record, DataEnd)
            self.position = self._stream.tell()
        self.position = self._stream.tell()
        self.ended = self.data_ended = True
        if self.position < self.size:
            self.fault = "something follows its end"

    @property
    def unread(self) -> int:
        """Return the size of the part that was not read [bytes]; a torn index does not count."""
        return 0 if self.data_ended and not self.ended else self.size - self.position

    def _take_room(self, size: int) -> None:
        self._room -= size
        if self._room < 0:
            raise _TooMuchError

    def _unpack(self, chunk: Chunk) -> Iterator[McapRecord]:
        size = chunk.uncompressed_size
        self._take_room(size)
        # Not the library's: it allocates what the compressed data states, without a bound.
        match chunk.compression:
            case "":
                data = chunk.data
            case "zstd":
                unpacker = zstandard.ZstdDecompressor()
                data = unpacker.stream_reader(chunk.data, read_across_frames=True).read(size + 1)
            case "lz4":
                data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, size + 1)
            case other if not self.chunks:
                raise BadInputError(
                    f"{self.path}: its chunks are compressed by {to_one_line(other)!r}; cloudrc"
                    " reads zstd and lz4: convert it with: mcap compress"
                )
            case _:
                raise ValueError("another compression than in the chunks before")
        if len(data) != size:
            raise ValueError("the chunk is not as long as it states")
        whole = replace(chunk, compression="", data=data)
        stream, _ = get_chunk_data_stream(whole, validate_crc=True)
        while stream.count < size:  # one at a time: a chunk may hold millions
            opcode, length = stream.read1(), stream.read8()
            end = stream.count + length
            if opcode == Opcode.MESSAGE:
                self._take_room(MESSAGE_COST)
                yield Message.read(stream, length)
            elif opcode == Opcode.SCHEMA:
                yield Schema.read(stream)
            elif opcode == Opcode.CHANNEL:
                yield Channel.read(stream)
            else:
                stream.read(length)
            if stream.count != end:
                raise ValueError("a record is not as long as it states")


@dataclass(slots=True)
class Contents:
    """The contents of a file.

    Attributes:
        messages: Topic, log time [ns] and CDR bytes of each message, in the order of log times.
        metadata: All metadata of the file; later values of a key replace earlier values.
        attachments: Name -> attached file.
        note: What is missing, in words; "" if nothing is missing.
        lacking: The part of `note` that a killed process cannot explain: damaged, filtered or
            foreign parts; "" if there is none.
        remarks: What was ignored or sorted, although nothing is missing: sentences without their
            subject, which is the recording.
    """

    messages: list[tuple[str, int, bytes]] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    note: str = ""
    lacking: str = ""
    remarks: tuple[str, ...] = ()


def read_contents(path: Path) -> Contents:
    """Read the topics that cloudrc records, up to the end of a file or its first damaged part.

    Raises:
        BadInputError: If nothing in the file is readable.
    """
    contents, sequences = Contents(), array("L")
    types: dict[int, tuple[str, str]] = {}
    channels: dict[int, tuple[str, bool]] = {}  # name of the topic; whether it is ours
    seen: Counter[int] = Counter()  # messages by channel
    with Records(path) as records:
        for record in records:
            if isinstance(record, Message):
                seen[record.channel_id] += 1
                topic, ours = channels.get(record.channel_id, ("", False))
                if ours:
                    contents.messages.append((topic, record.log_time, record.data))
                    sequences.append(record.sequence)
            elif isinstance(record, Schema):
                types[record.id] = record.name, record.data.decode("utf-8", "replace")
            elif isinstance(record, Channel):
                topic, (ros_type, text) = record.topic, types.get(record.schema_id, ("", ""))
                known = topic in TOPICS and TOPICS[topic].ros_type == ros_type
                channels[record.id] = topic, known and is_known(ros_type, text)
            elif isinstance(record, Metadata):
                contents.metadata.update(record.metadata)
            elif isinstance(record, Attachment):
                contents.attachments[record.name] = record.data
    messages, fault = contents.messages, records.fault
    if not records.data_ended and not messages:
        raise NothingReadableError(
            f"{path}: holds no readable message: {fault}; name another recording"
        )
    if late := sum(after[1] < before[1] for before, after in pairwise(messages)):
        order = sorted(range(len(messages)), key=lambda n: (messages[n][1], sequences[n]))
        contents.messages = [messages[n] for n in order]
        contents.remarks += (f"was not in order of time: {late} messages were sorted",)
    _note(contents, records, [(*channels.get(one, ("", None)), n) for one, n in seen.items()])
    return contents


def _note(contents: Contents, records: Records, seen: list[tuple[str, bool | None, int]]) -> None:
    """Note what is missing; `seen` has topic, whether it is ours, and messages of each channel."""
    cut, lacking = list[str](), list[str]()
    if records.data_ended and records.cut:
        contents.remarks += ("had a torn index: all its messages were read",)
    elif fault := records.fault:
        if not records.data_ended:
            count, until = len(contents.messages), contents.messages[-1][1] * 1e-9
            fault += f": {count} messages were read, the last at {until:.2f} s"
        (cut if records.cut else lacking).append(fault)
    others = {name for name, ours, _ in seen if ours is False}
    if foreign := sorted(others - TOPICS.keys()):
        told = f"has topics that cloudrc does not record: {_list(foreign)}"
        contents.remarks += (to_one_line(told),)
    if changed := sorted(others & TOPICS.keys()):
        lacking.append(f"topics of another layout were left out: {', '.join(changed)}")
    twice = Counter(name for name, ours, _ in seen if ours and TOPICS[name].end != "either")
    if double := [name for name, count in twice.items() if count > 1]:
        lacking.append(f"two robots or two recordings are in one file: {', '.join(double)}")
    if homeless := sum(count for _, ours, count in seen if ours is None):
        lacking.append(f"{homeless} messages are of no topic")
    if CLOCK not in contents.metadata:
        lacking.append("the metadata of cloudrc, which names the clock, is not there")
    total = sum(count for *_, count in seen)
    if records.ended and records.stated not in (None, total):
        lacking.append(f"the index states {records.stated} messages, {total} were read")
    lacking += _changed(contents) if records.data_ended else ()
    told = to_one_line(contents.metadata.get(MISSING, ""))
    contents.lacking = "; ".join(lacking)
    contents.note = "; ".join(filter(None, [*cut, *lacking, told]))


def _changed(contents: Contents) -> Iterator[str]:
    """Compare a file that was read to its end with what its writer has counted."""
    metadata, read = contents.metadata, Counter(message[0] for message in contents.messages)
    counts: dict[str, int] = {}
    with suppress(ValueError):
        counts = json.loads(metadata.get(COUNTS) or "{}")
    pairs = [(topic, read[topic], counts.get(topic, 0)) for topic in TOPICS if counts]
    if wrong := [f"{found} of {n} on {topic}" for topic, found, n in pairs if found != n]:
        yield f"messages were removed or added: it holds {_list(wrong)}"
    if metadata.get(COUNTS) == "" and MISSING not in metadata:
        yield "it was torn, and another program has put an end to it"


def _list(topics: list[str]) -> str:
    """List the first topics, and give the number of the others."""
    more = len(topics) - LISTED_MAX
    return ", ".join(topics[:LISTED_MAX]) + f" and {more} more topics" * (more > 0)


@dataclass(slots=True)
class Recovery:
    """The result of a recovery."""

    size: int  # of the damaged file [bytes]
    kept: dict[str, int]  # number of objects in the new file, by kind
    dropped: dict[str, int]  # number of objects that are known to be lost (only "messages")
    bytes_lost: int  # behind the last intact record [bytes]
    notes: list[str]  # what is missing or doubtful, in words
    index_is_new: bool  # whether the old file had no readable index

    @property
    def complete(self) -> bool:
        """Return whether nothing is missing or doubtful."""
        return not self.notes

    @property
    def share(self) -> float:
        """Return the kept share of messages, in [0, 1]; of bytes if that number is unknown.

        The share is below 1 if anything is missing.
        """
        if self.complete:
            return 1.0
        kept, lost = self.kept["messages"], self.dropped.get("messages", 0)
        share = kept / (kept + lost) if lost else 1.0 - self.bytes_lost / self.size
        return min(share, LOSSY_SHARE_MAX)


def recover(source: Path, target: Path) -> Recovery:
    """Write a complete copy of a recording that may be torn, up to its first damaged part.

    The copy keeps messages with their stamps, schemas, channels, attachments and metadata, and has
    an index, checksums and a note about what is missing. It replaces `target` atomically.

    Raises:
        BadInputError: If the file holds no readable message.
        OSError: If the new file cannot be written.
    """
    with Records(source) as records, atomic_file(target) as new:
        return _Copy(new, records).finish()


class _Copy:
    """Copies records to a new file, with new numbers for channels and schemas."""

    def __init__(self, new: IO[bytes], records: Records) -> None:
        self._records = records
        self._writer: Any = Writer(new, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._schemas: dict[int, tuple[Schema, int]] = {}  # old number -> its new number
        self._channels: dict[int, tuple[Channel, int]] = {}
        self._kept = {"messages": 0, "attachments": 0, "metadata": 0}
        self._defined = 0  # channels and schemas in the new file
        self._homeless = 0  # messages of no channel
        self._told = ""  # what the recording itself says is missing
        for number, record in enumerate(records):
            if isinstance(record, Header) or number == 0:
                profile = record.profile if isinstance(record, Header) else ""
                self._writer.start(profile=profile, library=f"cloudrc {__version__} recover")
            self._take(record)

    def _take(self, record: McapRecord) -> None:
        add: Any = self._writer
        if isinstance(record, Message):
            _, channel = self._channels.get(record.channel_id, (None, 0))
            self._homeless += not channel
            self._kept["messages"] += bool(channel)
            if channel:
                add.add_message(
                    channel, record.log_time, record.data, record.publish_time, record.sequence
                )
        elif isinstance(record, Schema):
            self._define(record, self._schemas)
        elif isinstance(record, Channel):
            self._define(record, self._channels)
        elif isinstance(record, Attachment):
            self._kept["attachments"] += 1
            add.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Metadata):
            self._kept["metadata"] += 1
            add.add_metadata(record.name, record.metadata)
            if record.name == METADATA:
                self._told = record.metadata.get(MISSING, self._told)

    def finish(self) -> Recovery:
        """Complete the new file; return what the file holds and what is lost."""
        records, kept = self._records, self._kept
        if not kept["messages"] and not kept["attachments"]:
            reason = records.fault or "none is in it"
            raise BadInputError(
                f"{records.path}: holds no readable message: {reason}; nothing is written"
            )
        lost = max(self._homeless, (records.stated or 0) - kept["messages"])
        new = []
        if records.fault and not (records.data_ended and records.cut):
            unread = f": {records.unread} bytes after the last intact part were not read"
            new.append(records.fault + unread * bool(records.unread))
        if lost:
            new.append(f"{lost} messages are lost")
        notes = [self._told, *new] if self._told else new
        if new:  # otherwise the new file already has what the recording says
            self._writer.add_metadata(METADATA, {MISSING: "; ".join(notes)})
        self._writer.finish()
        kept |= {"chunks": records.chunks, "channels": len(self._channels)}
        dropped = {"messages": lost} if lost else {}
        return Recovery(records.size, kept, dropped, records.unread, notes, not records.ended)

    def _define(self, record: Any, known: dict[int, Any]) -> None:
        """Register a schema or channel; register each definition of its number only once."""
        if record.id in known and known[record.id][0] == record:
            return
        self._defined += 1
        if self._defined > CHANNELS_MAX:
            raise BadInputError(
                f"{self._records.path}: defines more than {CHANNELS_MAX} channels and schemas;"
                " use another file"
            )
        if isinstance(record, Schema):
            number = self._writer.register_schema(record.name, record.encoding, record.data)
        else:
            _, schema = self._schemas.get(record.schema_id, (None, 0))
            number = self._writer.register_channel(
                record.topic, record.message_encoding, schema, record.metadata
            )
        known[record.id] = record, number
