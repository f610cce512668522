# SPDX-License-Identifier: Apache-2.0

"""Read an MCAP file up to its end, or up to its first damage.

A killed process leaves a file without an end, and a bad disk damages one. What comes before is
read; the package `mcap` parses the format and compares the checksums. This module says in words
what is missing.
"""

from __future__ import annotations

import json
import os
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from io import BufferedReader, BytesIO
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from shlex import quote
from typing import IO, Any

from mcap import records as mcap
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.stream_reader import CRCValidationError, StreamReader, get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from cloudrc.base.errors import BadInputError, to_one_line
from cloudrc.base.files import open_file
from cloudrc.base.text import list_some
from cloudrc.results.record.content import Content, Message
from cloudrc.results.record.holes import END_NS, SOMEWHERE, Hole, of_metadata, union
from cloudrc.results.record.mcap_file import HEAD, MESSAGE
from cloudrc.results.record.ros import columns, decode, is_known
from cloudrc.results.record.topics import TOPICS, VIEWS, Topic
from cloudrc.results.record.writer import CLOCK, COUNTS, MISSING

KINDS = {
    b"#ROSBAG V": "is a ROS 1 bag, not an MCAP file; convert it with: rosbags-convert",
    b"SQLite format 3": "is an SQLite file, not MCAP; convert it with: ros2 bag convert",
}
"""First bytes of a file that is not MCAP -> text of the error about the file."""


_DEFINITIONS: dict[int, type[mcap.Channel | mcap.Schema]] = {
    Opcode.CHANNEL.value: mcap.Channel,
    Opcode.SCHEMA.value: mcap.Schema,
}
_IS_MESSAGE = Opcode.MESSAGE.value

TRIM_EVERY = 20_000
"""Number of messages after which a reader of a file's end removes older ones [count]."""


class NothingReadableError(BadInputError):
    """The file contains no readable message, for example because the process was killed early."""


