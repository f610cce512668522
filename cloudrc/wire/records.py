# SPDX-License-Identifier: Apache-2.0

"""The records of a run, which world, cloud and the drivers make during a flight.

A record is a named tuple. `stamp_ns` is the time at which the record was made [ns], on the clock of
world or cloud, whichever made it. `epoch` and `counter` identify a datagram, as in its header. Each
docstring begins with the maker: world, cloud, or the driver, which runs one of them.

Each value is a column of a topic (`results/record/topics.py`). Its annotation names the type, the
unit ("" if it has none) and the meaning.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, NamedTuple, TypeAlias, get_args

from cloudrc.wire.messages import (
    NEVER_NS,
    STATES,
    GuardState,
    Odometry,
    Quaternion,
    Slip,
    Telemetry,
    Vector,
)

Way: TypeAlias = Annotated[bool, "", "true for the uplink, false for the downlink"]
Epoch: TypeAlias = Annotated[int, "", "epoch of its session"]
Number: TypeAlias = Annotated[int, "", "counter in the datagram's header"]
UNSENT = -1
"""Counter of a command that cloud did not send."""
Basis: TypeAlias = Annotated[int, "ns", "stamp of the odometry used, world's clock"]
Numbers: TypeAlias = Sequence[float]
"""As many numbers in each record of a flight."""
End: TypeAlias = Annotated[str, "", "process that recorded the row: world, cloud or link"]


class LinkChanged(NamedTuple):
    """The requested conditions of one direction of the link. Topic /link.

    The driver makes this record, in real time only: the driver of world for the uplink, that of
    cloud for the downlink. It does so at the start, after every change, and when a session or a
    mission begins. The values are those at the start of the profile's schedule.
    """

    stamp_ns: int
    uplink: Way
    shaper: Annotated[str, "", "relay or netem"]
    cause: Annotated[str, "", "why it changed; empty before the first change"]
    age: Annotated[float, "s", "time since these conditions took effect"]
    time_line: Annotated[float, "s", "time since the schedule (changes, blackouts, trace) began"]
    delay: Annotated[float, "s", "profile's delay at the start of the schedule, one way"]
    jitter: Annotated[float, "s", "profile's jitter at the start of the schedule"]
    loss: Annotated[float, "1", "profile's mean loss at the start of the schedule"]
    rate: Annotated[float, "bit/s", "profile's rate at the start of the schedule, or NaN"]
    conditions: Annotated[str, "", "the profile as JSON"]


class LinkChecked(NamedTuple):
    """Made by the driver, in real time only: verdict on a quantity of the link. Topic /link_check.

    Cloud judges the uplink, and world judges the downlink, from the datagrams of the last 60 s. The
    quantity is "mean", "deviation", "round_trip", "loss", "reordered" or "duplicated", or one that
    is not judged: "time_line", "radio", "rate", "correlation".

    The verdict is "ok", "off" or "open", or "told" for a quantity that is not judged. "open" means
    that there are too few datagrams, that the next check has to confirm "off", or that "off" may
    come from a process that woke late.
    """

    stamp_ns: int
    uplink: Way
    quantity: Annotated[str, "", "mean, deviation, round_trip, loss, ..."]
    asked: Annotated[float, "s or 1", "value expected from the profile: a delay or a share"]
    measured: Annotated[float, "s or 1", "measured value: a delay or a share"]
    low: Annotated[float, "s or 1", "lowest accepted value"]
    high: Annotated[float, "s or 1", "highest accepted value"]
    verdict: Annotated[str, "", "ok, off, or open (undecided); told: not judged"]
    datagrams: Annotated[int, "", "number of datagrams measured"]


REAL_TIME_FACTOR_MIN = 0.95
"""Lowest real-time factor of a valid run in real time.
Source: docs/verdict.md, "Real-time factor"."""


class TelemetrySent(NamedTuple):
    """Made by world: telemetry was sent. Topics /odometry and /telemetry."""

    stamp_ns: int
    epoch: Epoch
    counter: Number
    telemetry: Telemetry


class GroundTruth(NamedTuple):
    """Made by world: true state at each odometry sample. Topics /ground_truth and /reference."""

    stamp_ns: int
    odometry: Odometry  # true pose and twist
    reference: Annotated[Vector, "m/s", "after the guard's caps, world frame"]

    @property
    def position(self) -> Vector:
        """Position of the base [m], world frame."""
        return self.odometry.position

    @property
    def velocity(self) -> Vector:
        """Velocity of the base [m/s], world frame."""
        return self.odometry.velocity


class EnergyUsed(NamedTuple):
    """Made by world once a second and at each change of the guard's state. Topic /energy.

    Only a robot whose robot.yaml tells the thrust of its rotors has this record.
    """

    stamp_ns: int
    energy: Annotated[float, "J", "mechanical energy of all rotors since world began"]


class SensorLabel(NamedTuple):
    """What robot.yaml says of a sensor."""

    name: str
    unit: str


class ContactForce(NamedTuple):
    """Made by world at each odometry sample: true force on the probe. Topic /contact_force.

    Only a robot whose probe has a touch sensor has this record.
    """

    stamp_ns: int
    force: Annotated[float, "N", "on the robot's probe"]
    force_peak: Annotated[float, "N", "largest of all physics steps since the row before"]
    impulse: Annotated[float, "N s", "force times time since the row before"]
    sensor: SensorLabel | None = None  # of the sensor in robot.yaml that shows this force


class SensorRead(NamedTuple):
    """Made by world at each odometry sample: what one of the robot's own sensors shows.

    Topic /sensor. Telemetry carries these values to cloud. The sensor that shows the force on the
    probe has no such record: its rows of the topic come from `ContactForce`.
    """

    stamp_ns: int
    name: Annotated[str, "", "name of the sensor in robot.yaml"]
    unit: Annotated[str, "", "unit of the value, as robot.yaml says"]
    value: Annotated[float, "see unit", "what the sensor shows"]


class ScanTaken(NamedTuple):
    """Made by world: the robot's scanner has measured, and world has sent the scan. Topic /scan."""

    stamp_ns: int
    epoch: int  # those of its datagram; ROS's message has no place for them
    counter: int
    angle_min: Annotated[float, "rad", "of the first ray, rightmost; 0 is ahead"]
    angle_increment: Annotated[float, "rad", "between two rays"]
    scan_time: Annotated[float, "s", "between two scans"]
    range_max: Annotated[float, "m", "longest distance that the scanner sees"]
    ranges: Annotated[Numbers, "m", "of all rays, as measured; inf: nothing within range"]


