"""A torn or damaged recording goes in, a clean one and an account of what is lost come out.

MCAP has no such tool in Python. Everything whole is kept: messages with their stamps, schemas and
channels, attachments, metadata. The result has an index, checksums, and, if anything is missing, a
note that says so to whoever reads it.

A file on a disk that is failing: what cannot be read of it costs no more than itself.
"""

from __future__ import annotations

import errno
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from cloudrc import __version__
from cloudrc.errors import BadInputError
from cloudrc.files import draft
from cloudrc.record import missing
from cloudrc.record.reader import Scan, TooMuchError
from cloudrc.record.writer import METADATA, MISSING

SECTOR = 4096
"""What the kernel reads at once [bytes]."""


class Sectors(io.BufferedReader):
    """A file whose bad sectors read as zeros.

    Attributes:
        bad: Numbers of those that were met.
    """

    def __init__(self, raw: io.RawIOBase) -> None:
        """Take a file over.

        Args:
            raw: Open, without a buffer; is closed with this.
        """
        super().__init__(raw)
        self.bad: set[int] = set()

    def read(self, size: int | None = -1, /) -> bytes:
        """Read at most so many bytes; fewer at the end alone.

        Raises:
            OSError: If something else is wrong than a sector.
        """
        at = self.tell()
        try:
            return super().read(size)
        except OSError as error:
            if error.errno != errno.EIO or size is None or size < 0:
                raise
        return self._in_parts(at, size)

    def _in_parts(self, at: int, size: int) -> bytes:
        whole = self.seek(0, io.SEEK_END)
        end, parts = min(at + size, whole), list[bytes]()
        while at < end:
            length = min(SECTOR - at % SECTOR, end - at)
            try:
                self.seek(at)
                part = super().read(length)
            except OSError as error:
                if error.errno != errno.EIO:
                    raise
                part = b""
            if len(part) < length:
                self.bad.add(at // SECTOR)
            parts.append(part.ljust(length, b"\0"))
            at += length
        self.seek(at)
        return b"".join(parts)


try:
    from mcap.records import Attachment, Channel, Header, McapRecord, Message, Metadata, Schema
    from mcap.writer import CompressionType, Writer
except ImportError as error:
    raise missing(error) from error

CHANNELS_MAX = 65_535
"""Of a file, whose numbers for them have 16 bits; so have those of schemas, never more of them."""
DEFINITIONS_MAX = 64 << 20
"""Of all schemas and channels that are kept in mind, in bytes about; those beyond are left out."""
ENTRY = 256
"""Taken for one of a channel's metadata, whatever its length [bytes]."""
KEPT = {Message: "messages", Attachment: "attachments", Metadata: "metadata"}


@dataclass(slots=True)
class Recovery:
    """The account of a recovery.

    Attributes:
        size: Of the damaged file [bytes].
        kept: How many of each kind are in the new file.
        dropped: How many of each kind are not; what nobody can know of is only in `bytes_lost`.
        bytes_lost: Bytes that belong to no whole record [bytes].
        notes: What is missing or doubtful, in words.
        index_is_new: Whether the old file had no index that could be read.
    """

    size: int
    kept: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    bytes_lost: int = 0
    notes: list[str] = field(default_factory=list)
    index_is_new: bool = False

    @property
    def complete(self) -> bool:
        """Whether nothing is missing or doubtful."""
        return not self.notes

    @property
    def share(self) -> float:
        """Share that was kept in [0, 1]: of the messages if their number is known, else bytes."""
        kept, lost = self.kept.get("messages", 0), self.dropped.get("messages", 0)
        if kept + lost and not self.bytes_lost:
            return kept / (kept + lost)
        return 1.0 - self.bytes_lost / self.size if self.size else 0.0


def recover(source: Path, target: Path) -> Recovery:
    """Write a clean copy of a recording.

    Args:
        source: An MCAP file, possibly torn or damaged.
        target: Written in one step: it is there whole or not at all.

    Raises:
        BadInputError: If nothing in the file can be read.
        OSError: If the new file cannot be written.
    """
    try:
        stream = Sectors(source.open("rb", buffering=0))
    except OSError as error:
        raise BadInputError(
            f"{source}: cannot be read ({error.strerror}); name a recording (.mcap)"
        ) from error
    with stream, draft(target) as new:
        scan = Scan(stream)
        copy = _Copy(new, scan)
        try:
            for record in scan.records():
                copy.take(record)
        except TooMuchError as error:
            raise BadInputError(f"{source}: {error}") from error
        recovery = copy.finish(len(stream.bad))
        if not any(recovery.kept.values()) and not recovery.complete:
            what = "is cut short or damaged" if scan.is_mcap else "is not an MCAP file"
            raise BadInputError(f"{source}: holds nothing that can be read: it {what}")
    return recovery


class _Copy:
    """Takes whole records in and writes them to a new file under numbers of its own."""

    def __init__(self, new: IO[bytes], scan: Scan) -> None:
        self._scan = scan
        self._writer: Any = Writer(new, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._started = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._new_schemas: dict[tuple[str, str, bytes], int] = {}
        self._new_channels: dict[tuple[object, ...], int] = {}
        self._numbers: dict[int, int] = {}  # of a channel, there and here
        self._kept = dict.fromkeys(KEPT.values(), 0)
        self._homeless = 0
        self._room = DEFINITIONS_MAX
        self._said = ""  # by the recording itself: what it lacks
        for record in scan.definitions():
            self._define(record)

    def take(self, record: McapRecord) -> None:
        """Copy a record that is whole."""
        if isinstance(record, Header):
            self._start(record.profile)
        elif isinstance(record, Message):
            self._message(record)
        elif isinstance(record, Attachment):
            self._start()
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Metadata):
            self._start()
            self._writer.add_metadata(record.name, record.metadata)
            if record.name == METADATA:
                self._said = record.metadata.get(MISSING, self._said)
        else:
            self._define(record)
        kind = KEPT.get(type(record))
        if kind:
            self._kept[kind] += 1

    def finish(self, bad_sectors: int) -> Recovery:
        """End the new file; say what is in it and what is not."""
        scan = self._scan
        self._start()
        self._kept["messages"] -= self._homeless
        dropped = dict(scan.dropped)
        lost = dropped.get("messages", 0) + self._homeless
        if scan.summary and scan.summary.messages is not None:
            lost = max(lost, scan.summary.messages - self._kept["messages"])
        if lost:
            dropped["messages"] = lost
        kept = self._kept | {"chunks": scan.chunks, "channels": len(self._new_channels)}
        recovery = Recovery(scan.size, kept, dropped, scan.skipped, index_is_new=not scan.summary)
        new = self._notes(recovery)
        if bad_sectors:
            new.append(f"{bad_sectors} sectors of {SECTOR} bytes cannot be read")
        recovery.notes = [self._said, *new] if self._said else new
        if new:  # else what was said is in the new file already
            self._writer.add_metadata(METADATA, {MISSING: "; ".join(recovery.notes)})
        self._writer.finish()
        return recovery

    def _notes(self, recovery: Recovery) -> list[str]:
        scan, notes = self._scan, []
        if not scan.is_mcap:
            notes.append("the file does not begin as an MCAP file does")
        if not scan.ended:
            notes.append("cut short: the file has no end")
        if recovery.dropped:
            counts = ", ".join(f"{count} {kind}" for kind, count in recovery.dropped.items())
            notes.append(f"left out: {counts}")
        if recovery.bytes_lost:
            notes.append(f"{recovery.bytes_lost} bytes belong to no whole record")
        if scan.checked is False and not notes:
            notes.append("a byte outside the chunks is wrong: metadata or a stamp may be")
        return notes

    def _start(self, profile: str = "") -> None:
        if not self._started:
            self._started = True
            self._writer.start(profile=profile, library=f"cloudrc {__version__} recover")

    def _define(self, record: McapRecord) -> None:
        if isinstance(record, Schema) and self._schemas.get(record.id) != record:
            self._schemas.pop(record.id, None)
            if self._has_room(len(record.name) + len(record.encoding) + len(record.data)):
                self._schemas[record.id] = record
        elif isinstance(record, Channel) and self._channels.get(record.id) != record:
            self._channels.pop(record.id, None)
            self._numbers.pop(record.id, None)
            entries = sum(ENTRY + len(k) + len(v) for k, v in record.metadata.items())
            if self._has_room(len(record.topic) + len(record.message_encoding) + entries):
                self._channels[record.id] = record

    def _has_room(self, size: int) -> bool:
        self._room -= size
        return self._room >= 0

    def _message(self, message: Message) -> None:
        number = self._numbers.get(message.channel_id) or self._open(message.channel_id)
        if number is None:
            self._homeless += 1
            return
        self._writer.add_message(
            number, message.log_time, message.data, message.publish_time, message.sequence
        )

    def _open(self, there: int) -> int | None:
        """Register a channel in the new file; None if the old one's is lost, or too many are."""
        channel = self._channels.get(there)
        if channel is None or (channel.schema_id and channel.schema_id not in self._schemas):
            return None
        self._start()
        schema, here = self._schemas.get(channel.schema_id), 0
        full = len(self._new_channels) >= CHANNELS_MAX
        if schema is not None:
            content = (schema.name, schema.encoding, schema.data)
            if content not in self._new_schemas:
                if full:
                    return None
                self._new_schemas[content] = self._writer.register_schema(*content)
            here = self._new_schemas[content]
        values = (channel.topic, channel.message_encoding, here)
        key = (*values, *channel.metadata.items())
        if key not in self._new_channels:
            if full:
                return None
            self._new_channels[key] = self._writer.register_channel(*values, channel.metadata)
        number = self._numbers[there] = self._new_channels[key]
        return number
