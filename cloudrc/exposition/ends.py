"""Current metrics of world and cloud, the two ends of the tunnel, computed from their records.

Errors of predictions and delay estimates come from `Control` records alone. Each stamp is compared
only with stamps of its own clock, so the errors are right without a shared clock.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from math import isfinite, nan

from cloudrc.exposition.parts import (
    DatagramTally,
    DelayJudge,
    Handlers,
    Histogram,
    PredictionJudge,
    Readings,
    by_label,
    per_axis,
    unlabelled,
)
from cloudrc.exposition.table import (
    AXES,
    BODIES,
    CLOUD,
    DIRECTIONS,
    GUARD_STATES,
    ONLY_CLOUD,
    ONLY_WORLD,
    OUTCOMES,
    TERMS,
    WORLD,
    Labels,
    of_role,
)
from cloudrc.messages import NEVER_NS, GuardState
from cloudrc.records import (
    Arrival,
    CommandApplied,
    Contact,
    Control,
    Fault,
    GroundTruth,
    GuardChange,
    Lateness,
    LinkChecked,
    SessionOpened,
    TelemetrySent,
)


class LinkVerdict:
    """The newest verdict on an end's incoming direction of the link."""

    def __init__(self, direction: str) -> None:
        """Set the direction, "uplink" or "downlink"; the verdict is "open"."""
        self._direction = direction
        self._newest: tuple[LinkChecked, ...] = ()

    def see(self, record: LinkChecked) -> None:
        """Store the verdict on one quantity, and drop the quantities of an older check."""
        newest = self._newest
        if newest and newest[0].stamp_ns != record.stamp_ns:
            newest = ()
        self._newest = (*newest, record)  # a new tuple: another thread may be reading the old one

    @property
    def verdict(self) -> str:
        """Overall verdict: "ok", "off", or "open" while there are too few datagrams."""
        verdicts = {record.verdict for record in self._newest} - {"told"}
        return "off" if "off" in verdicts else "ok" if verdicts == {"ok"} else "open"

    def text(self) -> str:
        """Make the page /link.json: the overall verdict and a row per quantity."""
        rows = [
            {
                key: value
                for key, value in record._asdict().items()
                # Left out are values that are equal in all rows, and unknown values.
                if key not in ("stamp_ns", "uplink")
                and not (isinstance(value, float) and not isfinite(value))
            }
            for record in self._newest
        ]
        document = {"direction": self._direction, "verdict": self.verdict, "rows": rows}
        return json.dumps(document, indent=2) + "\n"

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        if self.verdict == "open":
            return {}
        return {"cloudrc_link_believed": {(self._direction,): float(self.verdict == "ok")}}


CLOCK_SET = "wall_clock"
"""Fault code of a step of the wall clock; `cloudrc.drivers.recording` detects steps."""
SILENCE_NS = 2_000_000_000
"""Time without a new datagram after which an end has no peer [ns]."""


