"""Two recordings become one: each end's file goes in, the mission on world's clock comes out.

Of cloud's messages only the stamp moves; other stamps inside a message stay on the clock that
their description names.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path

import numpy as np

from cloudrc.errors import BadInputError
from cloudrc.files import draft
from cloudrc.record.cdr import shifted
from cloudrc.record.columns import Recording
from cloudrc.record.offset import SAME_CLOCK, ClockOffset, clock_offset
from cloudrc.record.order import merged
from cloudrc.record.reader import Contents, read_contents
from cloudrc.record.slip import WorldTime
from cloudrc.record.writer import MISSING, McapWriter
from cloudrc.records import Record

_MEDIA_TYPES = {".json": "application/json", ".yaml": "application/yaml"}


@dataclass(frozen=True, slots=True)
class Mission:
    """Both ends' files as one.

    Attributes:
        contents: All messages in the order of their log times, on world's clock.
        offset: How cloud's stamps were put on it.
    """

    contents: Contents
    offset: ClockOffset

    def recording(self) -> Recording:
        """Turn it into columns."""
        return Recording.from_contents(self.contents)

    def write(self, target: Path, attachments: Mapping[str, bytes] | None = None) -> None:
        """Write it to an MCAP file.

        Args:
            target: Replaced in one step if it exists.
            attachments: Files to put into it, by name, beside those of both ends.

        Raises:
            OSError: If the file cannot be written.
        """
        metadata = self.contents.metadata
        clock, clock_id = metadata["clock"], metadata["clock_id"]
        with draft(target) as file, McapWriter(file, clock=clock, clock_id=clock_id) as writer:
            writer.note(metadata)
            for topic, log_time_ns, data in self.contents.messages:
                writer.write_message(topic, log_time_ns, data)
            _attach(writer, {**self.contents.attachments, **(attachments or {})})


def merge(world: Path, cloud: Path) -> Mission:
    """Merge the files of both ends, whole or torn, on world's clock.

    Args:
        world: World's recording.
        cloud: Cloud's recording.

    Returns:
        The mission; if one of the two cannot be read, the other one on its own clock, and its
        note says so.

    Raises:
        BadInputError: If neither can be read.
    """
    read, failures = {}, []
    for end, path in (("world", world), ("cloud", cloud)):
        try:
            read[end] = read_contents(path)
        except BadInputError as error:
            failures.append(error)
    if not read:
        raise failures[0]
    notes = [f"{end}: {contents.note}" for end, contents in read.items() if contents.note]
    notes += map(str, failures)
    if failures:
        (only,) = read.values()
        mission = Mission(only, SAME_CLOCK)
    else:
        mission = _joined(read["world"], read["cloud"])
    if notes:
        mission.contents.note = mission.contents.metadata[MISSING] = "; ".join(notes)
    return mission


def _joined(world: Contents, cloud: Contents) -> Mission:
    of_world = Recording.from_contents(world)
    offset = clock_offset(of_world, Recording.from_contents(cloud))
    logged_ns = np.array([message[1] for message in cloud.messages], dtype=np.int64)
    moved_ns = logged_ns + offset.offset_ns
    if offset == SAME_CLOCK:
        moved_ns = WorldTime(of_world["/telemetry"]).at(logged_ns)
    moved = [
        (topic, to_ns, shifted(data, to_ns - from_ns))
        for (topic, from_ns, data), to_ns in zip(cloud.messages, moved_ns.tolist(), strict=True)
    ]
    joined = Contents(
        messages=list(heapq.merge(world.messages, moved, key=itemgetter(1))),
        metadata={**cloud.metadata, **world.metadata, **offset.metadata()},
        attachments={**cloud.attachments, **world.attachments},
    )
    return Mission(joined, offset)


def write_mission(
    target: Path,
    world_records: Iterable[Record],
    cloud_records: Iterable[Record],
    *,
    offset: ClockOffset = SAME_CLOCK,
    attachments: Mapping[str, bytes] | None = None,
) -> None:
    """Write the records of both ends as one mission on world's clock, without files in between.

    Args:
        target: Replaced in one step if it exists.
        world_records: Oldest first, on world's clock.
        cloud_records: Oldest first, on cloud's clock.
        offset: World's clock minus cloud's; in virtual time both are the same.
        attachments: Files to put into it, by name: config.yaml, report.json.

    Raises:
        OSError: If the file cannot be written.
    """
    with draft(target) as file, McapWriter(file, clock="world") as writer:
        writer.note(offset.metadata())
        for log_time_ns, row in merged(world_records, cloud_records, offset.offset_ns):
            writer.write_row(row, log_time_ns)
        _attach(writer, attachments or {})


def _attach(writer: McapWriter, attachments: Mapping[str, bytes]) -> None:
    for name, data in attachments.items():
        media_type = _MEDIA_TYPES.get(Path(name).suffix, "application/octet-stream")
        writer.attach(name, data, media_type)
