# SPDX-License-Identifier: Apache-2.0

"""Define the topics of a recording, and convert records to rows of topics.

Each record gives a row in one or more topics. A topic is a table with the column `stamp_ns` and a
column for each value that `wire/records.py` annotates with its unit and meaning. Quaternions are
`wxyz` and velocities are in the world frame; `record/ros.py` converts both for ROS.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    TypeAlias,
    get_args,
    get_origin,
    get_type_hints,
)

from cloudrc.wire import records as rec
from cloudrc.wire.messages import Cause, GuardState, Quaternion, Vector
from cloudrc.wire.records import Record

Kind: TypeAlias = Literal[
    "int", "float", "bool", "string", "vector", "quaternion", "floats", "bytes"
]
Values: TypeAlias = tuple[Any, ...]
Row: TypeAlias = tuple[Any, ...]
"""Stamp [ns] on the clock of the recording end (world or cloud), then the values of the fields."""


class Field(NamedTuple):
    """A column of a topic, which holds one value per row."""

    name: str  # name of the column and of the ROS field
    kind: Kind  # kind of a value; vectors have shape (3,), quaternions (4,), floats any (n,)
    unit: str  # unit of the values; "" without a unit
    text: str  # meaning of the values
    path: str  # dotted path of the value in the record


@dataclass(frozen=True)
class Topic:
    """A table of the recording."""

    name: str  # name in the MCAP file, with its slash
    ros_type: str  # a type of `cloudrc_msgs` is defined by `fields`
    source: type[Record]  # class of the records
    end: Literal["world", "cloud", "either"]  # end that records the topic
    text: str  # meaning of a row
    names: str = ""  # the columns after `stamp_ns`, separated by spaces; "": all values of `parts`
    parts: tuple[str, ...] = ("",)  # paths of nested records, each with a final dot; "": `source`
    also: tuple[type[Record], str] | None = None  # further class of records, paths of the columns

    @cached_property
    def fields(self) -> tuple[Field, ...]:
        """The columns after `stamp_ns`."""
        known = [field for part in self.parts for field in _fields(self.source, part)]
        names = self.names.split() or [field.name for field in known]
        return tuple(field for field in known if field.name in names)

    @cached_property
    def paths(self) -> dict[type[Record], list[str]]:
        """Class of records -> dotted paths of stamp and columns in such a record."""
        own = [f"{self.parts[0]}stamp_ns", *(field.path for field in self.fields)]
        return {self.source: own} | ({self.also[0]: self.also[1].split()} if self.also else {})

    @cached_property
    def _getters(self) -> dict[type[Record], Callable[[Record], Row]]:
        return {kind: attrgetter(*paths) for kind, paths in self.paths.items()}

    def row(self, record: Record) -> Row:
        """Convert a record to a row."""
        return self._getters[type(record)](record)

    def choose(self, records: list[Any]) -> list[Any]:
        """Return those of the records, all of one class, that give a row of this topic."""
        if self.source is rec.Arrival:
            is_uplink = self.end == "cloud"
            return [record for record in records if record.uplink == is_uplink]
        if self.also and isinstance(records[0], self.also[0]):
            return [record for record in records if record.sensor is not None]
        return records


_KINDS: dict[Any, Kind] = {
    int: "int",
    GuardState: "int",
    Cause: "int",
    float: "float",
    bool: "bool",
    str: "string",
    Vector: "vector",
    Quaternion: "quaternion",
    rec.Numbers: "floats",
    bytes: "bytes",
}


def _fields(cls: Any, part: str) -> Iterator[Field]:
    """Yield the values of a record's `part` that are annotated with their unit and meaning."""
    for name in part.split(".")[:-1]:
        cls = get_type_hints(cls)[name]
    for name, hint in get_type_hints(cls, include_extras=True).items():
        if get_origin(hint) is Annotated:
            kind, unit, text = get_args(hint)
            kind = str if get_origin(kind) is Literal else kind
            column = "odometry_stamp_ns" if name == "stamp_ns" else name
            yield Field(column, _KINDS[kind], unit, text, part + name)


