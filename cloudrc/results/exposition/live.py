# SPDX-License-Identifier: Apache-2.0

"""Compute the current metrics of one process from its records.

The errors of predictions and of delay estimates are correct even if world and cloud do not share a
clock: they are computed from differences between stamps of one clock.
"""

from __future__ import annotations

import json
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from math import nan
from typing import TYPE_CHECKING, Any, Final, Literal, TypeAlias, get_args

from cloudrc.link.verify import verdict_of
from cloudrc.results.exposition import table
from cloudrc.results.exposition.parts import Histogram, Readings, samples
from cloudrc.results.exposition.table import LiveMetric, MetricKind, of_role
from cloudrc.results.metrics.definitions import (
    QUANTITIES,
    WAITING_MAX,
    DatagramTally,
    DelayJudge,
    Holds,
    PredictionJudge,
    age,
    real_time_factor,
)
from cloudrc.wire.messages import NEVER_NS, Cause, GuardState
from cloudrc.wire.records import (
    BY_HAND,
    UNDER_WAY,
    Arrival,
    CommandApplied,
    Contact,
    ContactForce,
    Control,
    Counted,
    Fault,
    FrameSent,
    GuardChange,
    Lateness,
    LinkChecked,
    MissionEvent,
    MissionState,
    PlanFollowed,
    Record,
    SensorRead,
    SessionOpened,
    TelemetrySent,
)

if TYPE_CHECKING:
    from cloudrc.link.cell import Usage

Values: TypeAlias = dict[str, Any]
"""Name of a metric -> its current value, of a kind that `samples` converts, or its histogram."""
ONE_SHAPER = ("cloudrc_link_restored_total", "cloudrc_link_released_early_total")
"""Metrics that only relay or only netem has; without a count they are left out."""


CLOCK_SET: Final = "wall_clock"
"""Fault code for a step of the wall clock."""
SILENCE_NS = 2_000_000_000
"""Time without a new datagram from the peer after which the peer counts as disconnected [ns]."""


