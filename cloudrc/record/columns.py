"""Read a recording as one table per topic, with one array per column.

    recording = Recording.read(path)
    recording["/odometry"]["position"]  # shape (n, 3)

A recording comes from a file or from records in memory; both give the same tables. A topic without
records has a table without rows.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain, repeat
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.record.hash import Columns, RecordHash
from cloudrc.record.topics import TOPICS, Kind, Row, Topic, Values, rows
from cloudrc.records import Arrival, Record

if TYPE_CHECKING:
    from cloudrc.record.reader import Contents

Column: TypeAlias = NDArray[Any]
_TYPES: dict[Kind, tuple[type, tuple[int, ...]]] = {
    "int": (np.int64, ()),
    "float": (np.float64, ()),
    "bool": (np.bool_, ()),
    "string": (np.object_, ()),
    "vector": (np.float64, (3,)),
    "quaternion": (np.float64, (4,)),
}


def merged(
    world_records: Iterable[Record], cloud_records: Iterable[Record]
) -> Iterator[tuple[int, Row]]:
    """Merge the records of world and cloud, each oldest first and all on one clock, into rows.

    Yield the log time [ns] and the row, in order of log time. If two log times are equal, world's
    row comes first. The log time of a row is its stamp, or the log time of the previous row of the
    same end (world or cloud) if that is later.
    """
    return heapq.merge(_logged(world_records), _logged(cloud_records), key=itemgetter(0))


def _logged(records: Iterable[Record]) -> Iterator[tuple[int, Row]]:
    latest = 0
    for record in records:
        for row in rows(record):
            latest = max(latest, row[1])
            yield latest, row


class Table:
    """The n rows of one topic as columns.

    Integers are stored as int64, floats and vectors as float64, truth values as bool, strings as
    object. The shape is (n, 3) for vectors, (n, 4) for quaternions, and (n,) for other columns.
    """

    def __init__(self, topic: Topic, stamps_ns: Iterable[int], columns: Iterable[Any]) -> None:
        """Store the rows' stamps [ns] and, for each field of the topic, the column of its values.

        Without columns, the table has no rows.
        """
        self._columns = {"stamp_ns": _column("int", stamps_ns)}
        for field, values in zip(topic.fields, chain(columns, repeat(())), strict=False):
            self._columns[field.name] = _column(field.kind, values)
        self.topic = topic

    @classmethod
    def from_rows(cls, topic: Topic, rows: list[tuple[int, Values]]) -> Self:
        """Convert rows, each with a stamp [ns] and values."""
        values = zip(*[values for _, values in rows], strict=True)
        return cls(topic, [stamp_ns for stamp_ns, _ in rows], values)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns, `stamp_ns` first."""
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

    A recording from a file also has metadata, attachments, a note and remarks; `Contents` describes
    them.
    """

    def __init__(
        self, make_table: Callable[[Topic], Table], contents: Contents | None = None
    ) -> None:
        """Set `make_table`, which makes the table of a topic; `contents` give the other attributes.

        Outside this package, call `read` or `from_records` instead.
        """
        self._make_table = make_table
        self._tables: dict[str, Table] = {}
        self.metadata: Mapping[str, str] = contents.metadata if contents else {}
        self.attachments: Mapping[str, bytes] = contents.attachments if contents else {}
        self.note = contents.note if contents else ""
        self.lacking = contents.lacking if contents else ""
        self.remarks = contents.remarks if contents else ()

    @property
    def complete(self) -> bool:
        """Whether no message of the flight is missing."""
        return not self.note

    @staticmethod
    def from_records(world: Iterable[Record], cloud: Iterable[Record] = ()) -> Recording:
        """Make a recording from records of world and cloud, each oldest first, all on one clock."""
        store = RecordStore()
        store.add(world, cloud)
        return store.recording()

    @staticmethod
    def read(path: Path) -> Recording:
        """Read an MCAP file up to its end or to its first damaged part.

        Raise a BadInputError if nothing in the file can be read.
        """
        from cloudrc.record.reader import read_contents

        return read_contents(path).recording()

    def __getitem__(self, topic: str) -> Table:
        if topic not in self._tables:
            if topic not in TOPICS:
                raise KeyError(f"no topic {topic!r}; there are: {', '.join(TOPICS)}")
            self._tables[topic] = self._make_table(TOPICS[topic])
        return self._tables[topic]


def _column(kind: Kind, values: Iterable[Any]) -> Column:
    dtype, shape = _TYPES[kind]
    return np.asarray(values, dtype=dtype).reshape(-1, *shape)


class RecordStore(RecordHash):
    """Keeps the records of a flight as columns, hashes them, and makes recordings of them."""

    def add(self, from_world: Iterable[Record], from_cloud: Iterable[Record]) -> None:
        """Add the new records of world and of cloud, each oldest first."""
        self.update(from_world)
        self.update(from_cloud)

    def recording(self) -> Recording:
        """Return a recording of the records so far; their stamps must be on one clock."""
        blocks = self.blocks()
        return Recording(lambda topic: _table(topic, blocks.get(topic.source, [])))


def _table(topic: Topic, blocks: list[Columns]) -> Table:
    if not blocks:
        return Table(topic, (), ())
    stamps_ns, *columns = (_joined(blocks, path) for path in (topic.stamp_path, *topic.paths()))
    if topic.source is Arrival:
        rows = _joined(blocks, "uplink") == (topic.end == "cloud")
    elif topic.end == "either":  # in the order of time, world's row first
        rows = np.argsort(stamps_ns, kind="stable")
    else:
        return Table(topic, stamps_ns, columns)
    return Table(topic, stamps_ns[rows], [column[rows] for column in columns])


def _joined(blocks: list[Columns], path: str) -> Column:
    parts = [block[path] for block in blocks]
    if isinstance(parts[0], tuple):  # of strings
        return np.array([*chain.from_iterable(parts)], dtype=object)
    return np.concatenate(parts)