# fmt: off
_TABLE = (
    Topic("/odometry", "nav_msgs/msg/Odometry", rec.TelemetrySent, "world",
        "Measured pose and twist, as sent to cloud, world's clock",
        parts=("telemetry.odometry.",)),
    Topic("/telemetry", "cloudrc_msgs/msg/Telemetry", rec.TelemetrySent, "world",
        "Telemetry sent to cloud, without pose, twist and the robot's own sensors, world's clock",
        parts=("", "telemetry.")),
    Topic("/ground_truth", "nav_msgs/msg/Odometry", rec.GroundTruth, "world",
        "True pose and twist, world's clock", parts=("odometry.",)),
    Topic("/contact_force", "cloudrc_msgs/msg/ContactForce", rec.ContactForce, "world",
        "Force on the touch sensor of the robot's probe, world's clock. Only with such a sensor"),
    Topic("/sensor", "cloudrc_msgs/msg/SensorRead", rec.SensorRead, "world",
        "Value of one of the robot's own sensors, world's clock. Telemetry carries it to cloud",
        also=(rec.ContactForce, "stamp_ns sensor.name sensor.unit force")),
    Topic("/scan", "sensor_msgs/msg/LaserScan", rec.ScanTaken, "world",
        "Distances that the robot's scanner measured, as sent to cloud, world's clock"),
    Topic("/target", "geometry_msgs/msg/PointStamped", rec.TargetSeen, "world",
        "True position of the moving body that a mission follows, world's clock", "position"),
    Topic("/target_view", "cloudrc_msgs/msg/TargetSeen", rec.TargetSeen, "world",
        "Where the camera of the robot has the body of /target in truth, world's clock",
        "bearing distance in_picture"),
    Topic("/reference", "geometry_msgs/msg/TwistStamped", rec.GroundTruth, "world",
        "Velocity that the guard lets the onboard controller follow, world's clock", "reference"),
    Topic("/energy", "cloudrc_msgs/msg/EnergyUsed", rec.EnergyUsed, "world",
        "Mechanical energy of the robot's rotors, world's clock. Only if their speeds are known"),
    Topic("/uplink_delay", "cloudrc_msgs/msg/Arrival", rec.Arrival, "cloud",
        "A telemetry datagram arrived at cloud, in time or late, cloud's clock",
        "epoch counter delay used"),
    Topic("/downlink_delay", "cloudrc_msgs/msg/Arrival", rec.Arrival, "world",
        "A command arrived at world, in time or late, world's clock", "epoch counter delay used"),
    Topic("/command_applied", "cloudrc_msgs/msg/CommandApplied", rec.CommandApplied, "world",
        "The robot began to follow a command, world's clock"),
    Topic("/guard", "cloudrc_msgs/msg/GuardChange", rec.GuardChange, "world",
        "The guard changed its state, world's clock"),
    Topic("/contact", "cloudrc_msgs/msg/Contact", rec.Contact, "world",
        "The robot touched something, world's clock"),
    Topic("/session", "cloudrc_msgs/msg/SessionOpened", rec.SessionOpened, "either",
        "A session began under a new epoch, clock of its end"),
    Topic("/estimated_odometry", "nav_msgs/msg/Odometry", rec.Control, "cloud",
        "Predicted pose and twist that the controller used, cloud's clock. The prediction is for"
        " the instant basis_stamp_ns + horizon; /delay_estimate has these two columns",
        "position orientation_wxyz velocity"),
    Topic("/setpoint_position", "geometry_msgs/msg/PointStamped", rec.Control, "cloud",
        "Position that the controller tracks, cloud's clock", "setpoint"),
    Topic("/cmd_vel", "geometry_msgs/msg/TwistStamped", rec.Control, "cloud",
        "Velocity command that cloud sent, cloud's clock", "command yaw_rate"),
    Topic("/delay_estimate", "cloudrc_msgs/msg/DelayEstimate", rec.Control, "cloud",
        "Estimated delay, over which the odometry was predicted, cloud's clock",
        "epoch counter basis_stamp_ns horizon rtt loop_delay measured"),
    Topic("/pid", "cloudrc_msgs/msg/Pid", rec.Control, "cloud",
        "Terms of the controller's velocity command, cloud's clock",
        "waypoint proportional integral derivative"),
    Topic("/plan", "cloudrc_msgs/msg/PlanFollowed", rec.PlanFollowed, "cloud",
        "With plans: the position that the plan in use had predicted for the newest odometry,"
        " cloud's clock"),
    Topic("/left", "cloudrc_msgs/msg/Left", rec.Left, "cloud",
        "A command left cloud, cloud's clock. Only if a computation takes simulated time"),
    Topic("/cell_wait", "cloudrc_msgs/msg/CellWait", rec.CellWait, "world",
        "A datagram left the radio cell, world's clock. Only in virtual time, with a cell"),
    Topic("/link_wait", "cloudrc_msgs/msg/LinkWait", rec.LinkWait, "world",
        "Where a datagram waits in the link, world's clock. Only in virtual time, with a rate or a"
        " radio"),
    Topic("/perception", "cloudrc_msgs/msg/Perceived", rec.Perceived, "cloud",
        "What became of a scan or picture at cloud's perception, cloud's clock"),
    Topic("/frame", "cloudrc_msgs/msg/FrameSent", rec.FrameSent, "world",
        "A picture of the robot's camera was sent, world's clock"),
    Topic("/frame_shown", "cloudrc_msgs/msg/FrameShown", rec.FrameShown, "cloud",
        "A picture was there with all that it needs, cloud's clock"),
    Topic("/camera", "sensor_msgs/msg/CompressedImage", rec.FrameKept, "cloud",
        "A picture as cloud had it, cloud's clock: a row for each of /frame_shown. Only with"
        " camera.keep"),
    Topic("/mission", "cloudrc_msgs/msg/MissionEvent", rec.MissionEvent, "cloud",
        "An event of the mission, cloud's clock"),
    Topic("/fault", "cloudrc_msgs/msg/Fault", rec.Fault, "either",
        "A fault that did not stop the flight, clock of its end"),
    Topic("/count", "cloudrc_msgs/msg/Counted", rec.Counted, "either",
        "Value of a counter, clock of its end"),
    Topic("/link", "cloudrc_msgs/msg/LinkChanged", rec.LinkChanged, "either",
        "Conditions of one direction of the emulated link, clock of its end. World writes those of"
        " the uplink, cloud those of the downlink. In real time only"),
    Topic("/link_check", "cloudrc_msgs/msg/LinkChecked", rec.LinkChecked, "either",
        "A quantity of the link, such as the mean delay: the value that the receiving end measured,"
        " and the value that the profile asks for, clock of its end. In real time only"),
    Topic("/lateness", "cloudrc_msgs/msg/Lateness", rec.Lateness, "either",
        "Lateness of one period of the loop, in real time only, clock of its end"),
)
# fmt: on

