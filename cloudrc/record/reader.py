"""The recording's way in: an MCAP file goes in, whole or torn, its messages come out.

A process that was killed leaves a file without an end: it is read up to the last whole chunk, and
what is damaged is left out (`cloudrc/record/scan.py`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from io import BufferedReader
from itertools import chain
from pathlib import Path
from typing import IO

from cloudrc.errors import BadInputError, in_one_line
from cloudrc.files import open_file
from cloudrc.record.packages import missing
from cloudrc.record.ros_types import is_known
from cloudrc.record.scan import Scan, TooMuchError
from cloudrc.record.topics import TOPICS
from cloudrc.record.writer import MISSING

try:
    from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
except ImportError as error:
    raise missing(error) from error


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
        BadInputError: If nothing in it can be read, or it unpacks to more than recordings do.
    """
    try:
        with BufferedReader(open_file(path)) as stream:
            reading = _Reading()
            scan = reading.pass_over(stream)
            if reading.came_late:
                reading = _Reading(reading)
                scan = reading.pass_over(stream)
    except OSError as error:
        raise BadInputError(
            f"{path}: cannot be read ({error.strerror}); name a recording (.mcap)"
        ) from error
    except TooMuchError as error:
        raise BadInputError(f"{path}: {error}") from error
    except ValueError as error:
        raise BadInputError(f"{error}; name a recording (.mcap)") from error
    contents = reading.finish(scan)
    if not scan.ended and not contents.messages:
        reason = "is cut short or damaged" if scan.is_mcap else "is not an MCAP file"
        raise BadInputError(
            f"{path}: holds no readable message: it {reason}; name another recording"
        )
    return contents


class _Reading:
    """Takes MCAP records in, one after the other, and gathers what they hold.

    Attributes:
        contents: What was gathered.
        came_late: Whether a channel was defined behind messages of its own: those are left out, and
            read by a second pass that knows the channels of the first.
    """

    def __init__(self, before: _Reading | None = None) -> None:
        self.contents = Contents()
        self.came_late = False
        self._foreign: set[str] = set()
        self._types: dict[int, tuple[str, str]] = {}
        self._topics: dict[int, str] = dict(before._topics) if before else {}
        self._homeless: set[int] = set()

    def pass_over(self, stream: IO[bytes]) -> Scan:
        """Take all of a file in."""
        scan = Scan(stream)
        for record in chain(scan.definitions(), scan.records()):
            self.take(record)
        return scan

    def take(self, record: McapRecord) -> None:
        contents = self.contents
        if isinstance(record, Message):
            topic = self._topics.get(record.channel_id)
            if topic is None:
                self._homeless.add(record.channel_id)
            else:
                contents.messages.append((topic, record.log_time, record.data))
        elif isinstance(record, Schema):
            self._types[record.id] = record.name, record.data.decode("utf-8", "replace")
        elif isinstance(record, Channel):
            self._open(record)
        elif isinstance(record, Metadata):
            contents.metadata.update(record.metadata)
        elif isinstance(record, Attachment):
            contents.attachments[record.name] = record.data

    def _open(self, channel: Channel) -> None:
        ros_type, text = self._types.get(channel.schema_id, ("", ""))
        topic = TOPICS.get(channel.topic)
        known = topic is not None and topic.ros_type == ros_type and is_known(ros_type, text)
        if known:
            self._topics[channel.id] = channel.topic
            self.came_late |= channel.id in self._homeless
        else:
            self._topics.pop(channel.id, None)
            self._foreign.add(channel.topic)

    def finish(self, scan: Scan) -> Contents:
        """Add the note to what was gathered."""
        messages, notes = self.contents.messages, []
        if not scan.ended:
            until = messages[-1][1] * 1e-9 if messages else 0.0
            notes.append(
                f"cut short: {len(messages)} messages were read, the last at {until:.2f} s"
            )
        elif scan.summary is None:
            notes.append(f"cut short in its index: all {len(messages)} messages were read")
        for kind, count in scan.dropped.items():
            if kind != "messages":
                notes.append(f"{count} damaged {kind} were left out")
        if scan.checked is False and not scan.dropped:
            notes.append("a byte outside the chunks is wrong")
        if self._foreign:
            names = in_one_line(", ".join(sorted(self._foreign)))
            notes.append(f"topics of another layout were left out: {names}")
        notes.append(in_one_line(self.contents.metadata.get(MISSING, "")))
        self.contents.note = "; ".join(filter(None, notes))
        return self.contents