class End:
    """Metrics that both world and cloud have: session, datagrams, one-way delay, loop timing."""

    def __init__(self, role: str, values: Values) -> None:
        """Make the metrics of `role`, "world" or "cloud", in `values`."""
        self._values, self._stream = values, DatagramTally()
        outgoing, self._incoming, others = "uplink", "downlink", table.ONLY_CLOUD
        if role == table.CLOUD:
            outgoing, self._incoming, others = "downlink", "uplink", table.ONLY_WORLD
        outcomes = dict.fromkeys((name for name in table.OUTCOMES[1:] if name not in others), 0)
        values["cloudrc_datagrams_total"] = {self._incoming: outcomes, outgoing: {"sent": 0}}
        for name in ("expected", "lost", "reordered"):
            values[f"cloudrc_datagrams_{name}_total"] = {self._incoming: 0}
        values["cloudrc_session_epoch"] = 0
        self._checked: tuple[LinkChecked, ...] = ()  # the newest verdict on each quantity
        self._opened_ns = NEVER_NS
        self._arrival_ns = self._woke_ns = self._deadline_ns = NEVER_NS
        self._silent = True  # whether no telemetry or command has arrived in this session
        # Arrival [ns] and one-way delay [s] of the newest used datagram.
        self._newest_ns, self._newest_delay = NEVER_NS, nan

    @property
    def has_peer(self) -> bool:
        """Whether a session began or a new datagram of the peer arrived in the last 2 s."""
        return self._opened_ns != NEVER_NS and self._woke_ns - self._arrival_ns < SILENCE_NS

    def link_text(self) -> str:
        """Return the content of /link.json: the verdict on the link, and a row per quantity."""
        _, _, *names = LinkChecked._fields  # the first two are equal in all rows
        document = {
            "direction": self._incoming,
            "verdict": verdict_of(self._checked),
            "rows": [
                {key: value for key, value in zip(names, values, strict=True) if value == value}
                for _, _, *values in self._checked
            ],
        }
        return json.dumps(document, indent=2) + "\n"

    def _on_linkchecked(self, record: LinkChecked) -> None:
        """Store the verdict on one quantity, and drop verdicts of earlier checks."""
        newest = [one for one in self._checked if one.stamp_ns == record.stamp_ns]
        self._checked = (*newest, record)  # a new tuple: another thread may read the old one
        believed = {"ok": 1.0, "off": 0.0}.get(verdict_of(self._checked), nan)
        self._values["cloudrc_link_believed"] = {self._incoming: believed}

    def _observe(self, name: str, seconds: float) -> None:
        self._values[f"cloudrc_{name}_seconds"].observe(seconds)

    def _on_arrival(self, record: Arrival) -> None:
        stamp_ns, _, epoch, counter, delay, used, *_ = record
        values, stream, incoming = self._values, self._stream, self._incoming
        if stream.take(epoch, counter):  # not a replay, which anybody can send
            if not self._silent:
                self._observe("link_gap", (stamp_ns - self._arrival_ns) * 1e-9)
            self._arrival_ns, self._silent = stamp_ns, False
            values["cloudrc_datagrams_expected_total"][incoming] = stream.expected
            values["cloudrc_datagrams_lost_total"][incoming] = stream.lost
            values["cloudrc_datagrams_reordered_total"][incoming] = stream.reordered
        if delay == delay:  # not NaN: both ends share a clock
            self._observe(f"{incoming}_delay", delay)
        if used:
            self._newest_ns, self._newest_delay = stamp_ns, delay

    def _on_fault(self, record: Fault) -> None:
        self._values["cloudrc_clock_steps_total"] += record.code == CLOCK_SET

    def _on_sessionopened(self, record: SessionOpened) -> None:
        self._values["cloudrc_sessions_opened_total"] += 1
        self._values["cloudrc_session_epoch"] = record.epoch
        self._opened_ns = self._arrival_ns = record.stamp_ns
        self._silent, self._newest_delay = True, nan

    def _on_lateness(self, record: Lateness) -> None:
        stamp_ns, _, lateness, busy, slip_ns = record
        now_ns = stamp_ns + slip_ns
        if self._deadline_ns != NEVER_NS:
            self._observe("loop_period", (now_ns - self._deadline_ns) * 1e-9)
        self._deadline_ns, self._woke_ns = now_ns, stamp_ns
        self._observe("loop_lateness", lateness)
        self._values["cloudrc_loop_busy_seconds_total"] += busy

    def _count_age(self, now_ns: int) -> None:
        """Store the age of the newest datagram at `now_ns` [ns], this process's clock."""
        delay = self._newest_delay
        if delay == delay:
            self._observe("age_of_information", delay + age(now_ns, self._newest_ns))


STEP_NS, STEPS = 1_000_000_000, 10
"""The real-time factor is an average over `STEPS` intervals of `STEP_NS` [ns]."""
ADMITTED = "cloud said hello"
"""Text of `SessionOpened.cause` if a session begins because a cloud process has connected."""


