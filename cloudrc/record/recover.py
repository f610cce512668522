"""Copy a torn recording, up to its first damaged part, into a new, complete file.

The copy keeps messages with their stamps, schemas, channels, attachments and metadata. The copy has
an index and checksums. If anything is missing, it also has a note about the loss. The Python
package `mcap` has no such tool.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from cloudrc import __version__
from cloudrc.errors import BadInputError
from cloudrc.files import atomic_file
from cloudrc.record import missing
from cloudrc.record.reader import Records
from cloudrc.record.writer import METADATA, MISSING

try:
    from mcap.records import Attachment, Channel, Header, McapRecord, Message, Metadata, Schema
    from mcap.writer import CompressionType, Writer
except ImportError as error:
    raise missing(error) from error

CHANNELS_MAX = 65_535
"""Limit of the number of channels plus schemas in a file; MCAP numbers both with 16 bits."""
LOSSY_SHARE_MAX = 0.999
"""Largest value of `Recovery.share` if anything is missing [1]."""


@dataclass(slots=True)
class Recovery:
    """The result of a recovery.

    Attributes:
        size: Size of the damaged file [bytes].
        kept: Number of objects in the new file, by kind.
        dropped: Number of objects that are known to be lost, by kind (only "messages").
        bytes_lost: Size of the part behind the last intact record [bytes].
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
        """Return the kept share of messages, in [0, 1]; of bytes if that number is unknown.

        The share is below 1 if anything is missing.
        """
        if self.complete:
            return 1.0
        kept, lost = self.kept["messages"], self.dropped.get("messages", 0)
        share = kept / (kept + lost) if lost else 1.0 - self.bytes_lost / self.size
        return min(share, LOSSY_SHARE_MAX)


def recover(source: Path, target: Path) -> Recovery:
    """Write a complete copy of a recording.

    Args:
        source: An MCAP file, possibly torn or damaged.
        target: The new file; it is written atomically.

    Raises:
        BadInputError: If the file holds no readable message.
        OSError: If the new file cannot be written.
    """
    with Records(source) as records, atomic_file(target) as new:
        copy = _Copy(new, records)
        for record in records:
            copy.take(record)
        return copy.finish()


class _Copy:
    """Copies records to a new file, with new numbers for channels and schemas."""

    def __init__(self, new: IO[bytes], records: Records) -> None:
        self._records = records
        self._writer: Any = Writer(new, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._started = False
        self._schemas: dict[int, tuple[Schema, int]] = {}  # old number -> its new number
        self._channels: dict[int, tuple[Channel, int]] = {}
        self._defined = 0
        self._kept = {"messages": 0, "attachments": 0, "metadata": 0}
        self._homeless = 0  # messages of no channel
        self._told = ""  # what the recording itself says is missing

    def take(self, record: McapRecord) -> None:
        """Copy an intact record."""
        if isinstance(record, Header) or not self._started:
            self._start(record)
        if isinstance(record, Message):
            _, channel = self._channels.get(record.channel_id, (None, 0))
            self._homeless += not channel
            self._kept["messages"] += bool(channel)
            if channel:
                self._writer.add_message(
                    channel, record.log_time, record.data, record.publish_time, record.sequence
                )
        elif isinstance(record, Schema):
            self._define(record, self._schemas)
        elif isinstance(record, Channel):
            self._define(record, self._channels)
        elif isinstance(record, Attachment):
            self._kept["attachments"] += 1
            self._writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
        elif isinstance(record, Metadata):
            self._kept["metadata"] += 1
            self._writer.add_metadata(record.name, record.metadata)
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
        lost = self._homeless
        if records.stated is not None:
            lost = max(lost, records.stated - kept["messages"])
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

    def _start(self, record: McapRecord) -> None:
        self._started = True
        profile = record.profile if isinstance(record, Header) else ""
        self._writer.start(profile=profile, library=f"cloudrc {__version__} recover")

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