TOPICS: dict[str, Topic] = {topic.name: topic for topic in _TABLE}
"""Name -> topic, for every topic of a recording."""

ADDED = (
    *("/plan", "/sensor", "/scan", "/perception", "/frame", "/frame_shown", "/camera"),
    *("/target", "/target_view"),
)
"""Topics that came later than the others; without rows they do not change a hash."""
UNHASHED = ("/energy", "/left", "/cell_wait", "/link_wait")
"""Topics that never change a hash: flights from before them keep theirs."""

VIEWS: dict[str, str] = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/scene": "visualization_msgs/msg/MarkerArray",
    **dict.fromkeys(("/tracking_error", "/prediction_error"), "std_msgs/msg/Float64"),
}
"""Topic for viewers -> ROS type. These topics repeat a mission's other topics in forms that
Foxglove and Lichtblick can show (`report/views.py`). A report does not read them."""

BY_SOURCE: dict[type[Record], list[Topic]] = {
    source: [topic for topic in _TABLE if source in topic.paths]
    for source in {topic.source for topic in _TABLE}
}
"""Class of records -> its topics."""


def topics_of(record: Record) -> list[Topic]:
    """List the topics in which a record gives a row, in the order of `TOPICS`."""
    return [topic for topic in BY_SOURCE[type(record)] if topic.choose([record])]
