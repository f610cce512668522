"""The records of a run: what world, cloud and the drivers note down while they fly.

Every record is a named tuple whose first field is `stamp_ns`, on the clock of the end that
made it. `record/` turns them into MCAP topics, columns and a hash; `metrics/` turns them into
numbers. The loop only makes them and hands them over.

The records of the link itself: that it was changed, and what its standing check finds out.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from cloudrc.messages import GuardState, Odometry, Quaternion, Telemetry, Vector


class LinkChanged(NamedTuple):
    """Driver, in real time only: what shapes what this end sends is new. Topic /link.

    World tells of the uplink, cloud of the downlink. Noted when the link is first seen, when it
    has changed, and again when a session or a mission begins.

    Attributes:
        stamp_ns: When this end noted it [ns], own clock.
        uplink: True for the uplink, False for the downlink.
        shaper: "relay" or "netem".
        cause: Why it changed, in words; "" if it is as it came up.
        age: How long it had been in force by then [s].
        time_line: How long its time line had been running by then [s]; NaN: as the one before.
        delay: Asked for, one way [s]; this and the following at the beginning of the time line.
        jitter: Asked for, as in the profile [s].
        loss: Asked for, in the long run, in [0, 1].
        rate: Asked for [bit/s]; NaN without a bottleneck.
        conditions: All that is asked for, as in a profile's file, as JSON.
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
    """Driver, in real time only: one number of the link, judged in flight. Topic /link_check.

    Cloud judges the uplink, world the downlink, by the tunnel's own datagrams of up to 250 s.

    Attributes:
        stamp_ns: [ns], own clock.
        uplink: True for the uplink, False for the downlink.
        quantity: "mean", "deviation", "variation", "middle", "round_trip", "loss", "reordered" or
            "duplicated". And what is only told: "datagrams" (needed, there), "time_line" (share
            of it that was watched and as asked), "rate" (not measured by datagrams that come
            alone), "jitter_share" (usual, and by which share the jitter may be off here),
            "correlation" (asked of netem, which realises none), and "mean_takes" and the like (so
            many datagrams as there never are would decide it).
        asked: What a true link shows: delays [s], shares in [0, 1].
        measured: Likewise.
        low: Least that is believed, likewise.
        high: Most that is believed, likewise.
        verdict: "ok", "off", or "open" where there were too few datagrams to say, or the ends
            woke so late that the link cannot be told from them; "told" judges nothing.
        datagrams: That this rests on.
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
"""Below it a run that was to be in real time is invalid [1].
Source: docs/reference/control.md, "Real-time factor"."""


class TelemetrySent(NamedTuple):
    """World: telemetry left. Topics /odometry and /telemetry.

    Attributes:
        stamp_ns: [ns], world's clock.
        epoch: Session it belongs to.
        counter: Its counter in the header.
        telemetry: As sent.
    """

    stamp_ns: int
    epoch: int
    counter: int
    telemetry: Telemetry


class GroundTruth(NamedTuple):
    """World: the true state, at every odometry. Topics /ground_truth and /reference.

    Attributes:
        stamp_ns: [ns], world's clock.
        odometry: True pose and twist.
        tip_force: Force on the touch sensor [N].
        reference: Velocity that the guard lets the low-level controller follow [m/s], shape (3,).
    """

    stamp_ns: int
    odometry: Odometry
    tip_force: float
    reference: Vector


class Arrival(NamedTuple):
    """Either end: a telemetry or command datagram arrived, late ones included.

    Those that were repeated are noted up to as many as were sent; of more only the count is.
    Topics /uplink_delay (made by cloud) and /downlink_delay (made by world).

    Attributes:
        stamp_ns: When it arrived [ns], receiver's clock.
        uplink: True for telemetry at cloud, False for commands at world.
        epoch: From its header.
        counter: From its header.
        delay: One way [s]; NaN if the two ends cannot prove that they share a clock.
        used: True if it became the newest, False if it was late, stale, repeated or refused.
    """

    stamp_ns: int
    uplink: bool
    epoch: int
    counter: int
    delay: float
    used: bool


class CommandApplied(NamedTuple):
    """World: a command was applied for the first time. Topic /command_applied.

    Attributes:
        stamp_ns: When the low-level controller first saw it [ns], world's clock.
        epoch: From its header.
        counter: From its header; with the epoch it names the `Control` record it came from.
        basis_stamp_ns: Stamp of the odometry that it was computed from [ns], world's clock.
        velocity: As commanded, before the caps [m/s], shape (3,).
    """

    stamp_ns: int
    epoch: int
    counter: int
    basis_stamp_ns: int
    velocity: Vector


class GuardChange(NamedTuple):
    """World: the guard changed its state. Topic /guard.

    Attributes:
        stamp_ns: [ns], world's clock.
        state: The new state.
        cause: Why, in words: "mission started", "command age 0.252 s above 0.250 s".
    """

    stamp_ns: int
    state: GuardState
    cause: str


class Contact(NamedTuple):
    """World: the robot began to touch something. Topic /contact.

    Attributes:
        stamp_ns: [ns], world's clock.
        body: Name of the scene's body: pipe_1, board, floor.
        position: Of the base [m], shape (3,).
        velocity: Of the base just before [m/s], shape (3,).
        tip_velocity: Of the arm's tip just before [m/s], shape (3,).
        tip: True if the arm's tip touched, False for any other part.
    """

    stamp_ns: int
    body: str
    position: Vector
    velocity: Vector
    tip_velocity: Vector
    tip: bool


class SessionOpened(NamedTuple):
    """Either end: a session began under a new epoch. Topic /session.

    Attributes:
        stamp_ns: [ns], own clock.
        end: "world" or "cloud".
        epoch: Its number.
        cause: Why, in words: "cloud said hello", "mission starts from spawn".
    """

    stamp_ns: int
    end: str
    epoch: int
    cause: str


class Control(NamedTuple):
    """Cloud: one period of the control loop.

    Topics /estimated_odometry, /setpoint_position, /cmd_vel, /delay_estimate and /pid.

    Attributes:
        stamp_ns: [ns], cloud's clock: that of the command.
        epoch: Session of the command.
        counter: Of the command, in its header.
        basis_stamp_ns: Stamp of the odometry used [ns], world's clock.
        horizon: By how much it was moved ahead [s]: the delay estimate, clamped.
        rtt: Last round trip, hold excluded [s]; NaN before the first echo.
        loop_delay: Last `now - echo_stamp`, hold included: the paper's tau_n [s]; NaN likewise.
        measured: Position in the odometry used [m], shape (3,).
        position: Predicted [m], shape (3,), for `basis_stamp_ns + horizon`.
        orientation_wxyz: Predicted, unit quaternion, shape (4,).
        velocity: Predicted [m/s], shape (3,).
        setpoint: [m], shape (3,).
        waypoint: Index of the waypoint flown to; -1 if none.
        command: Velocity commanded [m/s], shape (3,).
        yaw_rate: Commanded [rad/s].
        proportional: Term of the controller per axis [m/s], shape (3,).
        integral: Likewise.
        derivative: Likewise.
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


