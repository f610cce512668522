# SPDX-License-Identifier: Apache-2.0

"""Helpers: random records, records of a short flight, and files written by other programs."""

import heapq
import math
from enum import IntEnum
from operator import attrgetter
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from cloudrc.results.record.columns import Recording
from cloudrc.results.record.topics import TOPICS
from cloudrc.results.record.writer import McapWriter
from cloudrc.wire import records as rec
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.wire.records import Record
from tests.doors.console.conftest import control

MS = 1_000_000
SECOND = 1000 * MS
CLASSES = get_args(Record)

_stamps = st.integers(0, 2**31 * SECOND - 1)
_integers = st.integers(-(2**63), 2**63 - 1)
_metres = st.floats(-1e6, 1e6)
_singles = st.floats(-100.0, 100.0, width=32)
_directions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1)


def _unit(q):
    return tuple(component / math.hypot(*q) for component in q)


def _strategy(name, kind):
    if hasattr(kind, "_fields"):
        return instances(kind)
    if kind == rec.SensorLabel | None:
        return st.none() | instances(rec.SensorLabel)
    if kind == rec.Numbers:  # as many in each record
        return st.lists(_singles, min_size=3, max_size=3)
    if get_origin(kind) is tuple:
        return st.tuples(*[_metres] * 3) if len(get_args(kind)) == 3 else _directions.map(_unit)
    if get_origin(kind) is Literal:
        return st.sampled_from(get_args(kind))
    if issubclass(kind, IntEnum):
        return st.sampled_from(kind)
    if name == "stamp_ns":
        return _stamps
    simple = {int: _integers, float: st.floats(), bool: st.booleans(), str: st.text()}
    return {**simple, bytes: st.binary()}[kind]


def instances(cls):
    """Generate random records of a class."""
    hints = get_type_hints(cls)
    if cls is rec.ScanTaken:  # ROS's message has single precision
        singles = {name: _singles for name, kind in hints.items() if kind is float}
        return st.builds(cls, stamp_ns=_stamps, ranges=_strategy("", rec.Numbers), **singles)
    return st.builds(cls, **{name: _strategy(name, kind) for name, kind in hints.items()})


def any_record():
    return st.one_of(*map(instances, CLASSES))


def world_records(count, start_ns=0):
    """Make world's records at 100 Hz; each command was on its way for 30 ms."""
    records = [
        rec.SessionOpened(start_ns, "world", 1, "cloud said hello"),
        rec.GuardChange(start_ns, GuardState.TRACK, "mission started"),
    ]
    for n in range(count):
        now = start_ns + n * 10 * MS
        position, velocity = (0.01 * n, math.sin(n), 1.0), (1.0, math.cos(n), 0.1)
        odometry = Odometry(now, position, UPRIGHT, velocity, (0.0, 0.1, 0.2))
        telemetry = Telemetry(now, odometry, (0.1,), now - 5, 7, 0, 1, GuardState.TRACK)
        records += [
            rec.TelemetrySent(now, 1, n, telemetry),
            rec.GroundTruth(now, odometry, velocity),
            rec.ContactForce(now, 0.2, 0.3, 0.001),
            rec.SensorRead(now, "battery", "V", 11.9),
            rec.EnergyUsed(now, 0.8 * n),
        ]
        if n >= 3:
            records += [
                rec.Arrival(now + 3 * MS, False, 1, n - 3, 0.03, True),
                rec.CommandApplied(now + 4 * MS, 1, n - 3, now - 60 * MS, velocity),
            ]
    records += [rec.Contact(now, "board", ZERO, ZERO, ZERO, True)]
    records += [rec.Counted(now, "world", "sent", count), rec.CellWait(now, True, 1, 0, MS)]
    records.append(rec.LinkWait(now, True, 1, 0, MS, 2 * MS, 3 * MS, 0))
    return sorted(records, key=attrgetter("stamp_ns"))


