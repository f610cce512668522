"""Define the topics of a recording, and convert records to rows of topics.

Each record gives a row in one or more topics. A topic is a table with the column `stamp_ns` and the
fields below, which are named as in `cloudrc/records.py`. Quaternions are `wxyz` and velocities are
in the world frame; `cloudrc/record/ros.py` converts both for ROS.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Any, Literal, NamedTuple, TypeAlias

from cloudrc import records as rec
from cloudrc.messages import MISSION_OVER, Cause
from cloudrc.records import Record

Kind: TypeAlias = Literal["int", "float", "bool", "string", "vector", "quaternion"]
Values: TypeAlias = tuple[Any, ...]
Row: TypeAlias = tuple[str, int, Values]
"""Topic, stamp [ns] on the clock of the recording end (world or cloud), values of the fields."""


class Field(NamedTuple):
    """A column of a topic, which holds one value per row."""

    name: str  # name of the column and of the ROS field
    kind: Kind  # kind of a value; vectors have shape (3,), quaternions (4,)
    unit: str  # unit of the values; "" without a unit
    text: str  # meaning of the values
    path: str = ""  # dotted path of the value in the record; "": see `Topic.paths`


class Topic(NamedTuple):
    """A table of the recording."""

    name: str  # name in the MCAP file, with its slash
    ros_type: str  # a type of `cloudrc_msgs` is defined by `fields`
    source: type[Record]  # class of the records
    end: Literal["world", "cloud", "either"]  # end that records the topic
    text: str  # meaning of a row
    fields: tuple[Field, ...]  # the columns after `stamp_ns`
    stamp_path: str = "stamp_ns"  # dotted path of the row's stamp in the record
    part: str = ""  # path, with a final dot, of a nested record with fields that `source` lacks

    def paths(self) -> list[str]:
        """Return where each field's value is in the record, as dotted paths."""
        own = self.source._fields
        return [
            field.path or (field.name if field.name in own else f"{self.part}{field.name}")
            for field in self.fields
        ]


_POSE_AND_TWIST = (
    Field("position", "vector", "m", "of the base, world frame"),
    Field("orientation_wxyz", "quaternion", "1", "of the base, body to world"),
    Field("velocity", "vector", "m/s", "of the base, world frame"),
    Field("angular_velocity_body", "vector", "rad/s", "of the base, body frame"),
)
_WAY = Field("uplink", "bool", "", "true for the uplink, false for the downlink")
_EPOCH = Field("epoch", "int", "", "epoch of its session")
_COUNTER = Field("counter", "int", "", "counter in the datagram's header")
_BASIS = Field("basis_stamp_ns", "int", "ns", "stamp of the odometry used, world's clock")
_END = Field("end", "string", "", "process that recorded the row: world, cloud or link")
_SLIP = Field("slip_ns", "int", "ns", "lag of world's clock behind the machine's monotonic clock")
_GUARD = "0 GROUND, 1 TRACK, 2 HOLD, 3 LAND, 4 ESTOP"
_CAUSES = "of the guard's state: " + "; ".join(f"{cause:d} {cause.words}" for cause in Cause)
_ODOMETRY = "stamp of its odometry, world's clock"
_ECHO = "stamp of the newest command applied, cloud's clock; -1 if none"
_EVENTS = (
    "started, reached, held, resumed, goto, driving, operator_lost; at the end the outcome: done,"
    " cancelled, timed_out, leg_timed_out, world_restarted, guard_stopped, emergency_stopped,"
    " taken_over, end_lost"
)
_CODES = (
    "one word, for example estimator_failed, predictor_failed, controller_failed, recorder,"
    " link_check, wall_clock, late"
)
_COUNTED = (
    "what is counted, for example received, sent, malformed, late, stale, repeated, old_epoch,"
    " range, recorder_dropped"
)
_ARRIVAL = (
    _EPOCH,
    _COUNTER,
    Field("delay", "float", "s", "one way; NaN unless the ends share a clock"),
    Field("used", "bool", "", "true if it became the newest, false if late, repeated or refused"),
)