class _WholeReads:
    """A file that raises EndOfFile if it ends within a read; mcap would take the bytes left."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.size = os.fstat(file.fileno()).st_size  # [bytes]
        self.position = 0  # number of bytes that were read

    def read(self, size: int) -> bytes:
        self.position += size
        if self.position > self.size:
            raise EndOfFile
        return self._file.read(size)


class _Reader:
    """Reads the records of a file into a `Content`."""

    def __init__(
        self,
        path: Path,
        file: IO[bytes],
        last_ns: int | None = None,
        topics: Collection[str] = TOPICS,
        take: Callable[[list[Message]], None] | None = None,
    ) -> None:
        self.content = Content(source=str(path))
        self._last_ns = last_ns  # only messages of the last time are kept [ns]; None: all
        self._topics, self._take_block = topics, take
        self._counts: Counter[str] = Counter()  # messages of the file by topic
        self._trim_at = TRIM_EVERY  # number of messages at which older ones go
        self._file = _WholeReads(file)
        self._channels: dict[int, mcap.Channel] = {}
        self._schemas: dict[int, mcap.Schema] = {}
        self._ours: dict[int, bool] = {}  # channel -> whether cloudrc records its topic so
        self._sequences = array("L")
        self._data_ended = False  # whether all messages were read; only the index follows

    def read(self) -> Content:
        """Read the file; raise a NothingReadableError if damage precedes its first message."""
        stream: Any = self._file  # mcap calls nothing but `read`
        size = self._file.size
        options: Any = {"emit_chunks": True, "validate_crcs": True, "record_size_limit": size}
        reader = StreamReader(stream, **options)
        position = 0  # end of the last record that was read [bytes]
        fault, holes = "", set[Hole]()
        try:
            for record in reader.records:
                self._take(record)
                position = self._file.position
            position = self._file.position
        except (EndOfFile, RecordLengthLimitExceeded):  # a record longer than the rest of the file
            fault = "cut short"
        except CRCValidationError as error:
            fault = f"damaged at byte {position}"
            if isinstance(error.record, mcap.DataEnd):  # the checksum of all records
                fault = "damaged: a checksum is wrong"
                holes.add(SOMEWHERE)
        except OSError as error:
            fault = f"unreadable from byte {position} on: {error.strerror}"
        except Exception:  # the libraries may raise anything on damaged bytes
            fault = f"damaged at byte {position}"
        self._note_end(fault, holes, self._file.size - position)
        return self.content

    def _note_end(self, fault: str, holes: set[Hole], unread: int) -> None:
        """Note why reading has ended, and what is missing therefore."""
        content = self.content
        if self._data_ended:
            if fault:
                content.remarks += ("had no whole index: all its messages were read",)
            elif unread:
                content.remarks += (f"had {unread} bytes behind its end, which were left out",)
        elif not content.messages:
            raise NothingReadableError(
                f"{content.source}: holds no readable message: {fault}; name another recording"
            )
        else:
            count, until = self._counts.total(), content.messages[-1][1] * 1e-9
            content.unread = unread
            content.lacking = f"{fault}: {count} messages were read, the last at {until:.2f} s"
            if "damaged" in fault:
                content.lacking += "; what is behind the damage is read by: mcap recover"
        self._sort()
        if changes := list(self._changes()):
            holes.add(SOMEWHERE)
            content.lacking = "; ".join(filter(None, [content.lacking, *changes]))
        content.told = to_one_line(content.metadata.get(MISSING, ""))
        known = of_metadata(content.metadata)
        # Only a complete file has its counts; the holes noted in another one lack its lost end.
        is_noted = known is not None and content.metadata.get(COUNTS)
        if content.note and not holes and (content.lacking or not is_noted):
            holes.add(Hole(content.messages[-1][1] if content.messages else 0, END_NS))
        content.holes = union([*holes, *(known or ())])

    def _take(self, record: mcap.McapRecord) -> None:
        """Store a record; those after the data repeat definitions."""
        content = self.content
        if self._data_ended:
            return
        if isinstance(record, mcap.Chunk):
            self._take_chunk(record)
        elif isinstance(record, mcap.Message):
            self._take_message(record.channel_id, record.sequence, record.log_time, record.data)
        elif isinstance(record, mcap.Schema):
            self._schemas[record.id] = record
        elif isinstance(record, mcap.Channel):
            self._channels[record.id] = record
        elif isinstance(record, mcap.Metadata):
            content.metadata.update(record.metadata)
        elif isinstance(record, mcap.Attachment):
            content.attachments[record.name] = record.data
        elif isinstance(record, mcap.DataEnd):
            self._data_ended = True

    def _take_chunk(self, chunk: mcap.Chunk) -> None:
        """Store the records of a chunk; mcap takes several times as long for each message."""
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        data, at = stream.read(size), 0
        while at < size:
            opcode, length = HEAD.unpack_from(data, at)
            at += HEAD.size
            end = at + length
            if opcode == _IS_MESSAGE:
                number, sequence, log_time, _ = MESSAGE.unpack_from(data, at)
                self._take_message(number, sequence, log_time, data[at + MESSAGE.size : end])
            elif opcode in _DEFINITIONS:
                definition = ReadDataStream(BytesIO(data[at:end]))
                self._take(_DEFINITIONS[opcode].read(definition))
            at = end

    def _take_message(self, number: int, sequence: int, log_time: int, data: bytes) -> None:
        channel = self._channels[number]
        if number not in self._ours:
            self._ours[number] = self._is_ours(channel)
        if not self._ours[number]:
            return
        if channel.topic in VIEWS:
            if self._take_block is None:
                self.content.views.append((channel.topic, log_time, data))
            return
        self._counts[channel.topic] += 1
        if channel.topic not in self._topics:
            return
        self.content.messages.append((channel.topic, log_time, data))
        self._sequences.append(sequence)
        if len(self._sequences) < self._trim_at:
            return
        if self._take_block is not None:
            self._take_block(self.content.messages[:-1])
            del self.content.messages[:-1], self._sequences[:-1]
        elif self._last_ns is not None:
            self._trim(log_time - self._last_ns)

    def _trim(self, first_ns: int) -> None:
        """Remove the messages before a log time [ns]: memory then holds twice the kept ones."""
        messages = self.content.messages
        count = bisect_left(messages, first_ns, key=itemgetter(1))
        del messages[:count], self._sequences[:count]
        self._trim_at = 2 * len(messages) + TRIM_EVERY

    def _is_ours(self, channel: mcap.Channel) -> bool:
        """Return whether cloudrc records the topic of a channel in this layout."""
        topic, schema = TOPICS.get(channel.topic), self._schemas.get(channel.schema_id)
        ros_type = topic.ros_type if topic else VIEWS.get(channel.topic)
        if schema is None or ros_type is None or schema.name != ros_type:
            return False
        return is_known(ros_type, schema.data.decode("utf-8", "replace"))

    def _sort(self) -> None:
        messages = self.content.messages
        if late := sum(after[1] < before[1] for before, after in pairwise(messages)):
            rows = zip(messages, self._sequences, strict=True)
            in_order = sorted(rows, key=lambda row: (row[0][1], row[1]))
            self.content.messages = [message for message, _ in in_order]
            self.content.remarks += (f"was not in order of time: {late} messages were sorted",)

    def _changes(self) -> Iterator[str]:
        """Describe what another program has removed from the file or added to it.

        Topics that cloudrc does not record are no change: they become a remark of the content.
        """
        content = self.content
        metadata = content.metadata
        others = {self._channels[n].topic for n, is_ours in self._ours.items() if not is_ours}
        if foreign := sorted(others - TOPICS.keys()):
            told = f"has topics that cloudrc does not record: {list_some(foreign)}"
            content.remarks += (to_one_line(told),)
        if other := sorted(others & TOPICS.keys()):
            yield f"topics of another layout were left out: {', '.join(other)}"
        if not metadata.get(CLOCK):
            yield "the metadata of cloudrc, which names the clock, is not there"
        if not self._data_ended:
            return
        if metadata.get(COUNTS) == "" and MISSING not in metadata:
            yield "it was torn, and another program added an end"
        if self._last_ns is None and (stored := metadata.get(COUNTS)):
            counts, read = Counter(json.loads(stored)), self._counts
            wrong = [f"{read[t]} of {counts[t]} on {t}" for t in TOPICS if read[t] != counts[t]]
            if wrong:
                yield f"messages were removed or added: it holds {list_some(wrong)}"


def read(
    path: Path,
    *,
    whole: bool = False,
    last_ns: int | None = None,
    topics: Collection[str] = TOPICS,
    take: Callable[[list[Message]], None] | None = None,
) -> Content:
    """Read an MCAP file up to its end or to its first damage.

    With `last_ns`, keep the messages of the last time [ns] at least, in little memory. With `take`,
    which gets the messages of the `topics` block by block, keep none.

    Raises:
        BadInputError: If the file cannot be read or is not MCAP; with `whole`, also if it is torn,
            damaged or changed.
        NothingReadableError: If it holds no message that can be read.
    """
    try:
        file = BufferedReader(open_file(path))
    except (OSError, ValueError) as error:  # ValueError: a pipe or a device
        reason = getattr(error, "strerror", "not a file")
        raise BadInputError(
            f"{path}: cannot be read: {reason}; name a recording (.mcap)"
        ) from error
    with file:
        head = file.read(16)
        if MCAP0_MAGIC.startswith(head.rstrip(b"\0")):
            raise NothingReadableError(f"{path}: is empty; name a recording (.mcap)")
        if not head.startswith(MCAP0_MAGIC):
            known = (text for kind, text in KINDS.items() if head.startswith(kind))
            text = next(known, "is not an MCAP file; name a recording (.mcap)")
            raise BadInputError(f"{path}: {text}")
        file.seek(0)
        content = _Reader(path, file, last_ns, topics, take).read()
    if take is not None:
        take(content.messages)
        content.messages = []
    if whole and content.lacking:
        copy = f"to copy what is readable: cloudrc report {quote(str(path))} --recover"
        raise BadInputError(f"{path}: {content.lacking}; {copy}")
    return content


def decode_all(topic: Topic, messages: Sequence[bytes], what: str) -> Iterable[Any]:
    """Decode messages of a topic, at least one: the columns of their stamps and of their fields.

    `what` begins the text of the error about an unreadable message.
    """
    try:
        if (found := columns(topic, messages)) is not None:
            return found
        return zip(*[decode(topic, data) for data in messages], strict=True)
    except Exception as error:  # rosbags may raise anything on malformed bytes
        raise BadInputError(f"{what} is not readable; use the original file") from error