class FrameSent(NamedTuple):
    """Made by world: a picture of the robot's camera was sent. Topic /frame.

    Its stamp is when its fragments were sent. In virtual time, rendering and encoding take no time.
    """

    stamp_ns: int
    epoch: Epoch
    number: Annotated[int, "", "of the picture in its session"]
    taken_ns: Annotated[int, "ns", "time at which it was taken, world's clock"]
    encode_ns: Annotated[int, "ns", "duration of rendering and encoding it"]
    counter: Annotated[int, "", "counter of its first datagram, one for each fragment"]
    pieces: Annotated[int, "", "number of its datagrams"]
    size: Annotated[int, "bytes", "of the encoded picture"]
    key: Annotated[bool, "", "true if it needs no picture before it"]
    psnr: Annotated[float, "dB", "peak signal-to-noise ratio of the decoded picture"]


class FrameShown(NamedTuple):
    """Made by cloud: a picture was there with all that it needs. Topic /frame_shown."""

    stamp_ns: int
    epoch: Epoch
    number: Annotated[int, "", "of the picture in its session"]
    taken_ns: Annotated[int, "ns", "time at which it was taken, world's clock"]
    wait_ns: Annotated[int, "ns", "from its last fragment's arrival until the stamp of the row"]


class FrameKept(NamedTuple):
    """Made by cloud: a picture as cloud has it, if the experiment keeps them. Topic /camera."""

    stamp_ns: int  # time at which it was taken [ns], world's clock
    format: Annotated[str, "", "jpeg as it arrived; png: decoded from H.264"]
    data: Annotated[bytes, "", "the file"]


