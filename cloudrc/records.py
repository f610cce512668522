"""The records of a run, which world, cloud and the drivers make during a flight.

A record is a named tuple. `stamp_ns` is the time at which the record was made [ns], on the clock of
world or cloud, whichever made it. `epoch` and `counter` identify a datagram, as in its header. Each
docstring begins with the maker: world, cloud, or the driver, which runs one of them.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from cloudrc.messages import NEVER_NS, GuardState, Odometry, Quaternion, Telemetry, Vector


class LinkChanged(NamedTuple):
    """The requested conditions of one direction of the link. Topic /link.

    The driver makes this record, in real time only: the driver of world for the uplink, that of
    cloud for the downlink. It does so at the start, after every change, and when a session or a
    mission begins. The values are those at the start of the profile's time line.
    """

    stamp_ns: int
    uplink: bool  # True for the uplink, False for the downlink
    shaper: str  # "relay" or "netem"
    cause: str  # why the conditions changed, in words; "" at the start
    age: float  # time since these conditions took effect [s]
    time_line: float  # time since the time line began [s]
    delay: float  # requested one-way delay [s]
    jitter: float  # requested jitter, as in the profile [s]
    loss: float  # requested long-run loss, in [0, 1]
    rate: float  # requested rate [bit/s]; NaN without a bottleneck
    conditions: str  # all requested values as JSON, with the keys of a profile's file


class LinkChecked(NamedTuple):
    """Made by the driver, in real time only: verdict on a quantity of the link. Topic /link_check.

    Cloud judges the uplink, and world judges the downlink, from the datagrams of the last 60 s. The
    quantity is "mean", "deviation", "round_trip", "loss", "reordered" or "duplicated", or one that
    is not judged: "time_line", "rate", "correlation".

    The verdict is "ok", "off" or "open", or "told" for a quantity that is not judged. "open" means
    that there are too few datagrams, that the next check has to confirm "off", or that "off" may
    come from a process that woke late.
    """

    stamp_ns: int
    uplink: bool  # True for the uplink, False for the downlink
    quantity: str
    asked: float  # value expected from the profile: a delay [s] or a share in [0, 1]
    measured: float  # measured value [s] or [1], as `asked`
    low: float  # lowest accepted value [s] or [1]
    high: float  # highest accepted value [s] or [1]
    verdict: str
    datagrams: int  # number of datagrams behind the measurement


REAL_TIME_FACTOR_MIN = 0.95
"""Lowest real-time factor of a valid run in real time.
Source: docs/reference/control.md, "Real-time factor"."""


class TelemetrySent(NamedTuple):
    """Made by world: telemetry was sent. Topics /odometry and /telemetry."""

    stamp_ns: int
    epoch: int
    counter: int
    telemetry: Telemetry


class GroundTruth(NamedTuple):
    """Made by world: true state at each odometry sample. Topics /ground_truth and /reference."""

    stamp_ns: int
    odometry: Odometry  # true pose and twist
    tip_force: float  # force on the touch sensor [N]
    tip_force_peak: float  # largest force of all physics steps since the previous record [N]
    tip_impulse: float  # integral of the force over time since the previous record [N s]
    reference: Vector  # velocity that the guard gives to the low-level controller [m/s]


class Arrival(NamedTuple):
    """Made by world or cloud: a datagram with a command or telemetry arrived, even if late.

    If a session has more repeated datagrams than the peer has sent, only an attacker can be the
    cause. Further repeats then get no record, so that they cannot fill the recording. Cloud writes
    the topic /uplink_delay, world the topic /downlink_delay.
    """

    stamp_ns: int
    uplink: bool  # True for telemetry at cloud, False for commands at world
    epoch: int
    counter: int
    delay: float  # one-way delay [s]; NaN unless world and cloud can prove that they share a clock
    used: bool  # True if the content was used; False if late, stale, repeated or rejected


class CommandApplied(NamedTuple):
    """Made by world: a command was applied for the first time. Topic /command_applied.

    Epoch and counter identify the `Control` record of the command.
    """

    stamp_ns: int
    epoch: int
    counter: int
    basis_stamp_ns: int  # stamp of the odometry that the command is based on [ns], world's clock
    velocity: Vector  # commanded velocity before the guard limits it [m/s]
    planned_ns: int = NEVER_NS  # start of the command's plan [ns], world's clock


class GuardChange(NamedTuple):
    """Made by world: the guard changed its state. Topic /guard."""

    stamp_ns: int
    state: GuardState  # the new state
    cause: str  # why it changed, such as "command age 0.252 s above 0.250 s"


class Contact(NamedTuple):
    """Made by world: the robot began to touch something. Topic /contact.

    Position and velocities are those just before the contact, in the world frame.
    """

    stamp_ns: int
    body: str  # touched body of the scene, such as pipe_1, board, floor
    position: Vector  # of the base [m]
    velocity: Vector  # of the base [m/s]
    tip_velocity: Vector  # of the arm's tip [m/s]
    tip: bool  # True if the arm's tip touched the body, False if another part of the robot did


class SessionOpened(NamedTuple):
    """Made by world or cloud: a session began, and `epoch` is its number. Topic /session."""

    stamp_ns: int
    end: str  # "world" or "cloud"
    epoch: int  # the new epoch
    cause: str  # why the session began: "cloud said hello", "mission starts from spawn"


class Control(NamedTuple):
    """Made by cloud: one period of the control loop.

    Topics /estimated_odometry, /setpoint_position, /cmd_vel, /delay_estimate and /pid. Vectors are
    in the world frame; the terms of the controller are per axis.
    """

    stamp_ns: int
    epoch: int
    counter: int
    basis_stamp_ns: int  # stamp of the odometry used [ns], world's clock
    horizon: float  # prediction horizon [s]: the estimated delay, clamped
    rtt: float  # round trip without the time that world held the command [s]; NaN before the first
    loop_delay: float  # whole round trip, the paper's tau_n [s]; NaN before the first
    measured: Vector  # position in the odometry used [m]
    position: Vector  # predicted position for `basis_stamp_ns + horizon` [m]
    orientation_wxyz: Quaternion  # predicted orientation, unit quaternion
    velocity: Vector  # predicted velocity [m/s]
    setpoint: Vector  # position of the setpoint [m]
    waypoint: int  # index of the current waypoint; -1 if none
    command: Vector  # commanded velocity [m/s]
    yaw_rate: float  # commanded yaw rate [rad/s]
    proportional: Vector  # proportional term [m/s]
    integral: Vector  # integral term [m/s]
    derivative: Vector  # derivative term [m/s]


BY_HAND = ("goto", "driving", "operator_lost")
"""Events of a held mission while the operator moves the setpoint; the mission stays held."""
UNDER_WAY = ("started", "reached", "held", "resumed", "paused", *BY_HAND)
"""Events after which a mission continues; every other event ends it. After "paused", the process
that flies the mission ends and the next process continues the mission."""
FAILURES = (
    *("timed_out", "leg_timed_out", "world_restarted", "guard_stopped", "emergency_stopped"),
    *("taken_over", "end_lost"),
)
"""Events that end a mission as a failure."""


class MissionEvent(NamedTuple):
    """Made by cloud: an event of the mission. Topic /mission.

    During the mission, `event` is one of `UNDER_WAY`. At the end of the mission, `event` is "done",
    "cancelled" or one of `FAILURES`.
    """

    stamp_ns: int
    event: str
    waypoint: int  # index of the waypoint that the event is about; -1 if none
    text: str  # the event in words


class Fault(NamedTuple):
    """Made by world or cloud: a problem that did not stop the flight. Topic /fault.

    The code is one word, such as "predictor_failed", "recorder", "link_check", or "late" (cloud
    missed periods, or world is slower than real time).
    """

    stamp_ns: int
    code: str
    text: str  # what is wrong, where, and what to do
    traceback: str = ""  # of a plug-in's first failure; "" for another fault


class Counted(NamedTuple):
    """Made by world or cloud: the value of a counter, once a second. Topic /count."""

    stamp_ns: int
    end: str  # "world", "cloud" or "link"
    name: str  # such as "sent", "malformed", "late", "stale", "range"
    total: int  # value since the start


class Lateness(NamedTuple):
    """Made by the driver, in real time only: how late it handled a deadline. Topic /lateness."""

    stamp_ns: int
    end: str  # "world" or "cloud"
    lateness: float  # time from the deadline to the start of its handling [s]
    busy: float  # duration of the handling [s]
    slip_ns: int  # lag of world's clock behind its machine's clock [ns]; 0 for cloud


Record: TypeAlias = (
    (TelemetrySent | GroundTruth | Arrival | CommandApplied | GuardChange | Contact)
    | (SessionOpened | Control | MissionEvent | Fault | Counted)
    | (LinkChanged | LinkChecked | Lateness)
)