class WorldEnd(End):
    """Metrics of world: all of `End`, and those of robot, guard, contacts and real-time factor."""

    def __init__(self, values: Values) -> None:
        super().__init__(table.WORLD, values)
        values["cloudrc_guard_state"] = GuardState.GROUND
        self._reason = GuardState.GROUND, Cause.SPAWN
        self._basis_ns, self._holds = NEVER_NS, Holds()
        # Samples of world's clock and of its lag behind the machine's clock [ns].
        self._instants: deque[tuple[int, int]] = deque(maxlen=STEPS + 1)

    @property
    def has_peer(self) -> bool:
        """Whether cloud is connected: commands arrive, or the session has had no command yet."""
        return super().has_peer or (self._opened_ns != NEVER_NS and self._silent)

    def _on_sessionopened(self, record: SessionOpened) -> None:
        super()._on_sessionopened(record)
        self._values["cloudrc_clouds_admitted_total"] += record.cause == ADMITTED

    def _on_sensorread(self, record: SensorRead) -> None:
        _, name, unit, value = record
        self._set("cloudrc_sensor_value", name, {unit: value})

    def _on_contactforce(self, record: ContactForce) -> None:
        if record.sensor is not None:
            self._set(
                "cloudrc_sensor_value", record.sensor.name, {record.sensor.unit: record.force}
            )

    def _on_framesent(self, record: FrameSent) -> None:
        self._observe("camera", record.encode_ns * 1e-9)

    def _on_commandapplied(self, record: CommandApplied) -> None:
        self._basis_ns = record.basis_stamp_ns

    def _on_telemetrysent(self, record: TelemetrySent) -> None:
        self._count_age(record.stamp_ns)
        reason = record.telemetry.guard, record.telemetry.cause
        if reason != self._reason:
            self._values["cloudrc_guard_causes_total"][table.GUARD_CAUSES[reason[1]]] += 1
            self._reason = reason
        if record.telemetry.guard is GuardState.TRACK:  # no other state uses commands
            self._observe("command_age", age(record.stamp_ns, self._basis_ns))
        self._values["cloudrc_guard_held_seconds_total"] = self._holds.time(record.stamp_ns)

    def _on_guardchange(self, record: GuardChange) -> None:
        state, values = record.state, self._values
        if state != values["cloudrc_guard_state"] or state is GuardState.GROUND:
            # A record with the state LAND at touch-down is no change of the state.
            values["cloudrc_guard_transitions_total"][table.GUARD_STATES[state]] += 1
        values["cloudrc_guard_state"] = state
        self._holds.take(*record)
        values["cloudrc_guard_holds_total"] = self._holds.count

    def _on_contact(self, record: Contact) -> None:
        count = self._values["cloudrc_contacts_total"].get(record.body, 0)
        self._set("cloudrc_contacts_total", record.body, count + 1)

    def _set(self, metric: str, label: str, value: Any) -> None:
        """Set one value of a metric whose label may have any value."""
        known = self._values[metric]
        if label in known:
            known[label] = value
        else:  # a new dict: another thread may read the old one
            self._values[metric] = {**known, label: value}

    def _on_lateness(self, record: Lateness) -> None:
        super()._on_lateness(record)
        self._values["cloudrc_world_slip_seconds_total"] = record.slip_ns * 1e-9
        now_ns, instants = self._deadline_ns, self._instants
        if not instants or now_ns >= sum(instants[-1]) + STEP_NS:
            instants.append((record.stamp_ns, record.slip_ns))
            (first_ns, first_slip_ns), (last_ns, last_slip_ns) = instants[0], instants[-1]
            factor = real_time_factor(last_ns - first_ns, last_slip_ns - first_slip_ns)
            self._values["cloudrc_real_time_factor"] = factor


class CloudEnd(End):
    """Metrics of cloud: those of `End`, and those of loop delay, prediction and control."""

    def __init__(self, values: Values) -> None:
        super().__init__(table.CLOUD, values)
        self._prediction, self._delay = PredictionJudge(), DelayJudge()
        self._used = list[Arrival]()  # since the last control period
        self._echoed: dict[int, None] = {}  # stamps of the commands whose echo arrived [ns]
        self._has_plans = False

    def _on_sessionopened(self, record: SessionOpened) -> None:
        super()._on_sessionopened(record)
        self._prediction.reset()
        self._delay.reset()

    def _on_arrival(self, record: Arrival) -> None:
        super()._on_arrival(record)
        echo_ns, echoed = record.echo_stamp_ns, self._echoed
        if not record.used:
            return
        self._used.append(record)
        if echo_ns == NEVER_NS:
            return
        loop_delay = age(record.stamp_ns, echo_ns)
        if record.is_sample:
            self._observe("delay_sample", loop_delay)
        if echo_ns not in echoed:
            self._observe("loop_delay", loop_delay)
            self._observe("rtt", loop_delay - record.echo_hold_ns * 1e-9)
            echoed[echo_ns] = None
            if len(echoed) > WAITING_MAX:
                del echoed[next(iter(echoed))]  # the oldest

    def _on_planfollowed(self, record: PlanFollowed) -> None:
        self._has_plans = True  # their horizon is the beginning of the plan, not the true delay

    def _on_control(self, record: Control) -> None:
        self._count_age(record.stamp_ns)
        self._prediction.take(record)
        if len(self._used) == 1:  # of several, it is unknown which had the odometry
            self._delay.echoed(self._used[0], record.basis_stamp_ns)
        self._used.clear()
        self._delay.sent(record)
        values = self._values
        delay_error = nan if self._has_plans else self._delay.error
        values["cloudrc_delay_estimate_error_seconds"] = delay_error
        values["cloudrc_estimate_error_meters"] = self._prediction.error
        values["cloudrc_estimate_error_square_meters_total"] = self._prediction.square
        values["cloudrc_predictions_judged_total"] = self._prediction.judged
        terms = values["cloudrc_pid_output"]
        terms["proportional"] = record.proportional
        terms["integral"] = record.integral
        terms["derivative"] = record.derivative