class TargetSeen(NamedTuple):
    """Made by world at each sample of the true state: where the body is that the mission follows.

    Topics /target and /target_view. Angle and distance are true, too, and lead from the camera.
    """

    stamp_ns: int
    position: Annotated[Vector, "m", "of the moving body, world frame"]
    bearing: Annotated[float, "rad", "from the axis of the robot's camera, rising to the left"]
    distance: Annotated[float, "m", "from the robot's camera"]
    in_picture: Annotated[bool, "", "true if the body's origin is inside the camera's picture"]


class Arrival(NamedTuple):
    """Made by world or cloud: a datagram with a command or telemetry arrived, even if late.

    If a session has more repeated datagrams than the peer has sent, only an attacker can be the
    cause. Further repeats then get no record, so that they cannot fill the recording. Cloud writes
    the topic /uplink_delay, world the topic /downlink_delay.

    The echo is for live metrics; recordings have it in the telemetry that was sent.
    """

    stamp_ns: int
    uplink: bool  # True for telemetry at cloud, False for commands at world
    epoch: Epoch
    counter: Number
    delay: Annotated[float, "s", "one way; NaN unless the ends share a clock"]
    used: Annotated[bool, "", "true if it became the newest, false if late, repeated or refused"]
    echo_stamp_ns: int = NEVER_NS  # stamp of the newest applied command [ns], cloud's clock
    echo_hold_ns: int = 0  # time since this command was applied [ns]
    is_sample: bool = False  # whether the estimator got the echo as a delay sample


class CommandApplied(NamedTuple):
    """Made by world: a command was applied for the first time. Topic /command_applied.

    Epoch and counter identify the `Control` record of the command.
    """

    stamp_ns: int
    epoch: Epoch
    counter: Number
    basis_stamp_ns: Basis
    velocity: Annotated[Vector, "m/s", "before the guard's caps, world frame"]
    planned_ns: Annotated[
        int, "ns", "time at which the plan begins, world's clock; -1 without a plan"
    ] = NEVER_NS


class GuardChange(NamedTuple):
    """Made by world: the guard changed its state. Topic /guard."""

    stamp_ns: int
    state: Annotated[GuardState, "", STATES]
    cause: Annotated[str, "", "why, in words"]


class Contact(NamedTuple):
    """Made by world: the robot began to touch something. Topic /contact.

    Position and velocities are those just before the contact, in the world frame.
    """

    stamp_ns: int
    body: Annotated[str, "", "touched body of the scene, such as floor"]
    position: Annotated[Vector, "m", "of the base, world frame"]
    velocity: Annotated[Vector, "m/s", "of the base just before the contact, world frame"]
    touch_velocity: Annotated[
        Vector,
        "m/s",
        "of the probe (without one: of the base) just before the contact, world frame",
    ]
    by_probe: Annotated[bool, "", "true if the probe touched, or if the robot has no probe"]


class SessionOpened(NamedTuple):
    """Made by world or cloud: a session began, and `epoch` is its number. Topic /session."""

    stamp_ns: int
    end: End
    epoch: Epoch
    cause: Annotated[str, "", "why, in words"]