class End:
    """Metrics that world and cloud share: session, datagrams, one-way delay, timing of the loop.

    Attributes:
        check: Verdict on the incoming direction of the link.
    """

    def __init__(self, role: str, counts: Mapping[str, int]) -> None:
        """Set the role, "world" or "cloud", and the counts; there is no session."""
        self._counts, self._stream = counts, DatagramTally()
        self._outgoing, self._incoming = DIRECTIONS if role == WORLD else DIRECTIONS[::-1]
        others = ONLY_CLOUD if role == WORLD else ONLY_WORLD
        self._outcomes = tuple(name for name in OUTCOMES[1:] if name not in others)
        self.check = LinkVerdict(self._incoming)
        self._histograms = {
            metric.name: Histogram(metric.buckets) for metric in of_role(role) if metric.buckets
        }
        self._one_way = self._histograms[f"cloudrc_{self._incoming}_delay_seconds"]
        self._age = self._histograms["cloudrc_age_of_information_seconds"]
        self._gap = self._histograms["cloudrc_link_gap_seconds"]
        self._period = self._histograms["cloudrc_loop_period_seconds"]
        self._lateness = self._histograms["cloudrc_loop_lateness_seconds"]
        self._busy = 0.0
        self._clock_steps = 0
        self._sessions, self._epoch, self._opened_ns = 0, 0, NEVER_NS
        self._arrival_ns = self._woke_ns = self._deadline_ns = NEVER_NS
        self._silent = True  # no telemetry or command has arrived in this session
        # Arrival [ns] and one-way delay [s] of the newest used datagram: the age of information.
        self._newest_ns, self._newest_delay = NEVER_NS, nan

    def handlers(self) -> Handlers:
        """Map each class of records that this part uses to a handler."""
        return {
            Arrival: self._on_arrival,
            Fault: self._on_fault,
            Lateness: self._on_wake,
            SessionOpened: self._on_session,
            LinkChecked: self.check.see,
        }

    @property
    def has_peer(self) -> bool:
        """Whether a new datagram of the other end has arrived in the last 2 s."""
        return self._opened_ns != NEVER_NS and self._woke_ns - self._arrival_ns < SILENCE_NS

    def _on_arrival(self, record: Arrival) -> None:
        stamp_ns, _, epoch, counter, delay, used = record
        if self._stream.take(epoch, counter):  # a replay is no sign of life: anybody can send it
            if not self._silent:
                self._gap.observe((stamp_ns - self._arrival_ns) * 1e-9)
            self._arrival_ns, self._silent = stamp_ns, False
        if delay == delay:  # not NaN: both ends share a clock
            self._one_way.observe(delay)
        if used:
            self._newest_ns, self._newest_delay = stamp_ns, delay

    def _on_fault(self, record: Fault) -> None:
        self._clock_steps += record.code == CLOCK_SET

    def _on_session(self, record: SessionOpened) -> None:
        self._sessions += 1
        self._epoch = record.epoch
        self._opened_ns = self._arrival_ns = record.stamp_ns
        self._silent = True
        self._newest_delay = nan

    def _on_wake(self, record: Lateness) -> None:
        stamp_ns, _, lateness, busy, slip_ns = record
        now_ns = stamp_ns + slip_ns
        if self._deadline_ns != NEVER_NS:
            self._period.observe((now_ns - self._deadline_ns) * 1e-9)
        self._deadline_ns, self._woke_ns = now_ns, stamp_ns
        self._lateness.observe(lateness)
        self._busy += busy

    def _count_age(self, now_ns: int) -> None:
        """Count the age of information at `now_ns` [ns, own clock], once per period."""
        delay = self._newest_delay
        if delay == delay:
            self._age.observe(delay + (now_ns - self._newest_ns) * 1e-9)

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        counts, stream, incoming = self._counts, self._stream, self._incoming
        datagrams: dict[Labels, float] = {
            (incoming, name): counts.get(name, 0) for name in self._outcomes
        }
        datagrams[self._outgoing, "sent"] = counts.get("sent", 0)
        readings: Readings = {
            **self._histograms,
            **self.check.read(),
            "cloudrc_session_epoch": unlabelled(self._epoch),
            "cloudrc_sessions_opened_total": unlabelled(self._sessions),
            "cloudrc_datagrams_total": datagrams,
            "cloudrc_datagrams_expected_total": {(incoming,): stream.expected},
            "cloudrc_datagrams_lost_total": {(incoming,): stream.lost},
            "cloudrc_datagrams_reordered_total": {(incoming,): stream.reordered},
            "cloudrc_loop_busy_seconds_total": unlabelled(self._busy),
            "cloudrc_clock_steps_total": unlabelled(self._clock_steps),
        }
        if not self._one_way.cumulative()[-1]:  # unknown without a shared clock: absent, never zero
            del readings[f"cloudrc_{incoming}_delay_seconds"]
            del readings["cloudrc_age_of_information_seconds"]
        return readings


STEP_NS = 1_000_000_000
"""Time between two samples of the real-time factor [ns]."""
STEPS = 10
"""Number of steps over which the real-time factor is computed [1]; all steps together last 10 s."""
ADMITTED = "cloud said hello"
"""`SessionOpened.cause` of a session that world opens for a newly connected cloud."""