class LinkMetrics:
    """Metrics of a process that shapes one direction of the link, or both."""

    def __init__(self, values: Values) -> None:
        self.tell: Callable[[], str] = lambda: "{}\n"  # content of /link.json, the shaper's state
        self._values = values
        self._ways = dict[str, tuple[str, str, float]]()  # direction -> shaper, mode, delay [s]

    def shaped(self, shaper: str, direction: str, mode: str, delay: float) -> None:
        """Store which `shaper` ("relay" or "netem") shapes the direction.

        `mode` is the value of the key `link.mode`. `delay` is the mean delay that the profile now
        requests [s].
        """
        self._ways[direction] = shaper, mode, delay
        # New dictionaries: another thread may read the old ones.
        info, delays = defaultdict[str, Values](dict), Values()
        for way, (by, asked, mean) in self._ways.items():
            info[by][way] = {asked: 1.0}
            delays[way] = mean
        self._values |= {"cloudrc_link_info": info, "cloudrc_link_delay_seconds": delays}


class CellMetrics:
    """Metrics of the radio cell of a fleet."""

    def __init__(self, values: Values) -> None:
        self._values, self._robots = values, 0
        self._dropped = Counter[tuple[int, str]]()

    def expect(self, robots: int) -> None:
        """Set the number of robots, which have counters from the start."""
        self._robots = robots

    def take(self, done: Sequence[Usage]) -> None:
        """Take what the cells have done in the newest tenth of a second."""
        busy, queued, waits = Values(), Values(), Values()
        lost = {str(robot): Values() for robot in range(self._robots)}
        for each in done:
            way = each.direction
            busy[way], queued[way] = each.busy_ns * 1e-8, each.most
            waits[way] = each.waited_ns * 1e-9 / each.packets if each.packets else nan
            self._dropped.update({(robot, way): n for robot, n in each.dropped.items()})
            for robot in range(self._robots):
                lost[str(robot)][way] = self._dropped[robot, way]
        self._values |= {  # new dictionaries: another thread may read the old ones
            "cloudrc_cell_dropped_total": lost,
            "cloudrc_cell_utilisation": busy,
            "cloudrc_cell_queue_packets": queued,
            "cloudrc_cell_wait_seconds": waits,
        }


NO_WAYPOINT = -1
"""Index of the waypoint while no mission is active."""
HELD = table.MISSION_STATES.index("held")


