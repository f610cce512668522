"""Compute the current metrics of one process from its records.

The errors of predictions and of delay estimates are correct even if world and cloud do not share a
clock: they are computed from differences between stamps of one clock.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from itertools import product
from math import nan
from typing import Any, get_args

from cloudrc.exposition import table
from cloudrc.exposition.parts import (
    DatagramTally,
    DelayJudge,
    Histogram,
    PredictionJudge,
    Readings,
    by_label,
    per_axis,
    unlabelled,
)
from cloudrc.exposition.table import Kind, Labels, Metric, of_role
from cloudrc.messages import NEVER_NS, Cause, GuardState
from cloudrc.records import (
    BY_HAND,
    UNDER_WAY,
    Arrival,
    CommandApplied,
    Contact,
    Control,
    Counted,
    Fault,
    GroundTruth,
    GuardChange,
    Lateness,
    LinkChecked,
    MissionEvent,
    Record,
    SessionOpened,
    TelemetrySent,
)

ONE_SHAPER = ("cloudrc_link_restored_total", "cloudrc_link_released_early_total")
"""Metrics that only relay or only netem has; without a count they are left out."""


class LinkVerdict:
    """Newest verdict on whether the link's direction to this process matches its profile."""

    def __init__(self, direction: str) -> None:
        """Set the direction, "uplink" or "downlink"; before a check the verdict is "open"."""
        self._direction = direction
        self._newest: tuple[LinkChecked, ...] = ()

    def _on_linkchecked(self, record: LinkChecked) -> None:
        """Store the verdict on one quantity, and drop verdicts of earlier checks."""
        newest = [one for one in self._newest if one.stamp_ns == record.stamp_ns]
        self._newest = (*newest, record)  # a new tuple: another thread may read the old one

    @property
    def verdict(self) -> str:
        """Verdict on the link: "ok", "off" (not as in its profile), "open" (not decided yet)."""
        verdicts = {record.verdict for record in self._newest} - {"told"}
        return "off" if "off" in verdicts else "ok" if verdicts == {"ok"} else "open"

    def text(self) -> str:
        """Return the content of /link.json: the verdict on the link, and a row per quantity."""
        rows = [record._asdict() for record in self._newest]
        for row in rows:  # fields that are equal in all rows
            del row["stamp_ns"], row["uplink"]
        known = [{key: value for key, value in row.items() if value == value} for row in rows]
        document = {"direction": self._direction, "verdict": self.verdict, "rows": known}
        return json.dumps(document, indent=2) + "\n"

    def read(self) -> Readings:
        """Return the current metrics, without metrics whose values are unknown."""
        if self.verdict == "open":
            return {}
        return {"cloudrc_link_believed": {(self._direction,): float(self.verdict == "ok")}}


CLOCK_SET = "wall_clock"
"""Fault code for a step of the wall clock."""
SILENCE_NS = 2_000_000_000
"""Time without a new datagram from the peer after which the peer counts as disconnected [ns]."""