# fmt: off
_TABLE = (
    Topic("/odometry", "nav_msgs/msg/Odometry", rec.TelemetrySent, "world",
        "Measured pose and twist, as sent to cloud, world's clock",
        _POSE_AND_TWIST,
        stamp_path="telemetry.odometry.stamp_ns", part="telemetry.odometry."),
    Topic("/telemetry", "cloudrc_msgs/msg/Telemetry", rec.TelemetrySent, "world",
        "Telemetry sent to cloud, without the pose and twist, world's clock", (
        _EPOCH,
        _COUNTER,
        Field("odometry_stamp_ns", "int", "ns", _ODOMETRY, "telemetry.stamp_ns"),
        Field("tip_force", "float", "N", "on the arm's tip"),
        Field("echo_stamp_ns", "int", "ns", _ECHO),
        Field("echo_hold_ns", "int", "ns", "time since world applied that command; 0 if none"),
        Field("slip_ns", "int", "ns", _SLIP.text),
        Field("mission", "int", "", "number of the last operator's request that world obeyed"),
        Field("guard", "int", "", _GUARD),
        Field("pipe_contacts", "int", "", "contacts with a pipe that began in this mission"),
        Field("touch_speed", "float", "m/s", "of the tip's first contact with the board, or NaN"),
        Field("mission_id", "int", "", "identity of the mission started last; 0 if none"),
        Field("reached", "int", "", f"waypoints reached; {MISSION_OVER} if the mission is over"),
        Field("cause", "int", "", _CAUSES)),
        part="telemetry."),
    Topic("/ground_truth", "nav_msgs/msg/Odometry", rec.GroundTruth, "world",
        "True pose and twist, world's clock",
        _POSE_AND_TWIST,
        stamp_path="odometry.stamp_ns", part="odometry."),
    Topic("/contact_force", "cloudrc_msgs/msg/ContactForce", rec.GroundTruth, "world",
        "Force on the touch sensor at the tip of the arm, world's clock", (
        Field("tip_force", "float", "N", "on the arm's tip"),
        Field("tip_force_peak", "float", "N", "largest of all physics steps since the row before"),
        Field("tip_impulse", "float", "N s", "force times time since the row before"))),
    Topic("/reference", "geometry_msgs/msg/TwistStamped", rec.GroundTruth, "world",
        "Velocity that the guard lets the low-level controller follow, world's clock", (
        Field("reference", "vector", "m/s", "after the guard's caps, world frame"),)),
    Topic("/uplink_delay", "cloudrc_msgs/msg/Arrival", rec.Arrival, "cloud",
        "A telemetry datagram arrived at cloud, in time or late, cloud's clock",
        _ARRIVAL),
    Topic("/downlink_delay", "cloudrc_msgs/msg/Arrival", rec.Arrival, "world",
        "A command arrived at world, in time or late, world's clock",
        _ARRIVAL),
    Topic("/command_applied", "cloudrc_msgs/msg/CommandApplied", rec.CommandApplied, "world",
        "The robot began to follow a command, world's clock", (
        *(_EPOCH, _COUNTER, _BASIS),
        Field("velocity", "vector", "m/s", "before the guard's caps, world frame"),
        Field("planned_ns", "int", "ns",
            "time at which the plan begins, world's clock; -1 without a plan"))),
    Topic("/guard", "cloudrc_msgs/msg/GuardChange", rec.GuardChange, "world",
        "The guard changed its state, world's clock", (
        Field("state", "int", "", _GUARD), Field("cause", "string", "", "why, in words"))),
    Topic("/contact", "cloudrc_msgs/msg/Contact", rec.Contact, "world",
        "The robot touched something, world's clock", (
        Field("body", "string", "", "touched body of the scene: pipe_1, board, floor"),
        Field("position", "vector", "m", "of the base, world frame"),
        Field("velocity", "vector", "m/s", "of the base just before the contact, world frame"),
        Field("tip_velocity", "vector", "m/s", "of the tip just before the contact, world frame"),
        Field("tip", "bool", "", "true if the arm's tip touched, false for any other part"))),
    Topic("/session", "cloudrc_msgs/msg/SessionOpened", rec.SessionOpened, "either",
        "A session began under a new epoch, clock of its end", (
        _END, _EPOCH, Field("cause", "string", "", "why, in words"))),
    Topic("/estimated_odometry", "nav_msgs/msg/Odometry", rec.Control, "cloud",
        "Predicted pose and twist that the controller used, cloud's clock. The prediction is for"
        " the instant basis_stamp_ns + horizon; /delay_estimate has these two columns",
        _POSE_AND_TWIST[:3]),
    Topic("/setpoint_position", "geometry_msgs/msg/PointStamped", rec.Control, "cloud",
        "Position that the controller tracks, cloud's clock", (
        Field("setpoint", "vector", "m", "position to fly to, world frame"),)),
    Topic("/cmd_vel", "geometry_msgs/msg/TwistStamped", rec.Control, "cloud",
        "Velocity command that cloud sent, cloud's clock", (
        Field("command", "vector", "m/s", "world frame"),
        Field("yaw_rate", "float", "rad/s", "about the world's z axis"))),
    Topic("/delay_estimate", "cloudrc_msgs/msg/DelayEstimate", rec.Control, "cloud",
        "Estimated delay, over which the odometry was predicted, cloud's clock", (
        _EPOCH,
        _COUNTER,
        _BASIS,
        Field("horizon", "float", "s", "time by which the odometry was predicted ahead"),
        Field("rtt", "float", "s", "last round trip without the time in world, or NaN"),
        Field("loop_delay", "float", "s", "round trip with the time in world: the paper's tau_n"),
        Field("measured", "vector", "m", "position in the odometry used, world frame"))),
    Topic("/pid", "cloudrc_msgs/msg/Pid", rec.Control, "cloud",
        "Terms of the controller's velocity command, cloud's clock", (
        Field("waypoint", "int", "", "index of the waypoint flown to; -1 if none"),
        Field("proportional", "vector", "m/s", "term per axis, world frame"),
        Field("integral", "vector", "m/s", "term per axis, world frame"),
        Field("derivative", "vector", "m/s", "term per axis, world frame"))),
    Topic("/mission", "cloudrc_msgs/msg/MissionEvent", rec.MissionEvent, "cloud",
        "An event of the mission, cloud's clock", (
        Field("event", "string", "", _EVENTS),
        Field("waypoint", "int", "", "index of the waypoint concerned; -1 if none"),
        Field("text", "string", "", "the event in words"))),
    Topic("/fault", "cloudrc_msgs/msg/Fault", rec.Fault, "either",
        "A fault that did not stop the flight, clock of its end", (
        Field("code", "string", "", _CODES),
        Field("text", "string", "", "what is wrong, where, what to do"),
        Field("traceback", "string", "", "of a plug-in's first failure, else empty"))),
    Topic("/count", "cloudrc_msgs/msg/Counted", rec.Counted, "either",
        "Value of a counter, clock of its end", (
        _END,
        Field("name", "string", "", _COUNTED),
        Field("total", "int", "", "count since the start"))),
    Topic("/link", "cloudrc_msgs/msg/LinkChanged", rec.LinkChanged, "either",
        "Conditions of one direction of the emulated link, clock of its end. World writes those of"
        " the uplink, cloud those of the downlink. In real time only", (
        _WAY,
        Field("shaper", "string", "", "relay or netem"),
        Field("cause", "string", "", "why it changed; empty before the first change"),
        Field("age", "float", "s", "time since these conditions took effect"),
        Field("time_line", "float", "s",
            "time since the time line (changes, blackouts, trace) began"),
        Field("delay", "float", "s", "profile's delay at the start of the time line, one way"),
        Field("jitter", "float", "s", "profile's jitter at the start of the time line"),
        Field("loss", "float", "1", "profile's mean loss at the start of the time line"),
        Field("rate", "float", "bit/s", "profile's rate at the start of the time line, or NaN"),
        Field("conditions", "string", "", "the profile as JSON"))),
    Topic("/link_check", "cloudrc_msgs/msg/LinkChecked", rec.LinkChecked, "either",
        "A quantity of the link, such as the mean delay: the value that the receiving end measured,"
        " and the value that the profile asks for, clock of its end. In real time only", (
        _WAY,
        Field("quantity", "string", "", "mean, deviation, round_trip, loss, ..."),
        Field("asked", "float", "s or 1", "value expected from the profile: a delay or a share"),
        Field("measured", "float", "s or 1", "measured value: a delay or a share"),
        Field("low", "float", "s or 1", "lowest accepted value"),
        Field("high", "float", "s or 1", "highest accepted value"),
        Field("verdict", "string", "",
            "ok, off, or open (undecided); told: not judged"),
        Field("datagrams", "int", "", "number of datagrams measured"))),
    Topic("/lateness", "cloudrc_msgs/msg/Lateness", rec.Lateness, "either",
        "Lateness of one period of the loop, in real time only, clock of its end", (
        _END,
        Field("lateness", "float", "s", "time from the deadline to its handling"),
        Field("busy", "float", "s", "duration of the handling"),
        _SLIP)),
)
# fmt: on