class Control(NamedTuple):
    """Made by cloud: one period of the control loop.

    Topics /estimated_odometry, /setpoint_position, /cmd_vel, /delay_estimate and /pid. Position,
    orientation and velocity are the prediction for the time `basis_stamp_ns + horizon`. The horizon
    is the estimated delay, clamped.
    """

    stamp_ns: int
    epoch: Epoch
    counter: Annotated[int, "", "counter in the datagram's header; -1: cloud sent none"]
    basis_stamp_ns: Basis
    horizon: Annotated[float, "s", "time by which the odometry was predicted ahead"]
    rtt: Annotated[float, "s", "last round trip without the time in world, or NaN"]
    loop_delay: Annotated[float, "s", "round trip with the time in world: the paper's tau_n"]
    measured: Annotated[Vector, "m", "position in the odometry used, world frame"]
    position: Annotated[Vector, "m", "of the base, world frame"]
    orientation_wxyz: Annotated[Quaternion, "1", "of the base, body to world"]
    velocity: Annotated[Vector, "m/s", "of the base, world frame"]
    setpoint: Annotated[Vector, "m", "position to fly to, world frame"]
    waypoint: Annotated[int, "", "index of the waypoint flown to; -1 if none"]
    command: Annotated[Vector, "m/s", "world frame"]
    yaw_rate: Annotated[float, "rad/s", "about the world's z axis"]
    proportional: Annotated[Vector, "m/s", "term per axis, world frame"]
    integral: Annotated[Vector, "m/s", "term per axis, world frame"]
    derivative: Annotated[Vector, "m/s", "term per axis, world frame"]


class Left(NamedTuple):
    """Made by cloud, if a computation takes simulated time: a command left. Topic /left."""

    stamp_ns: int
    epoch: Epoch
    counter: Number


class CellWait(NamedTuple):
    """Made by the driver, in virtual time: a datagram has left the radio cell. Topic /cell_wait."""

    stamp_ns: int
    uplink: Way
    epoch: Epoch
    counter: Number
    wait_ns: Annotated[int, "ns", "from its departure until the cell had sent all of it"]


class LinkWait(NamedTuple):
    """Made by the driver, in virtual time: where a datagram waits in the link. Topic /link_wait."""

    stamp_ns: int
    uplink: Way
    epoch: Epoch
    counter: Number
    queue_ns: Annotated[int, "ns", "wait at the bottleneck, with the time to send it there"]
    request_ns: Annotated[int, "ns", "wait for the radio's request slot"]
    grant_ns: Annotated[int, "ns", "from there to the end of its slot in the radio"]
    repeat_ns: Annotated[int, "ns", "of the radio's repetitions"]


class Perceived(NamedTuple):
    """Made by cloud: what became of a scan or picture that the perception saw. Topic /perception.

    Cloud makes the record with the first command from the perception's setpoint, or when nothing
    can follow any more. The durations lead back from the stamp to the arrival of what was seen.
    """

    stamp_ns: int
    seen_stamp_ns: Annotated[int, "ns", "stamp of the scan or picture, world's clock"]
    wait_ns: Annotated[int, "ns", "from its arrival until the perception began with it"]
    compute_ns: Annotated[int, "ns", "from there until the perception was done"]
    hold_ns: Annotated[int, "ns", "from there until the stamp of the row"]
    epoch: Epoch
    counter: Annotated[int, "", "counter of the first command from its setpoint; -1: none"]
    position: Annotated[Vector, "m", "of the setpoint, inside the fence; NaN: none"]


class PlanFollowed(NamedTuple):
    """Made by cloud: which position a plan had predicted for the newest odometry. Topic /plan.

    The plan is that of the command which the robot followed then: telemetry with this odometry
    echoes the command. Without plans, and after the end of a plan, there is no such record.
    """

    stamp_ns: int
    basis_stamp_ns: Annotated[int, "ns", "stamp of the odometry, world's clock"]
    position: Annotated[Vector, "m", "of the base at that instant, by the plan, world frame"]