class End:
    """Metrics that both world and cloud have: session, datagrams, one-way delay, loop timing."""

    def __init__(self, role: str, counts: Mapping[str, int]) -> None:
        """Make the metrics of `role`, "world" or "cloud"; `counts` maps counter names to values."""
        self._counts, self._stream = counts, DatagramTally()
        self._outgoing, self._incoming, others = "uplink", "downlink", table.ONLY_CLOUD
        if role == table.CLOUD:
            self._outgoing, self._incoming, others = "downlink", "uplink", table.ONLY_WORLD
        self._outcomes = tuple(name for name in table.OUTCOMES[1:] if name not in others)
        self.check = LinkVerdict(self._incoming)
        self._histograms = {
            metric.name: Histogram(metric.buckets) for metric in of_role(role) if metric.buckets
        }
        self._busy, self._clock_steps = 0.0, 0
        self._sessions, self._epoch, self._opened_ns = 0, 0, NEVER_NS
        self._arrival_ns = self._woke_ns = self._deadline_ns = NEVER_NS
        self._silent = True  # whether no telemetry or command has arrived in this session
        # Arrival [ns] and one-way delay [s] of the newest used datagram.
        self._newest_ns, self._newest_delay = NEVER_NS, nan

    @property
    def has_peer(self) -> bool:
        """Whether a session began or a new datagram of the peer arrived in the last 2 s."""
        return self._opened_ns != NEVER_NS and self._woke_ns - self._arrival_ns < SILENCE_NS

    def _observe(self, name: str, seconds: float) -> None:
        self._histograms[f"cloudrc_{name}_seconds"].observe(seconds)

    def _on_arrival(self, record: Arrival) -> None:
        stamp_ns, _, epoch, counter, delay, used = record
        if self._stream.take(epoch, counter):  # not a replay, which anybody can send
            if not self._silent:
                self._observe("link_gap", (stamp_ns - self._arrival_ns) * 1e-9)
            self._arrival_ns, self._silent = stamp_ns, False
        if delay == delay:  # not NaN: both ends share a clock
            self._observe(f"{self._incoming}_delay", delay)
        if used:
            self._newest_ns, self._newest_delay = stamp_ns, delay

    def _on_fault(self, record: Fault) -> None:
        self._clock_steps += record.code == CLOCK_SET

    def _on_sessionopened(self, record: SessionOpened) -> None:
        self._sessions += 1
        self._epoch = record.epoch
        self._opened_ns = self._arrival_ns = record.stamp_ns
        self._silent, self._newest_delay = True, nan

    def _on_lateness(self, record: Lateness) -> None:
        stamp_ns, _, lateness, busy, slip_ns = record
        now_ns = stamp_ns + slip_ns
        if self._deadline_ns != NEVER_NS:
            self._observe("loop_period", (now_ns - self._deadline_ns) * 1e-9)
        self._deadline_ns, self._woke_ns = now_ns, stamp_ns
        self._observe("loop_lateness", lateness)
        self._busy += busy

    def _count_age(self, now_ns: int) -> None:
        """Store the age of the newest datagram at `now_ns` [ns], this process's clock."""
        delay = self._newest_delay
        if delay == delay:
            self._observe("age_of_information", delay + (now_ns - self._newest_ns) * 1e-9)

    def read(self) -> Readings:
        """Return the current metrics, without metrics whose values are unknown."""
        counts, stream, incoming = self._counts, self._stream, self._incoming
        datagrams: dict[Labels, float] = {
            (incoming, name): counts.get(name, 0) for name in self._outcomes
        }
        datagrams[self._outgoing, "sent"] = counts.get("sent", 0)
        readings: Readings = {
            **self._histograms,
            "cloudrc_session_epoch": unlabelled(self._epoch),
            "cloudrc_sessions_opened_total": unlabelled(self._sessions),
            "cloudrc_datagrams_total": datagrams,
            "cloudrc_datagrams_expected_total": {(incoming,): stream.expected},
            "cloudrc_datagrams_lost_total": {(incoming,): stream.lost},
            "cloudrc_datagrams_reordered_total": {(incoming,): stream.reordered},
            "cloudrc_loop_busy_seconds_total": unlabelled(self._busy),
            "cloudrc_clock_steps_total": unlabelled(self._clock_steps),
        }
        one_way = f"cloudrc_{incoming}_delay_seconds"
        if not self._histograms[one_way].cumulative()[-1]:  # no shared clock: leave out delays
            del readings[one_way], readings["cloudrc_age_of_information_seconds"]
        return readings


STEP_NS, STEPS = 1_000_000_000, 10
"""The real-time factor is an average over `STEPS` intervals of `STEP_NS` [ns]."""
ADMITTED = "cloud said hello"
"""Text of `SessionOpened.cause` if a session begins because a cloud process has connected."""