TOPICS: dict[str, Topic] = {topic.name: topic for topic in _TABLE}
"""Name -> topic, for every topic of a recording."""

VIEWS: dict[str, str] = {
    "/tf": "tf2_msgs/msg/TFMessage",
    "/scene": "visualization_msgs/msg/MarkerArray",
    **dict.fromkeys(("/tracking_error", "/prediction_error"), "std_msgs/msg/Float64"),
}
"""Topic for viewers -> ROS type. These topics repeat a mission's other topics in forms that
Foxglove and Lichtblick can show (`cloudrc/report/views.py`). A report does not read them."""

_Extract: TypeAlias = tuple[str, Callable[[Record], int], Callable[[Record], Values]]


def _values_getter(paths: list[str]) -> Callable[[Any], Values]:
    get = attrgetter(*paths)
    return get if len(paths) > 1 else lambda record: (get(record),)


_EXTRACT: dict[type[Record], tuple[_Extract, ...]] = {
    source: tuple(
        (topic.name, attrgetter(topic.stamp_path), _values_getter(topic.paths()))
        for topic in _TABLE
        if topic.source is source
    )
    for source in {topic.source for topic in _TABLE}
}
_UPLINK, _DOWNLINK = _EXTRACT.pop(rec.Arrival)


def rows(record: Record) -> list[Row]:
    """Convert a record to rows: one for each of its topics, in the order of `TOPICS`."""
    if isinstance(record, rec.Arrival):
        name, stamp, values = _UPLINK if record.uplink else _DOWNLINK
        return [(name, stamp(record), values(record))]
    return [(name, stamp(record), values(record)) for name, stamp, values in _EXTRACT[type(record)]]