class MissionMetrics:
    """Metrics of missions, computed from mission events."""

    def __init__(self, values: Values) -> None:
        self._values = values
        self._set("idle", NO_WAYPOINT)

    def _set(self, state: Literal["idle"] | MissionState, waypoint: int) -> None:
        self._values["cloudrc_mission_state"] = table.MISSION_STATES.index(state)
        self._values["cloudrc_mission_waypoint"] = waypoint

    def _on_missionevent(self, record: MissionEvent) -> None:
        event, values = record.event, self._values
        if event not in UNDER_WAY:
            ended = values["cloudrc_missions_total"]
            ended[event if event in ended else "other"] += 1
            self._set(event if event in ("done", "cancelled") else "failed", NO_WAYPOINT)
        elif event == "reached":
            values["cloudrc_waypoints_reached_total"] += 1
            values["cloudrc_mission_waypoint"] = record.waypoint + 1
        elif event in ("held", "paused"):
            values["cloudrc_mission_state"] = HELD
        elif event not in BY_HAND:
            self._set("flying", record.waypoint)
        # A new mission; in HOLD, these events only move the hold point.
        elif values["cloudrc_mission_state"] != HELD:
            self._set("starting", NO_WAYPOINT)


def _beginning(metric: LiveMetric) -> Any:
    """Return the value of a metric before the first record: 0 for a counter, else unknown."""
    if metric.buckets:
        return Histogram(metric.buckets)
    value = 0 if metric.kind is MetricKind.COUNTER and metric.name not in ONE_SHAPER else nan
    return dict.fromkeys(next(iter(metric.labels.values())), value) if metric.labels else value


def _places(metrics: Iterable[LiveMetric], values: Values) -> dict[str, list[tuple[Values, str]]]:
    """Map the name of each `Counted` record to the dicts and keys that store its total."""
    counted = [("*", outcomes) for outcomes in values.get("cloudrc_datagrams_total", {}).values()]
    places = defaultdict(list)
    for metric in metrics:
        if metric.counted and metric.labels:
            counted.append((metric.counted, values[metric.name]))
        elif metric.counted:
            places[metric.counted].append((values, metric.name))
    for pattern, by_label in counted:
        for label in by_label:
            places[pattern.replace("*", label).replace(".", "")].append((by_label, label))
    return places


PARTS = {
    table.WORLD: WorldEnd,
    table.CLOUD: CloudEnd,
    table.TELEOP: MissionMetrics,
    table.LINK: LinkMetrics,
    table.CELL: CellMetrics,
}
"""Role of a process -> what handles its records: method `_on_NAME` those of the class NAME."""


class LiveMetrics:
    """Current metrics of one process. One thread calls `see`, any other thread may call `read`."""

    def __init__(self, role: str) -> None:
        """Set the role of the process, one of `table.ROLES`."""
        # The exporter reads the metrics that all processes have.
        metrics = [metric for metric in of_role(role) if metric.roles != table.ROLES]
        # It has a key per metric from now on: another thread may read it at any time.
        self._values = values = {metric.name: _beginning(metric) for metric in metrics}
        part = PARTS[role](values)
        self.end = part if isinstance(part, End) else None
        self.link = part if isinstance(part, LinkMetrics) else None
        self.cell = part if isinstance(part, CellMetrics) else None
        self._places = _places(metrics, values)
        self._handlers: dict[type, Callable[[Any], None]] = {Counted: self._on_counted}
        for kind in get_args(Record):
            if handle := getattr(part, f"_on_{kind.__name__.lower()}", None):
                self._handlers[kind] = handle
        self._gauges = defaultdict[type, list[tuple[str, Callable[[Any], Any]]]](list)
        for quantity in QUANTITIES:
            if (name := quantity.live.partition("[")[0]) in values:
                self._gauges[quantity.source].append((name, quantity.value))

    def _on_counted(self, record: Counted) -> None:
        for values, key in self._places.get(record.name, ()):
            values[key] = record.total * (1e-9 if record.name.endswith("_ns") else 1)

    def see(self, records: Iterable[Record]) -> None:
        """Update the metrics with new records of this process, oldest first, without blocking."""
        for record in records:
            if handle := self._handlers.get(type(record)):
                handle(record)
            for name, value in self._gauges.get(type(record), ()):
                self._values[name] = value(record)

    def read(self) -> Readings:
        """Return the current metrics, without metrics whose values are unknown."""
        readings = {
            name: value if isinstance(value, Histogram) else samples(value)
            for name, value in self._values.items()
        }
        return {name: reading for name, reading in readings.items() if reading}