class WorldEnd(End):
    """Metrics of world: all of `End`, and those of robot, guard, contacts and real-time factor."""

    def __init__(self, counts: Mapping[str, int]) -> None:
        super().__init__(table.WORLD, counts)
        self._truth: GroundTruth | None = None
        self._guard = GuardState.GROUND
        self._changes = dict.fromkeys(table.GUARD_STATES, 0)
        self._reason = GuardState.GROUND, Cause.SPAWN
        self._causes = dict.fromkeys(table.GUARD_CAUSES.values(), 0)
        self._contacts = dict.fromkeys(table.BODIES, 0)
        self._slip_ns = self._admitted = 0
        self._basis_ns = NEVER_NS
        # Samples of world's clock and of the machine's clock [ns].
        self._instants: deque[tuple[int, int]] = deque(maxlen=STEPS + 1)

    @property
    def has_peer(self) -> bool:
        """Whether cloud is connected: commands arrive, or the session has had no command yet."""
        return super().has_peer or (self._opened_ns != NEVER_NS and self._silent)

    def _on_sessionopened(self, record: SessionOpened) -> None:
        super()._on_sessionopened(record)
        self._admitted += record.cause == ADMITTED

    def _on_groundtruth(self, record: GroundTruth) -> None:
        self._truth = record

    def _on_commandapplied(self, record: CommandApplied) -> None:
        self._basis_ns = record.basis_stamp_ns

    def _on_telemetrysent(self, record: TelemetrySent) -> None:
        self._count_age(record.stamp_ns)
        reason = record.telemetry.guard, record.telemetry.cause
        if reason != self._reason:
            self._causes[table.GUARD_CAUSES[reason[1]]] += 1
            self._reason = reason
        if record.telemetry.guard is GuardState.TRACK:  # no other state uses commands
            self._observe("command_age", (record.stamp_ns - self._basis_ns) * 1e-9)

    def _on_guardchange(self, record: GuardChange) -> None:
        if record.state != self._guard or record.state is GuardState.GROUND:
            # A record with the state LAND at touch-down is no change of the state.
            self._changes[table.GUARD_STATES[record.state]] += 1
        self._guard = record.state

    def _on_contact(self, record: Contact) -> None:
        kind = record.body.rstrip("_0123456789")
        self._contacts[kind if kind in self._contacts else "other"] += 1

    def _on_lateness(self, record: Lateness) -> None:
        super()._on_lateness(record)
        self._slip_ns, now_ns = record.slip_ns, self._deadline_ns
        if not self._instants or now_ns >= self._instants[-1][1] + STEP_NS:
            self._instants.append((record.stamp_ns, now_ns))

    def read(self) -> Readings:
        """Return the current metrics, without metrics whose values are unknown."""
        readings = super().read() | {
            "cloudrc_clouds_admitted_total": unlabelled(self._admitted),
            "cloudrc_guard_state": unlabelled(self._guard),
            "cloudrc_guard_transitions_total": by_label(self._changes),
            "cloudrc_guard_causes_total": by_label(self._causes),
            "cloudrc_contacts_total": by_label(self._contacts),
            "cloudrc_world_slip_seconds_total": unlabelled(self._slip_ns * 1e-9),
        }
        if self._truth is not None:
            readings["cloudrc_position_meters"] = per_axis(self._truth.odometry.position)
            readings["cloudrc_tip_force_newtons"] = unlabelled(self._truth.tip_force)
        instants = list(self._instants)
        if len(instants) > 1:
            (world_ns, machine_ns), (world_end_ns, machine_end_ns) = instants[0], instants[-1]
            factor = (world_end_ns - world_ns) / (machine_end_ns - machine_ns)
            readings["cloudrc_real_time_factor"] = unlabelled(factor)
        return readings


class CloudEnd(End):
    """Metrics of cloud: those of `End`, and those of loop delay, prediction and control."""

    def __init__(self, counts: Mapping[str, int]) -> None:
        super().__init__(table.CLOUD, counts)
        self._prediction, self._delay = PredictionJudge(), DelayJudge()
        self._control: Control | None = None
        self._loop_delay, self._used_count = nan, 0

    def _on_sessionopened(self, record: SessionOpened) -> None:
        super()._on_sessionopened(record)
        self._prediction.reset()
        self._delay.reset()

    def _on_arrival(self, record: Arrival) -> None:
        super()._on_arrival(record)
        self._used_count += record.used

    def _on_control(self, record: Control) -> None:
        self._control = record
        self._count_age(record.stamp_ns)
        self._prediction.take(record)
        loop_delay = record.loop_delay
        if loop_delay != self._loop_delay and loop_delay == loop_delay:  # a new echo
            self._loop_delay = loop_delay
            self._observe("loop_delay", loop_delay)
            self._observe("rtt", record.rtt)
            if self._used_count == 1:  # else it is unknown which odometry had the echo
                self._delay.echoed(record, self._newest_ns)
        self._used_count = 0
        self._delay.sent(record)

    def read(self) -> Readings:
        """Return the current metrics, without metrics whose values are unknown."""
        prediction, control = self._prediction, self._control
        readings = super().read() | {
            "cloudrc_delay_estimate_error_seconds": unlabelled(self._delay.error),
            "cloudrc_prediction_error_meters": per_axis(prediction.error),
            "cloudrc_prediction_error_square_meters_total": unlabelled(prediction.square),
            "cloudrc_predictions_judged_total": unlabelled(prediction.judged),
        }
        if control is None:
            return readings
        terms = control.proportional, control.integral, control.derivative
        (sx, sy, sz), (mx, my, mz) = control.setpoint, control.measured
        return readings | {
            "cloudrc_delay_estimate_seconds": unlabelled(control.horizon),
            "cloudrc_tracking_error_meters": per_axis((sx - mx, sy - my, sz - mz)),
            "cloudrc_setpoint_meters": per_axis(control.setpoint),
            "cloudrc_command_velocity_meters_per_second": per_axis(control.command),
            "cloudrc_command_yaw_rate_radians_per_second": unlabelled(control.yaw_rate),
            "cloudrc_pid_output": {
                (axis, name): value
                for name, term in zip(table.TERMS, terms, strict=True)
                for axis, value in zip(table.AXES, term, strict=True)
            },
        }


