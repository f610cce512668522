# SPDX-License-Identifier: Apache-2.0

"""Write records to an MCAP file that ROS 2 tools can read.

The file has the MCAP profile `ros2`, schemas in `ros2msg`, messages in `cdr`, and chunks compressed
with zstd. A chunk goes to the operating system after at most half a second of recording, so a
killed process loses at most half a second. Checksums of the chunks and of the data section reveal
every wrong byte outside the index. A complete file has the number of its messages.
"""

from __future__ import annotations

import errno
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping
from contextlib import suppress
from io import FileIO
from operator import itemgetter
from pathlib import Path
from typing import IO, Self

from mcap.records import DataEnd, Footer, Metadata
from mcap.writer import MCAP0_MAGIC

from cloudrc.base.files import atomic_file, open_file, try_lock
from cloudrc.results.record import STOPPED, WALL_OFFSET, wall_time
from cloudrc.results.record.content import Content
from cloudrc.results.record.holes import HOLES, Hole, to_metadata
from cloudrc.results.record.mcap_file import McapFile, bytes_of
from cloudrc.results.record.ros import definition, encode, type_hash
from cloudrc.results.record.topics import TOPICS, VIEWS, topics_of
from cloudrc.version import __version__
from cloudrc.wire.records import Record

CHUNK_NS = 500_000_000
"""Longest time between the first and the last message of a chunk [ns]."""
METADATA = "cloudrc"
"""Name of the file's metadata record."""
CODE = "code"
"""Metadata key: hash of the sources that have flown (`source.code_hash`)."""
CLOCK = "clock"
"""Metadata key: the clock of the stamps, "world" or "cloud"."""
MISSING = "missing"
"""Metadata key: what is missing from the file, in words."""
STARTED = "started"
"""Metadata key, only in real time: wall time of a mission's first message, in UTC (ISO 8601)."""
COUNTS = "counts"
"""Metadata key: number of messages by topic as JSON, "" until the file is complete. From it a
reader detects messages that were removed or added."""


