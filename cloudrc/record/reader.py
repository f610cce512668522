"""Read an MCAP file from its start to its end, or to its first damaged part.

A killed process leaves a file without an end; such a file is read up to its last complete chunk.
`Records` yields the records of any MCAP file. `read_contents` collects the topics that cloudrc
records. The package `mcap` parses the format. This module limits the unpacked size of a file, and
says in words what is missing.
"""

from __future__ import annotations

import json
import os
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from io import BufferedReader
from itertools import pairwise
from pathlib import Path
from typing import Self

from cloudrc.errors import BadInputError, to_one_line
from cloudrc.files import open_file
from cloudrc.record import missing
from cloudrc.record.ros import is_known
from cloudrc.record.topics import TOPICS
from cloudrc.record.writer import CLOCK, COUNTS, MISSING

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
        McapRecord,
        Message,
        Metadata,
        Schema,
        Statistics,
    )
    from mcap.stream_reader import CRCValidationError, StreamReader, get_chunk_data_stream
    from mcap.writer import MCAP0_MAGIC
except ImportError as error:
    raise missing(error) from error

UNPACKED_MAX = 64
"""Largest size of a recording in memory, as a multiple of its size in the file [1]. A file below
1 MiB counts as 1 MiB. Recordings of flights need a factor of 10, recordings of an idle robot 30."""
MESSAGE_COST = 128
"""Memory of a message's Python objects, in addition to the message's bytes [bytes]."""
LISTED_MAX = 3
"""Largest number of topics that an error message lists."""
HEAD_SIZE = 16
"""Number of first bytes that identify the type of a file [bytes]."""
KINDS = (
    (b"#ROSBAG V", "is a ROS 1 bag, not an MCAP file; convert it with: rosbags-convert"),
    (b"SQLite format 3", "is an SQLite file, not MCAP; convert it with: ros2 bag convert"),
)
"""First bytes of other types of recordings, and the text of the error about them."""


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
            BadInputError: If the file cannot be opened or is not an MCAP file.
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
        self._stream.seek(0)
        head = self._stream.read(HEAD_SIZE)
        if not head.startswith(MCAP0_MAGIC):
            raise self._foreign(head)
        self._stream.seek(0)
        reader = StreamReader(
            self._stream, emit_chunks=True, validate_crcs=True, record_size_limit=self.size
        )
        try:
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
                packed = zstandard.ZstdDecompressor().stream_reader(
                    chunk.data, read_across_frames=True
                )
                data = packed.read(size + 1)
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

    def _foreign(self, head: bytes) -> BadInputError:
        """Say by the first bytes what the file is instead of MCAP."""
        if not head.strip(b"\0"):
            return NothingReadableError(f"{self.path}: is empty; name a recording (.mcap)")
        kinds = (text for magic, text in KINDS if head.startswith(magic))
        text = next(kinds, "is not an MCAP file; name a recording (.mcap)")
        return BadInputError(f"{self.path}: {text}")


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

    Args:
        path: An MCAP file, possibly torn.

    Raises:
        BadInputError: If nothing in the file is readable.
    """
    with Records(path) as records:
        collector = _Collector(records)
        for record in records:
            collector.take(record)
    return collector.finish()


class _Collector:
    """Collects the messages of cloudrc's topics, all metadata and all attachments of a file."""

    def __init__(self, records: Records) -> None:
        self._records = records
        self._contents = Contents()
        self._types: dict[int, tuple[str, str]] = {}
        self._channels: dict[int, tuple[str, bool]] = {}  # name of the topic; whether it is ours
        self._seen: Counter[int] = Counter()  # messages by channel
        self._sequences = array("L")

    def take(self, record: McapRecord) -> None:
        contents = self._contents
        if isinstance(record, Message):
            self._seen[record.channel_id] += 1
            topic, ours = self._channels.get(record.channel_id, ("", False))
            if ours:
                contents.messages.append((topic, record.log_time, record.data))
                self._sequences.append(record.sequence)
        elif isinstance(record, Schema):
            self._types[record.id] = record.name, record.data.decode("utf-8", "replace")
        elif isinstance(record, Channel):
            topic, (ros_type, text) = record.topic, self._types.get(record.schema_id, ("", ""))
            known = topic in TOPICS and TOPICS[topic].ros_type == ros_type
            self._channels[record.id] = topic, known and is_known(ros_type, text)
        elif isinstance(record, Metadata):
            contents.metadata.update(record.metadata)
        elif isinstance(record, Attachment):
            contents.attachments[record.name] = record.data

    def finish(self) -> Contents:
        """Sort the messages, note what is missing, and return the contents."""
        contents, records = self._contents, self._records
        messages = contents.messages
        if not records.data_ended and not messages:
            raise NothingReadableError(
                f"{records.path}: holds no readable message: {records.fault}; name another"
                " recording"
            )
        late = sum(after[1] < before[1] for before, after in pairwise(messages))
        if late:
            order = sorted(range(len(messages)), key=lambda n: (messages[n][1], self._sequences[n]))
            contents.messages = messages = [messages[n] for n in order]
            contents.remarks += (f"was not in order of time: {late} messages were sorted",)
        cut, lacking = list[str](), list[str]()
        if records.data_ended and records.cut:
            contents.remarks += ("had a torn index: all its messages were read",)
        elif records.fault:
            (cut if records.cut else lacking).append(self._fault())
        lacking += self._lacking(Counter(message[0] for message in messages))
        told = to_one_line(contents.metadata.get(MISSING, ""))
        contents.lacking = "; ".join(filter(None, lacking))
        contents.note = "; ".join(filter(None, [*cut, *lacking, told]))
        return contents

    def _fault(self) -> str:
        """Describe the fault of the file, and how far the file was read."""
        messages, fault = self._contents.messages, self._records.fault
        if self._records.data_ended:
            return fault
        until = messages[-1][1] * 1e-9
        return f"{fault}: {len(messages)} messages were read, the last at {until:.2f} s"

    def _lacking(self, read: Counter[str]) -> Iterator[str]:
        """Describe the data that other programs have removed or added.

        Args:
            read: Number of messages by topic.
        """
        metadata, seen = self._contents.metadata, self._seen
        channels = [self._channels[number] for number in seen if number in self._channels]
        foreign = sorted({name for name, ours in channels if not ours and name not in TOPICS})
        if foreign:
            told = f"has topics that cloudrc does not record: {_list(foreign)}"
            self._contents.remarks += (to_one_line(told),)
        if other := sorted({name for name, ours in channels if not ours and name in TOPICS}):
            yield f"topics of another layout were left out: {', '.join(other)}"
        twice = Counter(name for name, ours in channels if ours and TOPICS[name].end != "either")
        if double := [name for name, count in twice.items() if count > 1]:
            yield f"two robots or two recordings are in one file: {', '.join(double)}"
        if homeless := sum(seen[number] for number in seen.keys() - self._channels.keys()):
            yield f"{homeless} messages are of no topic"
        if CLOCK not in metadata:
            yield "the metadata of cloudrc, which names the clock, is not there"
        stated, total = self._records.stated, seen.total()
        if self._records.ended and stated not in (None, total):
            yield f"the index states {stated} messages, {total} were read"
        if not self._records.data_ended:
            return
        counts = _parse_counts(metadata.get(COUNTS, ""))
        topics = [topic for topic in TOPICS if counts and read[topic] != counts.get(topic, 0)]
        wrong = [f"{read[topic]} of {counts.get(topic, 0)} on {topic}" for topic in topics]
        if wrong:
            yield f"messages were removed or added: it holds {_list(wrong)}"
        if metadata.get(COUNTS) == "" and MISSING not in metadata:
            yield "it was torn, and another program has put an end to it"


def _list(topics: list[str]) -> str:
    """List the first topics, and give the number of the others."""
    more = len(topics) - LISTED_MAX
    return ", ".join(topics[:LISTED_MAX]) + f" and {more} more topics" * (more > 0)


def _parse_counts(text: str) -> dict[str, int]:
    """Parse the number of messages by topic that the writer has stored; empty if there is none.

    Args:
        text: Value of `COUNTS` in the metadata.
    """
    try:
        found = json.loads(text)
        return {str(topic): int(count) for topic, count in found.items() if topic in TOPICS}
    except (AttributeError, TypeError, ValueError):
        return {}