class Link:
    """Metrics of a process that shapes one direction of the link."""

    def __init__(self) -> None:
        self.tell: Callable[[], str] = lambda: "{}\n"  # content of /link.json, the shaper's state
        self._readings: Readings = {}

    def shaped(self, shaper: str, direction: str, mode: str, delay: float) -> None:
        """Store which `shaper` ("relay" or "netem") shapes the direction, and the key `link.mode`.

        `delay` is the mean delay that the profile now requests [s].
        """
        self._readings = {
            "cloudrc_link_info": {(shaper, direction, mode): 1.0},
            "cloudrc_link_delay_seconds": {(direction,): delay},
        }

    def read(self) -> Readings:
        """Return the current metrics; {} before the link is up."""
        return self._readings


NO_WAYPOINT = -1
"""Index of the waypoint while no mission is active."""


class Mission:
    """Metrics of missions, computed from mission events."""

    def __init__(self) -> None:
        self._state, self._waypoint, self._reached = "idle", NO_WAYPOINT, 0
        self._ended = dict.fromkeys(table.MISSION_OUTCOMES, 0)

    def _on_missionevent(self, record: MissionEvent) -> None:
        event = record.event
        if event not in UNDER_WAY:
            self._ended[event if event in self._ended else "other"] += 1
            self._state = event if event in ("done", "cancelled") else "failed"
            self._waypoint = NO_WAYPOINT
        elif event == "reached":
            self._reached += 1
            self._waypoint = record.waypoint + 1
        elif event in ("held", "paused"):
            self._state = "held"
        elif event not in BY_HAND:
            self._state, self._waypoint = "flying", record.waypoint
        elif self._state != "held":  # a new mission; in HOLD, these only move the hold point
            self._state, self._waypoint = "starting", NO_WAYPOINT

    def read(self) -> Readings:
        """Return the current metrics."""
        return {
            "cloudrc_mission_state": unlabelled(table.MISSION_STATES.index(self._state)),
            "cloudrc_mission_waypoint": unlabelled(self._waypoint),
            "cloudrc_waypoints_reached_total": unlabelled(self._reached),
            "cloudrc_missions_total": by_label(self._ended),
        }


def _read_count(metric: Metric, counts: Mapping[str, int]) -> dict[Labels, float]:
    """Return the values of a metric that is a count; convert a count of ns to s."""
    begins_at_0 = metric.kind is Kind.COUNTER and metric.name not in ONE_SHAPER
    found: dict[Labels, float] = {}
    for labels in product(*metric.labels.values()):  # of one label or none
        name = metric.counted.replace("*", *labels or [""]).replace(".", "")
        if begins_at_0 or name in counts:
            found[labels] = counts.get(name, 0) * (1e-9 if name.endswith("_ns") else 1)
    return found


class LiveMetrics:
    """Current metrics of one process. One thread calls `see`, any other thread may call `read`."""

    def __init__(self, role: str, *, missions: bool = True) -> None:
        """Set the role of the process: "world", "cloud", "teleop" or "link".

        `missions` is False in a cloud whose separate teleop exposes the metrics of missions.
        """
        self._role = role
        self._counts: dict[str, int] = {}
        ends: dict[str, type[WorldEnd | CloudEnd]] = {table.WORLD: WorldEnd, table.CLOUD: CloudEnd}
        self.end: End | None = ends[role](self._counts) if role in ends else None
        self.link = Link() if role == table.LINK else None
        has_mission = missions and role in (table.CLOUD, table.TELEOP)
        mission = Mission() if has_mission else None
        parts = self.end, self.end and self.end.check, self.link, mission
        self._parts = [part for part in parts if part is not None]
        # The method `_on_NAME` of a part handles the records of the class NAME.
        self._handlers: dict[type, Callable[[Any], None]] = {
            kind: getattr(part, name)
            for part in (self, *self._parts)
            for kind in get_args(Record)
            if hasattr(part, name := f"_on_{kind.__name__.lower()}")
        }

    def _on_counted(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def see(self, records: Iterable[Record]) -> None:
        """Update the metrics with new records of this process, oldest first, without blocking."""
        for record in records:
            if handle := self._handlers.get(type(record)):
                handle(record)

    def read(self) -> Readings:
        """Return the current metrics, without metrics whose values are unknown."""
        counts = dict(self._counts)
        readings: Readings = {}
        for metric in of_role(self._role):
            if metric.counted and (found := _read_count(metric, counts)):
                readings[metric.name] = found
        for part in self._parts:
            readings |= part.read()
        return readings
