"""Repair a torn or damaged recording: copy all that is intact into a new file.

The copy keeps messages with their stamps, schemas, channels, attachments and metadata. It has an
index, checksums and, if anything is missing, a note about it. On a failing disk only the unreadable
sectors are lost. MCAP itself has no such tool for Python.
"""

from __future__ import annotations

import errno
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from cloudrc import __version__
from cloudrc.errors import BadInputError
from cloudrc.files import atomic_file
from cloudrc.record import missing
from cloudrc.record.reader import Scan, TooMuchError
from cloudrc.record.writer import METADATA, MISSING

SECTOR = 4096
"""Unit in which the kernel reads a disk [bytes]."""


class Sectors(io.BufferedReader):
    """A file whose bad sectors read as zeros.

    Attributes:
        bad: Numbers of the bad sectors found so far.
    """

    def __init__(self, raw: io.RawIOBase) -> None:
        """Wrap an open file.

        Args:
            raw: The file, without a buffer; closed together with this object.
        """
        super().__init__(raw)
        self.bad: set[int] = set()

    def read(self, size: int | None = -1, /) -> bytes:
        """Read `size` bytes; fewer only at the end of the file. Bad sectors read as zeros.

        Raises:
            OSError: If reading fails for another reason than a bad sector.
        """
        at = self.tell()
        try:
            return super().read(size)
        except OSError as error:
            if error.errno != errno.EIO or size is None or size < 0:
                raise
        return self._read_sectors(at, size)

    def _read_sectors(self, at: int, size: int) -> bytes:
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
"""Limit of channels and of schemas in a file, since MCAP numbers them with 16 bits."""
DEFINITIONS_MAX = 64 << 20
"""Memory limit of the kept schemas and channels, roughly [bytes]; more of them are left out."""
ENTRY = 256
"""Memory counted for a channel's metadata entry, beside its text [bytes]."""
KEPT = {Message: "messages", Attachment: "attachments", Metadata: "metadata"}


@dataclass(slots=True)
class Recovery:
    """The result of a recovery.

    Attributes:
        size: Size of the damaged file [bytes].
        kept: Number of objects in the new file, by kind.
        dropped: Number of objects that are known to be lost, by kind.
        bytes_lost: Bytes that belong to no intact record [bytes].
        notes: What is missing or doubtful, in words.
        index_is_new: Whether the old file had no readable index.
    """

    size: int
    kept: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    bytes_lost: int = 0
    notes: list[str] = field(default_factory=list)
    index_is_new: bool = False

    @property
    def complete(self) -> bool:
        """Return whether nothing is missing or doubtful."""
        return not self.notes

    @property
    def share(self) -> float:
        """Return the kept share in [0, 1]: of the messages if their number is known, else bytes."""
        kept, lost = self.kept.get("messages", 0), self.dropped.get("messages", 0)
        if kept + lost and not self.bytes_lost:
            return kept / (kept + lost)
        return 1.0 - self.bytes_lost / self.size if self.size else 0.0


def recover(source: Path, target: Path) -> Recovery:
    """Write a clean copy of a recording.

    Args:
        source: An MCAP file, possibly torn or damaged.
        target: The new file; written atomically.

    Raises:
        BadInputError: If nothing in the file is readable.
        OSError: If the new file cannot be written.
    """
    try:
        stream = Sectors(source.open("rb", buffering=0))
    except OSError as error:
        raise BadInputError(
            f"{source}: cannot be read ({error.strerror}); name a recording (.mcap)"
        ) from error
    with stream, atomic_file(target) as new:
        scan = Scan(stream)
        copy = _Copy(new, scan)
        try:
            for record in scan.records():
                copy.take(record)
        except TooMuchError as error:
            raise BadInputError(f"{source}: {error}") from error
        recovery = copy.finish(len(stream.bad))
        if not any(recovery.kept.values()) and not recovery.complete:
            reason = "is cut short or damaged" if scan.is_mcap else "is not an MCAP file"
            raise BadInputError(f"{source}: holds nothing that can be read: it {reason}")
    return recovery


class _Copy:
    """Copies intact records to a new file and numbers channels and schemas anew."""

    def __init__(self, new: IO[bytes], scan: Scan) -> None:
        self._scan = scan
        self._writer: Any = Writer(new, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._started = False
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._new_schemas: dict[tuple[str, str, bytes], int] = {}
        self._new_channels: dict[tuple[object, ...], int] = {}
        self._numbers: dict[int, int] = {}  # old number of a channel -> its new number
        self._kept = dict.fromkeys(KEPT.values(), 0)
        self._without_channel = 0
        self._room = DEFINITIONS_MAX
        self._old_note = ""  # what the recording itself says is missing
        for record in scan.definitions():
            self._define(record)

    def take(self, record: McapRecord) -> None:
        """Copy an intact record."""
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
                self._old_note = record.metadata.get(MISSING, self._old_note)
        else:
            self._define(record)
        kind = KEPT.get(type(record))
        if kind:
            self._kept[kind] += 1

    def finish(self, bad_sectors: int) -> Recovery:
        """Complete the new file; return what it holds and what is lost."""
        scan = self._scan
        self._start()
        self._kept["messages"] -= self._without_channel
        dropped = dict(scan.dropped)
        lost = dropped.get("messages", 0) + self._without_channel
        if scan.summary and scan.summary.messages is not None:
            lost = max(lost, scan.summary.messages - self._kept["messages"])
        if lost:
            dropped["messages"] = lost
        kept = self._kept | {"chunks": scan.chunks, "channels": len(self._new_channels)}
        recovery = Recovery(scan.size, kept, dropped, scan.skipped, index_is_new=not scan.summary)
        new = self._notes(recovery)
        if bad_sectors:
            new.append(f"{bad_sectors} sectors of {SECTOR} bytes cannot be read")
        recovery.notes = [self._old_note, *new] if self._old_note else new
        if new:  # otherwise the new file already has the old note
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
            self._without_channel += 1
            return
        self._writer.add_message(
            number, message.log_time, message.data, message.publish_time, message.sequence
        )

    def _open(self, there: int) -> int | None:
        """Register a channel in the new file; None if its definition is lost or the file is full.

        Args:
            there: Number of the channel in the old file.
        """
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