def cloud_records(count, start_ns=0):
    """Make cloud's records at 100 Hz; a command leaves 3 ms after each period."""
    records = [rec.SessionOpened(start_ns, "cloud", 1, "world said yes")]
    for n in range(count):
        now = start_ns + n * 10 * MS
        period = now + 3 * MS
        records += [
            rec.Arrival(now + 40 * MS, True, 1, n, math.nan, n % 7 > 0),
            control(period / SECOND, now / SECOND, counter=n, horizon=0.08, rtt=0.07),
            rec.PlanFollowed(period, now, ZERO),
        ]
    records.append(rec.MissionEvent(period, "done", 2, "mission done — ça va"))
    records += [rec.Fault(period, "late", ""), rec.Counted(period, "cloud", "", 3)]
    records.append(rec.Left(period, 1, count - 1))
    return sorted(records, key=attrgetter("stamp_ns"))


def later(records, offset_ns):
    """Add `offset_ns` to the stamps of cloud's records."""
    return [record._replace(stamp_ns=record.stamp_ns + offset_ns) for record in records]


def write(path, records, clock="world", clock_id=""):
    with McapWriter(path, clock=clock, clock_id=clock_id) as writer:
        writer.write(records)
    return path


def write_mission(path, world, cloud, attachments=None, metadata=None):
    """Write the records of world and cloud to one file, as a run in virtual time does."""
    with McapWriter(path, clock="world") as writer:
        writer.write(heapq.merge(world, cloud, key=attrgetter("stamp_ns")))
        writer.note(metadata or {})
        for name, data in (attachments or {}).items():
            writer.attach(name, data)


def rewrite(
    source,
    target,
    *,
    keep=lambda channel, message: True,
    rename=str,
    shuffle=lambda messages: None,
    metadata=True,
    **options,
):
    """Rewrite a recording as another program does; `shuffle` changes the messages in place."""
    with source.open("rb") as old, target.open("wb") as new:
        reader = make_reader(old)
        messages = [(s, c, m) for s, c, m in reader.iter_messages() if keep(c, m)]
        shuffle(messages)
        writer = Writer(new, **{"compression": CompressionType.ZSTD} | options)
        writer.start(profile="ros2", library="another")
        ids = {}
        for schema, channel, message in messages:
            if channel.id not in ids:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                name = rename(channel.topic)
                ids[channel.id] = writer.register_channel(name, "cdr", number, channel.metadata)
            writer.add_message(**vars(message) | {"channel_id": ids[channel.id]})
        for each in reader.iter_attachments() if metadata else ():
            writer.add_attachment(**vars(each))
        for entry in reader.iter_metadata() if metadata else ():
            writer.add_metadata(entry.name, entry.metadata)
        writer.finish()
    return target


def copied(path):
    """Copy a recording, and read the copy."""
    Recording.read(path).write(target := path.with_suffix(".copy.mcap"))
    return Recording.read(target)


def assert_equal(one, other):
    """Check that all columns are equal; for rotated velocities, up to rounding errors."""
    for topic in TOPICS:
        for name in one[topic].columns:
            first, second = one[topic][name], other[topic][name]
            assert first.dtype == second.dtype, (topic, name)
            assert first.shape == second.shape, (topic, name)
            if TOPICS[topic].ros_type == "nav_msgs/msg/Odometry" and name == "velocity":
                np.testing.assert_allclose(first, second, rtol=1e-12, atol=1e-8)
            else:
                np.testing.assert_array_equal(first, second, err_msg=f"{topic} {name}")


def counted(count):
    """Make `count` records of a counter, 10 ms apart."""
    return [rec.Counted(n * 10 * MS, "world", "sent", n) for n in range(count)]


def open_mcap(path):
    return McapWriter(path, clock="world")


class Shelf:
    """A writer that keeps the records in a list."""

    def __init__(self):
        self.records, self.closed = [], False

    def write(self, records):
        self.records += records

    def flush(self):
        pass

    sync = flush

    def note_losses(self, text, holes):
        self.lost = text, list(holes)

    def abandon(self, reason, code):
        self.closed = True
        return 0

    def close(self):
        self.closed = True
