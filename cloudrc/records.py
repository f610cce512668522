"""The records of a run, which world, cloud and the drivers make during a flight.

A record is a named tuple. `stamp_ns` is the time at which the record was made [ns], on the clock of
world or cloud, whichever made it. `epoch` and `counter` identify a datagram, as in its header. Each
docstring begins with the maker: world, cloud, or the driver, which runs one of them. `record/`
converts records to MCAP topics, columns and a hash; `metrics/` computes numbers.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from cloudrc.messages import NEVER_NS, GuardState, Odometry, Quaternion, Telemetry, Vector


class LinkChanged(NamedTuple):
    """Driver, in real time only: requested conditions of one link direction. Topic /link.

    World records the uplink, and cloud records the downlink: at the start, after every change, and
    when a session or a mission begins. The values are those at the start of the time line.

    Attributes:
        uplink: True for the uplink, False for the downlink.
        shaper: "relay" or "netem".
        cause: Why the conditions changed, in words; "" at the start.
        age: Time since these conditions took effect [s].
        time_line: Time since the time line began [s]; NaN if the change did not restart it.
        delay: Requested one-way delay [s].
        jitter: Requested jitter, as in the profile [s].
        loss: Requested long-run loss, in [0, 1].
        rate: Requested rate [bit/s]; NaN without a bottleneck.
        conditions: All requested values as JSON, with the keys of a profile's file.
    """

    stamp_ns: int
    uplink: bool
    shaper: str
    cause: str
    age: float
    time_line: float
    delay: float
    jitter: float
    loss: float
    rate: float
    conditions: str


class LinkChecked(NamedTuple):
    """Driver, in real time only: verdict on one quantity of the link. Topic /link_check.

    Cloud judges the uplink, and world judges the downlink, from the datagrams of the last 60 s.

    Attributes:
        uplink: True for the uplink, False for the downlink.
        quantity: One of "mean", "deviation", "round_trip", "loss", "reordered", "duplicated"; or a
            quantity that is not judged: "time_line", "rate", "correlation".
        asked: Expected value: delays [s], shares in [0, 1].
        measured: Measured value, likewise.
        low: Lowest accepted value, likewise.
        high: Highest accepted value, likewise.
        verdict: "ok"; "off"; "told" (not judged); or "open": datagrams are too few, the next check
            must confirm "off", or late wakes of world and cloud may have caused "off".
        datagrams: Number of datagrams behind the measurement.
    """

    stamp_ns: int
    uplink: bool
    quantity: str
    asked: float
    measured: float
    low: float
    high: float
    verdict: str
    datagrams: int


REAL_TIME_FACTOR_MIN = 0.95
"""Lowest real-time factor of a valid run in real time.
Source: docs/reference/control.md, "Real-time factor"."""


class TelemetrySent(NamedTuple):
    """World: telemetry was sent. Topics /odometry and /telemetry."""

    stamp_ns: int
    epoch: int
    counter: int
    telemetry: Telemetry


class GroundTruth(NamedTuple):
    """World: the true state, once per odometry. Topics /ground_truth and /reference.

    Attributes:
        odometry: True pose and twist.
        tip_force: Force on the touch sensor [N].
        tip_force_peak: Largest force since the previous record, of every physics step [N].
        tip_impulse: Integral of the force over time since the previous record [N s].
        reference: Velocity that the guard gives to the low-level controller [m/s], shape (3,).
    """

    stamp_ns: int
    odometry: Odometry
    tip_force: float
    tip_force_peak: float
    tip_impulse: float
    reference: Vector


class Arrival(NamedTuple):
    """World or cloud: a datagram with a command or telemetry arrived, even if late.

    If an attacker repeats more datagrams in a session than the peer has sent, further repetitions
    get no record, so that they cannot fill the recording. Topics /uplink_delay (made by cloud) and
    /downlink_delay (made by world).

    Attributes:
        uplink: True for telemetry at cloud, False for commands at world.
        delay: One-way delay [s]; NaN if world and cloud cannot prove that they share a clock.
        used: True if the content was used; False if late, stale, repeated or rejected.
    """

    stamp_ns: int
    uplink: bool
    epoch: int
    counter: int
    delay: float
    used: bool


class CommandApplied(NamedTuple):
    """World: a command was applied for the first time. Topic /command_applied.

    Epoch and counter identify the `Control` record of the command.

    Attributes:
        basis_stamp_ns: Stamp of the odometry that the command is based on [ns], world's clock.
        velocity: Commanded velocity before the guard limits it [m/s], shape (3,).
        planned_ns: Time for which the command was computed [ns], world's clock, if it has a plan;
            else `NEVER_NS`.
    """

    stamp_ns: int
    epoch: int
    counter: int
    basis_stamp_ns: int
    velocity: Vector
    planned_ns: int = NEVER_NS


class GuardChange(NamedTuple):
    """World: the guard changed its state. Topic /guard.

    Attributes:
        state: The new state.
        cause: Why the state changed, such as "command age 0.252 s above 0.250 s".
    """

    stamp_ns: int
    state: GuardState
    cause: str


class Contact(NamedTuple):
    """World: the robot began to touch something. Topic /contact.

    Attributes:
        body: Name of the touched body of the scene, such as pipe_1, board, floor.
        position: Position of the base just before the contact [m], world frame, shape (3,).
        velocity: Velocity of the base just before the contact [m/s], world frame, shape (3,).
        tip_velocity: Velocity of the tip just before the contact [m/s], world frame, shape (3,).
        tip: True if the arm's tip touched the body, False if another part of the robot did.
    """

    stamp_ns: int
    body: str
    position: Vector
    velocity: Vector
    tip_velocity: Vector
    tip: bool


class SessionOpened(NamedTuple):
    """World or cloud: a session began; a new epoch numbers it. Topic /session.

    Attributes:
        end: "world" or "cloud".
        epoch: The new epoch.
        cause: Why the session began: "cloud said hello", "mission starts from spawn".
    """

    stamp_ns: int
    end: str
    epoch: int
    cause: str


class Control(NamedTuple):
    """Cloud: one period of the control loop.

    Topics /estimated_odometry, /setpoint_position, /cmd_vel, /delay_estimate and /pid.

    Attributes:
        basis_stamp_ns: Stamp of the odometry used [ns], world's clock.
        horizon: Prediction horizon [s]: the estimated delay, clamped.
        rtt: Round trip without the time that world held the command [s]; NaN if there was none yet.
        loop_delay: Round trip with this time, the paper's tau_n [s]; NaN if there was none yet.
        measured: Position in the odometry used [m], shape (3,).
        position: Predicted position for `basis_stamp_ns + horizon` [m], shape (3,).
        orientation_wxyz: Predicted orientation, unit quaternion, shape (4,).
        velocity: Predicted velocity [m/s], shape (3,).
        setpoint: Position of the setpoint [m], shape (3,).
        waypoint: Index of the current waypoint; -1 if none.
        command: Commanded velocity [m/s], shape (3,).
        yaw_rate: Commanded yaw rate [rad/s].
        proportional: Proportional term of the controller per axis [m/s], shape (3,).
        integral: Integral term [m/s], shape (3,).
        derivative: Derivative term [m/s], shape (3,).
    """

    stamp_ns: int
    epoch: int
    counter: int
    basis_stamp_ns: int
    horizon: float
    rtt: float
    loop_delay: float
    measured: Vector
    position: Vector
    orientation_wxyz: Quaternion
    velocity: Vector
    setpoint: Vector
    waypoint: int
    command: Vector
    yaw_rate: float
    proportional: Vector
    integral: Vector
    derivative: Vector


BY_HAND = ("goto", "driving", "operator_lost")
"""Events of a held mission whose setpoint the operator moves; the mission stays held."""
UNDER_WAY = ("started", "reached", "held", "resumed", "paused", *BY_HAND)
"""Events after which a mission continues; every other event ends it. After "paused", the process
that flies the mission ends and the next process continues the mission."""


FAILURES = (
    *("timed_out", "leg_timed_out", "world_restarted", "guard_stopped", "emergency_stopped"),
    *("taken_over", "end_lost"),
)
"""Events that end a mission as a failure."""


class MissionEvent(NamedTuple):
    """Cloud: an event of the mission. Topic /mission.

    Attributes:
        event: A word of the list `UNDER_WAY`; at the end of the mission "done", "cancelled" or a
            word of the list `FAILURES`.
        waypoint: Index of the waypoint that the event is about; -1 if none.
        text: The event in words.
    """

    stamp_ns: int
    event: str
    waypoint: int
    text: str


class Fault(NamedTuple):
    """World or cloud: a problem that did not stop the flight. Topic /fault.

    Attributes:
        code: One word, such as "predictor_failed", "recorder", "link_check", or "late" (cloud
            missed periods, or world is slower than real time).
        text: What is wrong, where, and what to do.
        traceback: The traceback of a plug-in's first failure; "" for another fault.
    """

    stamp_ns: int
    code: str
    text: str
    traceback: str = ""


class Counted(NamedTuple):
    """World or cloud: the value of a counter, once a second. Topic /count.

    Attributes:
        end: "world", "cloud" or "link".
        name: Name of the counter, such as "sent", "malformed", "late", "stale", "range".
        total: Value since the start.
    """

    stamp_ns: int
    end: str
    name: str
    total: int


class Lateness(NamedTuple):
    """Driver, in real time only: how late a deadline was handled. Topic /lateness.

    Attributes:
        end: "world" or "cloud".
        lateness: Time from the deadline to the start of its handling [s].
        busy: Duration of the handling [s].
        slip_ns: Lag of world's clock behind its machine's clock [ns]; 0 for cloud.
    """

    stamp_ns: int
    end: str
    lateness: float
    busy: float
    slip_ns: int


Record: TypeAlias = (
    (TelemetrySent | GroundTruth | Arrival | CommandApplied | GuardChange | Contact)
    | (SessionOpened | Control | MissionEvent | Fault | Counted)
    | (LinkChanged | LinkChecked | Lateness)
)
