"""The recording's way in: an MCAP file goes in, whole or torn, its messages come out.

A process that was killed leaves a file without an end. MCAP's stream reader takes it up to the
last whole chunk (the seeking reader refuses it and the non-seeking one finds nothing).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.record.packages import missing
from cloudrc.record.ros_types import is_known
from cloudrc.record.topics import TOPICS

try:
    import zstandard  # noqa: F401  (mcap finds it by itself, but says less if it is missing)
    from mcap.exceptions import EndOfFile, InvalidMagic
    from mcap.records import (
        Attachment,
        Channel,
        Chunk,
        DataEnd,
        McapRecord,
        Message,
        Metadata,
        Schema,
    )
    from mcap.stream_reader import StreamReader, breakup_chunk
except ImportError as error:
    raise missing(error) from error


MISSING = "missing"
"""Key of the metadata under which a merged file keeps what its parts lacked."""


@dataclass(slots=True)
class Contents:
    """What a file held.

    Attributes:
        messages: Topic, log time [ns] and CDR bytes, in the order of the file.
        metadata: All of the file's metadata; later values of a key replace earlier ones.
        attachments: The attached files by name.
        note: What is missing, in words; "" if nothing is.
    """

    messages: list[tuple[str, int, bytes]] = field(default_factory=list)
    metadata: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    note: str = ""


def read_contents(path: Path) -> Contents:
    """Read a file as far as it goes.

    Args:
        path: An MCAP file, possibly torn.

    Returns:
        All messages of whole chunks.

    Raises:
        BadInputError: If nothing in it can be read.
    """
    reading, reason = _Reading(), "it is cut short"
    whole = False
    try:
        with path.open("rb") as stream:
            for record in StreamReader(stream, emit_chunks=True).records:
                reading.take(record)
        whole = True
    except OSError as error:
        raise BadInputError(
            f"{path}: cannot be read ({error.strerror}); name a recording (.mcap)"
        ) from error
    except InvalidMagic:
        reason = "it is not an MCAP file"
    except EndOfFile:
        pass
    except Exception as error:  # a torn file can fail anywhere inside the library
        reason = f"it is damaged ({type(error).__name__})"
    contents = reading.finish(whole)
    if not whole and not contents.messages:
        raise BadInputError(f"{path}: holds no readable message: {reason}; name another recording")
    return contents


class _Reading:
    """Takes MCAP records in, one after the other, and gathers what they hold."""

    def __init__(self) -> None:
        self.contents = Contents()
        self._ended = False
        self._damaged = 0
        self._foreign: set[str] = set()
        self._types: dict[int, tuple[str, str]] = {}
        self._topics: dict[int, str] = {}
        self._messages: list[Message] = []

    def take(self, record: McapRecord) -> None:
        contents = self.contents
        if isinstance(record, Chunk):
            try:
                inner = breakup_chunk(record, validate_crc=True)
            except Exception:  # whatever is wrong with one chunk, the next may be whole
                self._damaged += 1
                return
            for each in inner:
                self.take(each)
        elif isinstance(record, Message):
            self._messages.append(record)
        elif isinstance(record, Schema):
            self._types[record.id] = record.name, record.data.decode("utf-8", "replace")
        elif isinstance(record, Channel):
            self._open(record)
        elif isinstance(record, Metadata):
            contents.metadata.update(record.metadata)
        elif isinstance(record, Attachment):
            contents.attachments[record.name] = record.data
        elif isinstance(record, DataEnd):
            self._ended = True

    def _open(self, channel: Channel) -> None:
        ros_type, text = self._types.get(channel.schema_id, ("", ""))
        topic = TOPICS.get(channel.topic)
        known = topic is not None and topic.ros_type == ros_type and is_known(ros_type, text)
        if known:
            self._topics[channel.id] = channel.topic
        else:
            self._foreign.add(channel.topic)

    def finish(self, whole: bool) -> Contents:
        """Add the note to what was gathered; `whole` if the file ended as it should."""
        # Only now, since the index names the topics too, should the first chunk be damaged.
        topics = self._topics
        self.contents.messages = messages = [
            (topics[message.channel_id], message.log_time, message.data)
            for message in self._messages
            if message.channel_id in topics
        ]
        notes = []
        if not whole and not self._ended:
            until = messages[-1][1] * 1e-9 if messages else 0.0
            notes.append(
                f"cut short: {len(messages)} messages were read, the last at {until:.2f} s"
            )
        elif not whole:
            notes.append(f"cut short in its index: all {len(messages)} messages were read")
        if self._damaged:
            notes.append(f"{self._damaged} damaged chunks were left out")
        if self._foreign:
            names = ", ".join(sorted(self._foreign))
            notes.append(f"topics of another layout were left out: {names}")
        notes.append(self.contents.metadata.get(MISSING, ""))
        self.contents.note = "; ".join(filter(None, notes))
        return self.contents
