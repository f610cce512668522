# SPDX-License-Identifier: Apache-2.0

"""Read a recording as one table per topic, with one array per column.

    recording = Recording.read(path)
    recording["/odometry"]["position"]  # shape (n, 3)

A recording comes from a file or from records in memory; both give the same tables. A topic without
records has a table without rows.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain, repeat
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.results.record.content import Content
from cloudrc.results.record.content import Message as Message  # callers take it from here, too
from cloudrc.results.record.topics import ADDED, BY_SOURCE, TOPICS, UNHASHED, Kind, Topic
from cloudrc.wire.records import Record

Column: TypeAlias = NDArray[Any]

BLOCK = 1000
"""Number of waiting rows of a topic that are converted to columns together."""
ROTATED = ("nav_msgs/msg/Odometry", "velocity")
"""ROS type and column of a value that a file stores in another frame, and thus rounds."""
_TYPES: dict[Kind, tuple[type, tuple[int, ...]]] = {
    "int": (np.int64, ()),
    "float": (np.float64, ()),
    "bool": (np.bool_, ()),
    "string": (np.object_, ()),
    "vector": (np.float64, (3,)),
    "quaternion": (np.float64, (4,)),
    "floats": (np.float64, ()),  # the rows say how many
    "bytes": (np.object_, ()),
}


class Table:
    """The n rows of one topic as columns.

    Integers are stored as int64, floats and vectors as float64, truth values as bool, strings as
    object. The shape is (n, 3) for vectors, (n, 4) for quaternions, (n, m) for m floats, else (n,).
    The columns are read-only, because all metrics and the report share them.
    """

    def __init__(self, topic: Topic, columns: Iterable[Any]) -> None:
        """Store the column of the rows' stamps [ns], then a column for each field of the topic.

        Without columns, the table has no rows.
        """
        kinds = [("stamp_ns", "int"), *((field.name, field.kind) for field in topic.fields)]
        self.columns: dict[str, Column] = {}  # `stamp_ns` first
        for (name, kind), values in zip(kinds, chain(columns, repeat(())), strict=False):
            self.columns[name] = _column(kind, values)

    def __len__(self) -> int:
        return len(self.columns["stamp_ns"])

    def __getitem__(self, name: str) -> Column:
        return self.columns[name]


def _column(kind: Kind, values: Any) -> Column:
    dtype, shape = _TYPES[kind]
    if kind == "floats":
        values = np.stack(values) if len(values) else np.empty((0, 1))
        shape = values.shape[1:]
    if dtype is not np.object_ and not isinstance(values, np.ndarray):  # asarray takes longer
        values = np.fromiter(chain.from_iterable(values) if shape else values, dtype)
    column: Column = np.asarray(values, dtype=dtype).reshape(-1, *shape)
    column.flags.writeable = False
    return column


@dataclass(eq=False)
class Recording(Content):
    """The tables of a flight by topic, and what else a file contains.

    A topic is decoded when its table is read for the first time. A message that
    is not readable is an error then.
    """

    records: RecordStore | None = None  # in place of messages

    def __post_init__(self) -> None:
        self._tables: dict[str, Table] = {}

    @staticmethod
    def from_records(world: Iterable[Record], cloud: Iterable[Record] = ()) -> Recording:
        """Make a recording from records of world and cloud, each oldest first, all on one clock."""
        store = RecordStore()
        store.add(world, cloud)
        return Recording(records=store)

    @staticmethod
    def read(path: Path, *, whole: bool = False, last_ns: int | None = None) -> Recording:
        """Read an MCAP file up to its end or to its first damaged part.

        With `whole`, damage is an error, as is a file of which nothing can be read. With `last_ns`,
        read the messages of the last time [ns] at least.
        """
        from cloudrc.results.record.reader import read

        return Recording(**vars(read(path, whole=whole, last_ns=last_ns)))

    @staticmethod
    def read_topics(path: Path, topics: Collection[str]) -> Recording:
        """Read some topics of an MCAP file as `read` does, but block by block, in little memory."""
        from cloudrc.results.record.reader import read

        store = RecordStore()
        content = read(path, topics=topics, take=partial(store.add_messages, str(path)))
        return Recording(**vars(content), records=store)

    def write(self, target: Path, attachments: Mapping[str, bytes] | None = None) -> None:
        """Write the messages and further `attachments` to a file, atomically; may raise OSError."""
        from cloudrc.results.record.writer import write

        write(self, target, attachments or {})

    @property
    def sha256(self) -> str:
        """Hash of all tables, as 64 hexadecimal digits; records and their file have the same hash.

        The topics are hashed column by column. If both ends write a topic, its rows are hashed in
        the order of their stamps. Numbers are little-endian. The hash omits the column `ROTATED`,
        the topics in `UNHASHED`, and those in `ADDED` without rows.
        """
        total = hashlib.sha256()
        for topic in TOPICS.values():
            table = self[topic.name]
            if topic.name in UNHASHED or (topic.name in ADDED and not len(table)):
                continue
            mixed = topic.end == "either"
            rows = np.argsort(table["stamp_ns"], kind="stable") if mixed else slice(None)
            total.update(f"{topic.name} {len(table)}\n".encode())
            for name, values in table.columns.items():
                column = values[rows]
                if column.dtype == object:
                    known = {
                        each: each.encode("utf-8", "replace") if isinstance(each, str) else each
                        for each in {*column}
                    }
                    total.update(repr([known[each] for each in column]).encode())
                elif (topic.ros_type, name) != ROTATED:
                    total.update(column.data)
        return total.hexdigest()

    def keep(self, first_ns: int, last_ns: int, counted_ns: int) -> None:
        """Remove what has a log time [ns] before `first_ns` or after `last_ns`.

        Counters remain from `counted_ns` [ns] on, because their growth from there is a number.
        """
        since_ns = {"/count": min(counted_ns, first_ns)}
        self.messages = [
            each for each in self.messages if since_ns.get(each[0], first_ns) <= each[1] <= last_ns
        ]
        holes = tuple(hole for hole in self.holes if hole.meets(first_ns, last_ns))
        if self.holes and not holes:  # what is lost is not in this time
            self.lacking = self.told = ""
        self.holes = holes
        self._tables.clear()

    def __getitem__(self, topic: str) -> Table:
        if topic not in self._tables:
            known = self.records.table(TOPICS[topic]) if self.records else self._decode(topic)
            self._tables[topic] = known
        return self._tables[topic]

    def _decode(self, topic: str) -> Table:
        messages = [data for name, _, data in self.messages if name == topic]
        if not messages:
            return Table(TOPICS[topic], ())
        return _decoded(TOPICS[topic], messages, self.source)


def _decoded(topic: Topic, messages: Sequence[bytes], source: str) -> Table:
    """Decode messages of a topic, at least one, of the file `source`."""
    from cloudrc.results.record.reader import decode_all

    return Table(topic, decode_all(topic, messages, f"{source}: a message on {topic.name}"))


def datagrams(table: Table | Mapping[str, Column]) -> Column:
    """Return the number that identifies the datagram of each row: from session and counter."""
    numbers: Column = table["epoch"] << 32 | table["counter"]
    return numbers


def join(left: Column, right: Column) -> tuple[Column, Column]:
    """Find equal values in two columns of integers.

    Return the rows of `left` whose value is in `right`, in their order, and for each of them the
    last row of `right` with this value.
    """
    if not len(right):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    order = right.argsort(kind="stable")
    rows = order[right[order].searchsorted(left, "right") - 1]
    known = np.flatnonzero(right[rows] == left)
    return known, rows[known]


class _Values(dict[str, Any]):
    """The values of named tuples of one class: dotted path of a field -> a value per tuple."""

    def __init__(self, tuples: Sequence[Any], path: str = "") -> None:
        names = tuples[0]._fields
        super().__init__(
            zip([path + name for name in names], zip(*tuples, strict=True), strict=True)
        )

    def __missing__(self, path: str) -> Any:
        head = path.rpartition(".")[0]
        self |= _Values(self[head], f"{head}.")
        return self[path]


class RecordStore:
    """Keeps the records of a flight as columns, which take less memory than the records."""

    def __init__(self) -> None:
        self._waiting: defaultdict[type[Record], list[Record]] = defaultdict(list)
        self._blocks: defaultdict[str, list[Table]] = defaultdict(list)  # by topic

    def add(self, from_world: Iterable[Record], from_cloud: Iterable[Record]) -> None:
        """Add the new records of world and of cloud, each oldest first."""
        for record in chain(from_world, from_cloud):
            self._waiting[type(record)].append(record)
        for kind in [kind for kind, waiting in self._waiting.items() if len(waiting) >= BLOCK]:
            self._convert(kind)

    def add_messages(self, source: str, messages: Iterable[Message]) -> None:
        """Add messages of the file `source`."""
        by_topic = defaultdict[str, list[bytes]](list)
        for topic, _, data in messages:
            by_topic[topic].append(data)
        for topic, found in by_topic.items():
            self._blocks[topic].append(_decoded(TOPICS[topic], found, source))

    def _convert(self, kind: type[Record]) -> None:
        """Convert the waiting records of one class to a block for each of their topics."""
        if not (records := self._waiting.pop(kind, [])):
            return
        whole = _Values(records)
        for topic in BY_SOURCE[kind]:
            if chosen := topic.choose(records):
                values = whole if chosen is records else _Values(chosen)
                block = Table(topic, map(values.__getitem__, topic.paths[kind]))
                self._blocks[topic.name].append(block)

    def table(self, topic: Topic) -> Table:
        """Make the table of a topic; the stamps of all records must be on one clock."""
        for kind in topic.paths:
            self._convert(kind)
        if not (blocks := self._blocks[topic.name]):
            return Table(topic, ())
        columns = [np.concatenate([block[name] for block in blocks]) for name in blocks[0].columns]
        if topic.end == "either" or topic.also:  # in the order of time, world's row first
            order = np.argsort(columns[0], kind="stable")
            columns = [column[order] for column in columns]
        whole = Table(topic, columns)
        self._blocks[topic.name] = [whole]  # in place of the blocks, which take as much memory
        return whole