ByHand: TypeAlias = Literal["goto", "driving", "operator_lost"]
"""Events of a held mission while the operator moves the setpoint; the mission stays held."""
UnderWay: TypeAlias = Literal["started", "reached", "held", "resumed", "paused", ByHand]
"""Events after which a mission continues; every other event ends it. After "paused", the process
that flies the mission ends and the next process continues the mission."""
MissionFailure: TypeAlias = Literal[
    "timed_out",
    "leg_timed_out",
    "world_restarted",
    "guard_stopped",
    "emergency_stopped",
    "onboard_failed",
    "taken_over",
    "end_lost",
]
"""Events that end a mission as a failure."""
MissionEnd: TypeAlias = Literal["done", "cancelled", MissionFailure]
"""Events that end a mission."""
MissionState: TypeAlias = Literal[
    "queued", "starting", "flying", "held", "done", "failed", "cancelled"
]
"""States of a mission."""
ControllerLost: TypeAlias = Literal["controller_silent", "controller_invalid"]
"""Codes of faults with which a flight ends, because a program outside that controls the robot does
not answer, or its answers are wrong."""
PlugInKind: TypeAlias = Literal["estimator", "predictor", "controller", "perception"]
"""Kinds of plug-ins in cloud."""
PlugInFailed: TypeAlias = Literal[
    "estimator_failed", "predictor_failed", "controller_failed", "perception_failed"
]
"""Codes of faults of plug-ins in cloud, in the order of their kinds."""
FaultCode: TypeAlias = Literal[
    PlugInFailed,
    "onboard_failed",
    ControllerLost,
    "controller_unstamped",
    "no_session",
    "busy",
    "version",
    "key",
    "late",
    "link",
    "recorder",
    "journal",
    "teleop_silent",
    "supervisor",
    "wall_clock",
]
"""Codes of faults."""
BY_HAND: tuple[ByHand, ...] = get_args(ByHand)
UNDER_WAY: tuple[UnderWay, ...] = get_args(UnderWay)
FAILURES: tuple[MissionFailure, ...] = get_args(MissionFailure)
CONTROLLER_LOST: tuple[ControllerLost, ...] = get_args(ControllerLost)
PLUG_IN_FAILED: dict[PlugInKind, PlugInFailed] = dict(
    zip(get_args(PlugInKind), get_args(PlugInFailed), strict=True)
)


class MissionEvent(NamedTuple):
    """Made by cloud: an event of the mission. Topic /mission.

    The last event is that of the end.
    """

    stamp_ns: int
    event: Annotated[
        Literal[UnderWay, MissionEnd],
        "",
        "started, reached, held, resumed, goto, driving, operator_lost; at the end the outcome: "
        f"done, cancelled, {', '.join(FAILURES)}",
    ]
    waypoint: Annotated[int, "", "index of the waypoint concerned; -1 if none"]
    text: Annotated[str, "", "the event in words"]


class Fault(NamedTuple):
    """Made by world or cloud: a problem that did not stop the flight. Topic /fault.

    The code "late" means that cloud missed periods, or that world is slower than real time.
    """

    stamp_ns: int
    code: Annotated[FaultCode, "", ", ".join(get_args(FaultCode))]
    text: Annotated[str, "", "what is wrong, where, what to do"]
    traceback: Annotated[str, "", "of a plug-in's first failure, else empty"] = ""


class Counted(NamedTuple):
    """Made by world or cloud: the value of a counter, once a second. Topic /count."""

    stamp_ns: int
    end: End
    name: Annotated[
        str,
        "",
        "what is counted, for example received, sent, malformed, late, stale, repeated, old_epoch,"
        " range, recorder_dropped",
    ]
    total: Annotated[int, "", "count since the start"]


class Lateness(NamedTuple):
    """Made by the driver, in real time only: how late it handled a deadline. Topic /lateness."""

    stamp_ns: int
    end: End
    lateness: Annotated[float, "s", "time from the deadline to its handling"]
    busy: Annotated[float, "s", "duration of the handling"]
    slip_ns: Slip


Record: TypeAlias = (
    (TelemetrySent | GroundTruth | ContactForce | SensorRead | Arrival | CommandApplied)
    | (EnergyUsed | Left | CellWait | LinkWait)
    | (GuardChange | Contact | SessionOpened | Control | PlanFollowed | MissionEvent)
    | (ScanTaken | Perceived | FrameSent | FrameShown | FrameKept | TargetSeen)
    | (Fault | Counted | LinkChanged | LinkChecked | Lateness)
)
