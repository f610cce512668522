"""Read a recording, from a file or from records in memory, as one table of arrays per topic.

    recording = Recording.read(path)
    recording["/odometry"]["position"]  # shape (n, 3)

A topic without records is a table without rows. The log time of a row is its stamp, or the previous
row's log time if that is later. So log times never decrease within one end, and both ends can be
merged by log time. Files and records in memory give the same tables.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator, Mapping
from itertools import repeat
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.record.topics import TOPICS, Kind, Row, Topic, Values, rows
from cloudrc.records import Record

if TYPE_CHECKING:
    from cloudrc.record.reader import Contents

Column: TypeAlias = NDArray[Any]
_Rows: TypeAlias = dict[str, list[tuple[int, Values]]]
_TYPES: dict[Kind, tuple[type, tuple[int, ...]]] = {
    "int": (np.int64, ()),
    "float": (np.float64, ()),
    "bool": (np.bool_, ()),
    "string": (np.object_, ()),
    "vector": (np.float64, (3,)),
    "quaternion": (np.float64, (4,)),
}


def merged(
    world_records: Iterable[Record], cloud_records: Iterable[Record], offset_ns: int = 0
) -> Iterator[tuple[int, Row]]:
    """Merge the records of both ends, oldest first, into one sequence of rows on world's clock.

    Yield log time [ns] and row; of equal log times, world's rows come first. `offset_ns` is world's
    clock minus cloud's clock [ns]. Only the stamp of each row is converted; other times in a row
    stay on the clock that their description names.
    """
    world, cloud = _logged(world_records, 0), _logged(cloud_records, offset_ns)
    return heapq.merge(world, cloud, key=itemgetter(0))


def _logged(records: Iterable[Record], offset_ns: int) -> Iterator[tuple[int, Row]]:
    latest = -(2**63)
    for record in records:
        for topic, stamp_ns, values in rows(record):
            stamp_ns += offset_ns
            latest = max(latest, stamp_ns)
            yield latest, (topic, stamp_ns, values)


class Table:
    """The columns of one topic; its length is the number of rows n.

    The types of the arrays are int64 for integers, float64 for floats and vectors, bool for truth
    values, object for strings. Vectors have shape (n, 3), quaternions (n, 4), all other columns
    (n,).
    """

    def __init__(self, topic: Topic, rows: list[tuple[int, Values]]) -> None:
        """Convert the stamp [ns] and values of each row to columns."""
        columns = zip(*[values for _, values in rows], strict=True) if rows else repeat(())
        self._columns = {"stamp_ns": _column("int", [stamp_ns for stamp_ns, _ in rows])}
        for field, values in zip(topic.fields, columns, strict=False):
            self._columns[field.name] = _column(field.kind, values)
        self.topic = topic

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the columns, `stamp_ns` first."""
        return tuple(self._columns)

    def __len__(self) -> int:
        return len(self._columns["stamp_ns"])

    def __getitem__(self, name: str) -> Column:
        try:
            return self._columns[name]
        except KeyError:
            known = ", ".join(self.names)
            raise KeyError(f"no column {name!r} in {self.topic.name}; it has: {known}") from None


class Recording:
    """The tables of a flight by topic.

    Attributes:
        metadata: The file's metadata, such as its clock; empty if made from records.
        attachments: Name -> attached file.
        note: What is missing, in words; "" if nothing is missing.
        lacking: The part of `note` that a killed process cannot explain; "" if there is none.
        remarks: What was ignored or sorted, as in `Contents`.
    """

    def __init__(self, rows: _Rows, contents: Contents | None = None) -> None:
        """Store rows by topic; most callers use `read` or `from_records`."""
        self._rows = rows
        self._tables: dict[str, Table] = {}
        self.metadata: Mapping[str, str] = contents.metadata if contents else {}
        self.attachments: Mapping[str, bytes] = contents.attachments if contents else {}
        self.note = contents.note if contents else ""
        self.lacking = contents.lacking if contents else ""
        self.remarks = contents.remarks if contents else ()

    @property
    def complete(self) -> bool:
        """True if nothing is missing."""
        return not self.note

    @classmethod
    def from_records(
        cls,
        world_records: Iterable[Record],
        cloud_records: Iterable[Record] = (),
        offset_ns: int = 0,
    ) -> Self:
        """Make a recording in memory, as if read from a file of rows that are `merged`."""
        rows: _Rows = {name: [] for name in TOPICS}
        for _, (topic, stamp_ns, values) in merged(world_records, cloud_records, offset_ns):
            rows[topic].append((stamp_ns, values))
        return cls(rows)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read an MCAP file up to its end or its first damaged part.

        Raises:
            BadInputError: If nothing in the file is readable.
            MissingPrerequisiteError: If `cloudrc[record]` is not installed.
        """
        from cloudrc.record.reader import read_contents

        return cls.from_contents(read_contents(path))

    @classmethod
    def from_contents(cls, contents: Contents) -> Self:
        """Decode the contents of a file."""
        from cloudrc.record.ros import decode

        rows: _Rows = {name: [] for name in TOPICS}
        unreadable = 0
        for topic, _, data in contents.messages:
            try:
                rows[topic].append(decode(TOPICS[topic], data))
            except Exception:  # rosbags may raise anything on malformed bytes
                unreadable += 1
        recording = cls(rows, contents)
        if unreadable:
            text = f"{unreadable} messages are not readable"
            recording.note = "; ".join(filter(None, [recording.note, text]))
            recording.lacking = "; ".join(filter(None, [recording.lacking, text]))
        return recording

    def __getitem__(self, topic: str) -> Table:
        if topic not in self._tables:
            if topic not in TOPICS:
                raise KeyError(f"no topic {topic!r}; there are: {', '.join(TOPICS)}")
            self._tables[topic] = Table(TOPICS[topic], self._rows.get(topic, []))
        return self._tables[topic]


def _column(kind: Kind, values: Iterable[Any]) -> Column:
    dtype, shape = _TYPES[kind]
    return np.array(values, dtype=dtype).reshape(-1, *shape)