class MissionEvent(NamedTuple):
    """Cloud: the mission moved on. Topic /mission.

    Attributes:
        stamp_ns: [ns], cloud's clock.
        event: "started", "reached", "held", "resumed", "goto"; at the end its outcome: "done",
            "cancelled", "timed_out", "leg_timed_out", "world_restarted", "guard_stopped",
            "emergency_stopped", "taken_over", "end_lost".
        waypoint: Index of the waypoint concerned; -1 if none.
        text: The same in words.
    """

    stamp_ns: int
    event: str
    waypoint: int
    text: str


class Fault(NamedTuple):
    """Either end: something went wrong that did not stop the flight. Topic /fault.

    Attributes:
        stamp_ns: [ns], own clock.
        code: One word: "estimator_failed", "predictor_failed", "controller_failed", "recorder",
            "link_check", "wall_clock", "late": cloud in its periods, world behind real time.
        text: What, where, what to do.
    """

    stamp_ns: int
    code: str
    text: str


class Counted(NamedTuple):
    """Either end: how often something has happened so far; once a second. Topic /count.

    Attributes:
        stamp_ns: [ns], own clock.
        end: "world", "cloud" or "link".
        name: "received", "sent", "malformed", "late", "stale", "repeated", "old_epoch",
            "range", "recorder_dropped"...
        total: Since the start.
    """

    stamp_ns: int
    end: str
    name: str
    total: int


class Lateness(NamedTuple):
    """Driver, in real time only: how late a wake was. Topic /lateness.

    Attributes:
        stamp_ns: [ns], own clock, when the deadline was handled.
        end: "world" or "cloud".
        lateness: Now minus the deadline [s].
        busy: How long handling it took [s].
        slip_ns: World's clock behind the machine's [ns]; 0 for cloud.
    """

    stamp_ns: int
    end: str
    lateness: float
    busy: float
    slip_ns: int


Record: TypeAlias = (
    TelemetrySent
    | GroundTruth
    | Arrival
    | CommandApplied
    | GuardChange
    | Contact
    | SessionOpened
    | Control
    | MissionEvent
    | Fault
    | Counted
    | LinkChanged
    | LinkChecked
    | Lateness
)