class McapWriter:
    """Writes the messages of world, of cloud, or of both to one MCAP file."""

    def __init__(
        self,
        target: Path | IO[bytes],
        *,
        clock: str,
        clock_id: str = "",
        wall_offset_ns: int | None = None,
        code: str = "",
        index: bool = True,
    ) -> None:
        """Open a file, or use a stream that the caller closes; every method may raise an OSError.

        `clock` is "world" or "cloud", the clock of the stamps. `clock_id` identifies the machine's
        clock ("" if unknown); files with the same `clock_id` need no clock offset.
        `wall_offset_ns` is the wall time minus the time of `clock` [ns]; None in virtual time.
        `code` is the hash of the sources that fly; "" for a copy, whose metadata name it.
        Without `index`, the file gets no index of its chunks, and writing takes constant memory.
        """
        self._owned = isinstance(target, Path)
        # Unbuffered: `McapFile` has its own buffer, and `abandon` writes past it.
        self._stream: IO[bytes] | FileIO = (
            target.open("wb", buffering=0) if isinstance(target, Path) else target
        )
        if self._owned:
            try_lock(self._stream)
        self._file = McapFile(self._stream, f"cloudrc {__version__}", index=index)
        self._whole = 0  # number of bytes in the file up to the last complete chunk
        self._open_records = 0  # number of records written after these bytes
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._noted: dict[str, str] = {}
        self._latest_ns = 0  # log time of the last message [ns]
        self._chunk_start_ns: int | None = None
        self._number = 0  # sequence number of the last message
        self._counts: Counter[str] = Counter()
        self.note({CLOCK: clock, "clock_id": clock_id, "version": __version__, COUNTS: ""})
        if code:
            self.note({CODE: code})
        if wall_offset_ns is not None:
            self.note({WALL_OFFSET: str(wall_offset_ns)})

    def write(self, records: Iterable[Record]) -> None:
        """Write all rows of `records`, oldest first; the log time of a row is its stamp."""
        for record in records:
            for topic in topics_of(record):
                row = topic.row(record)
                self.write_message(topic.name, row[0], encode(topic, row))
            self._open_records += 1

    def write_message(self, topic: str, log_time_ns: int, data: bytes) -> None:
        """Write the CDR bytes of one message.

        If `log_time_ns` [ns] is negative or less than that of the previous message, the previous
        log time is used.
        """
        now_ns = self._latest_ns = max(self._latest_ns, log_time_ns)
        self._add_message(topic, now_ns, data)
        self._counts[topic] += 1

    def write_views(self, views: Iterable[tuple[str, int, bytes]]) -> None:
        """Write the messages for viewers, each with topic and log time [ns], after all others.

        These messages have separate chunks; readers sort the chunks by the file's index. The
        messages are not counted, because they repeat other messages.
        """
        self.flush()
        for topic, log_time_ns, data in sorted(views, key=itemgetter(1)):
            self._add_message(topic, max(log_time_ns, 0), data)
        self.flush()

    def _add_message(self, topic: str, now_ns: int, data: bytes) -> None:
        if self._chunk_start_ns is None:
            self._chunk_start_ns = now_ns
        elif now_ns - self._chunk_start_ns >= CHUNK_NS:
            self.flush()
            self._chunk_start_ns = now_ns
        channel = self._channels.get(topic) or self._open_channel(topic)
        # By the number, a reader restores the order of messages with equal log times.
        self._number = (self._number + 1) & 0xFFFFFFFF
        self._file.add_message(channel, self._number, now_ns, data)

    def note(self, metadata: Mapping[str, str]) -> None:
        """Add values to the file's metadata; a later value of a key replaces an earlier value."""
        self._noted |= metadata
        self._file.add_metadata(METADATA, self._noted)

    def note_losses(self, text: str, holes: Iterable[Hole]) -> None:
        """Note in words what is missing from the file, and the times of the missing messages."""
        self.note({MISSING: text} | to_metadata(holes))

    def attach(self, name: str, data: bytes) -> None:
        """Attach a file, such as report.json, to the recording."""
        self._file.attach(name, "application/octet-stream", self._latest_ns, data)

    def flush(self) -> None:
        """Complete the present chunk and pass it to the operating system."""
        self._chunk_start_ns = None
        self._file.flush()
        self._whole = self._stream.tell()
        self._open_records = 0

    def sync(self) -> None:
        """Write flushed data to the disk, which may take seconds."""
        if self._owned:
            try:
                os.fsync(self._stream.fileno())
            except OSError as error:
                if error.errno != errno.EINVAL:  # EINVAL: a pipe or device, which has no sync
                    raise

    def abandon(self, reason: str, code: str = "") -> int:
        """After an error, cut off the incomplete end of the file; if possible, note the reason.

        `code` is the failure code of the reason; "" if no code names it.
        Return the number of records that were passed to `write` but are not in the file.
        """
        named = {STOPPED: code} if code else {}
        note = bytes_of(Metadata(METADATA, {MISSING: reason, **named}))
        end = bytes_of(DataEnd(0), Footer(0, 0, 0))
        first = b"" if self._whole else MCAP0_MAGIC
        # Never write the end without the note: the file would look complete.
        for rest in (first + note + end + MCAP0_MAGIC, b""):
            with suppress(OSError, ValueError):  # no space: leave only the complete chunks
                self._stream.seek(self._whole)
                self._stream.truncate()
                if self._stream.write(rest) == len(rest):
                    break
        if self._owned:
            self._stream.close()
        return self._open_records

    def close(self) -> None:
        """Write the index and close the file. After an error, call `abandon` instead."""
        self.flush()  # keeps the last chunk even if there is no space for the index
        self.note({COUNTS: json.dumps(self._counts)})
        self._file.finish()
        if self._owned:
            self._stream.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        try:
            self.close()
        finally:
            if self._owned:
                self._stream.close()

    def _open_channel(self, topic: str) -> int:
        ros_type = VIEWS.get(topic) or TOPICS[topic].ros_type
        if ros_type not in self._schemas:
            text = definition(ros_type).encode()
            self._schemas[ros_type] = self._file.add_schema(ros_type, "ros2msg", text)
        # rosbag2 writes both keys, too.
        metadata = {"offered_qos_profiles": "", "topic_type_hash": type_hash(ros_type)}
        schema = self._schemas[ros_type]
        channel = self._file.add_channel(topic, "cdr", schema, metadata)
        self._channels[topic] = channel
        return channel


def is_open(path: Path) -> bool:
    """Return whether a process still writes the recording at `path`."""
    if not path.is_file():
        return False
    with open_file(path) as file:
        return try_lock(file, shared=True) is False


def write(content: Content, target: Path, attachments: Mapping[str, bytes]) -> None:
    """Write the content of a recording and further `attachments` to a file, atomically.

    The attachments come first: a copy that was cut short still contains the experiment.
    """
    messages = content.messages
    # What the source missed is in the note, unless the content was cut to another time.
    left_out = (MISSING, HOLES) if content.note else (MISSING, HOLES, STOPPED)
    metadata = {k: v for k, v in content.metadata.items() if k not in left_out}
    clock, machine = metadata.get(CLOCK, ""), metadata.get("clock_id", "")
    with atomic_file(target) as file, McapWriter(file, clock=clock, clock_id=machine) as writer:
        missing = {MISSING: content.note} | to_metadata(content.holes) if content.note else {}
        writer.note({**metadata, **missing, COUNTS: ""})  # the source's counts are not the copy's
        if messages and (began := wall_time(metadata, messages[0][1])):
            writer.note({STARTED: began.isoformat(timespec="milliseconds")})
        for name, data in {**content.attachments, **attachments}.items():
            writer.attach(name, data)
        for message in messages:
            writer.write_message(*message)
        writer.write_views(content.views)