class WorldEnd(End):
    """Metrics of world: metrics of every end, the robot, guard, contacts, real-time factor."""

    def __init__(self, counts: Mapping[str, int]) -> None:
        """Set the counts and the guard's state GROUND."""
        super().__init__(WORLD, counts)
        self._truth: GroundTruth | None = None
        self._guard = GuardState.GROUND
        self._changes = dict.fromkeys(GUARD_STATES, 0)
        self._contacts = dict.fromkeys(BODIES, 0)
        self._slip_ns = self._admitted = 0
        self._basis_ns, self._command_age = (
            NEVER_NS,
            self._histograms["cloudrc_command_age_seconds"],
        )
        # Samples of world's clock and of the machine's clock [ns].
        self._instants: deque[tuple[int, int]] = deque(maxlen=STEPS + 1)
        self._instant_ns = NEVER_NS

    def handlers(self) -> Handlers:
        """Map each class of records that this part uses to a handler."""
        return {
            **super().handlers(),
            GroundTruth: self._on_truth,
            TelemetrySent: self._on_telemetry,
            CommandApplied: self._on_command,
            GuardChange: self._on_guard,
            Contact: self._on_contact,
        }

    @property
    def has_peer(self) -> bool:
        """Whether world receives datagrams from cloud.

        Cloud sends nothing that these metrics see before its first command in a session. Until
        that command, the session itself counts as a peer.
        """
        return super().has_peer or (self._opened_ns != NEVER_NS and self._silent)

    def _on_session(self, record: SessionOpened) -> None:
        super()._on_session(record)
        self._admitted += record.cause == ADMITTED

    def _on_truth(self, record: GroundTruth) -> None:
        self._truth = record

    def _on_command(self, record: CommandApplied) -> None:
        self._basis_ns = record.basis_stamp_ns

    def _on_telemetry(self, record: TelemetrySent) -> None:
        self._count_age(record.stamp_ns)
        if record.telemetry.guard is GuardState.TRACK:  # no other state uses commands
            self._command_age.observe((record.stamp_ns - self._basis_ns) * 1e-9)

    def _on_guard(self, record: GuardChange) -> None:
        if record.state != self._guard or record.state is GuardState.GROUND:
            self._changes[GUARD_STATES[record.state]] += 1  # touch-down repeats LAND: not a change
        self._guard = record.state

    def _on_contact(self, record: Contact) -> None:
        kind = record.body.rstrip("_0123456789")
        self._contacts[kind if kind in self._contacts else "other"] += 1

    def _on_wake(self, record: Lateness) -> None:
        super()._on_wake(record)
        now_ns = self._deadline_ns
        self._slip_ns = record.slip_ns
        if now_ns >= self._instant_ns:
            self._instant_ns = now_ns + STEP_NS
            self._instants.append((record.stamp_ns, now_ns))

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        readings = super().read() | {
            "cloudrc_clouds_admitted_total": unlabelled(self._admitted),
            "cloudrc_guard_state": unlabelled(self._guard),
            "cloudrc_guard_transitions_total": by_label(self._changes),
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
    """Metrics of cloud: metrics of every end, delays in the loop, prediction, control."""

    def __init__(self, counts: Mapping[str, int]) -> None:
        """Set the counts; there is no control period yet."""
        super().__init__(CLOUD, counts)
        self._rtt = self._histograms["cloudrc_rtt_seconds"]
        self._loop = self._histograms["cloudrc_loop_delay_seconds"]
        self._prediction, self._delay = PredictionJudge(), DelayJudge()
        self._control: Control | None = None
        self._loop_delay = nan
        self._used_count = 0

    def handlers(self) -> Handlers:
        """Map each class of records that this part uses to a handler."""
        return {**super().handlers(), Control: self._on_control}

    def _on_session(self, record: SessionOpened) -> None:
        super()._on_session(record)
        self._prediction.reset()
        self._delay.reset()

    def _on_arrival(self, record: Arrival) -> None:
        super()._on_arrival(record)
        if record.used:
            self._used_count += 1

    def _on_control(self, record: Control) -> None:
        self._control = record
        self._count_age(record.stamp_ns)
        self._prediction.take(record)
        loop_delay = record.loop_delay
        if loop_delay != self._loop_delay and loop_delay == loop_delay:  # a new echo
            self._loop_delay = loop_delay
            self._loop.observe(loop_delay)
            self._rtt.observe(record.rtt)
            if self._used_count == 1:  # with two odometries, which one echoed is unknown
                self._delay.echoed(record, self._newest_ns)
        self._used_count = 0
        self._delay.sent(record)

    def read(self) -> Readings:
        """Return the current values; unknown values are absent."""
        prediction = self._prediction
        readings = super().read() | {
            "cloudrc_delay_estimate_error_seconds": unlabelled(self._delay.error),
            "cloudrc_prediction_error_meters": per_axis(prediction.error),
            "cloudrc_prediction_error_square_meters_total": unlabelled(prediction.square),
            "cloudrc_predictions_judged_total": unlabelled(prediction.judged),
        }
        return readings if self._control is None else readings | _read_period(self._control)


def _read_period(control: Control) -> Readings:
    """Read the metrics of one control period."""
    terms = (control.proportional, control.integral, control.derivative)
    (sx, sy, sz), (mx, my, mz) = control.setpoint, control.measured
    return {
        "cloudrc_delay_estimate_seconds": unlabelled(control.horizon),
        "cloudrc_tracking_error_meters": per_axis((sx - mx, sy - my, sz - mz)),
        "cloudrc_setpoint_meters": per_axis(control.setpoint),
        "cloudrc_command_velocity_meters_per_second": per_axis(control.command),
        "cloudrc_command_yaw_rate_radians_per_second": unlabelled(control.yaw_rate),
        "cloudrc_pid_output": {
            (axis, name): term[index]
            for name, term in zip(TERMS, terms, strict=True)
            for index, axis in enumerate(AXES)
        },
    }
