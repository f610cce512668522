"""What world exposes besides what both ends do: the robot, its guard, contacts, real time."""

from __future__ import annotations

from collections import deque

from cloudrc.exposition.end import End
from cloudrc.exposition.histogram import Histogram
from cloudrc.exposition.labels import BODIES, DELAY_BUCKETS, DIRECTIONS, GUARD_STATES, LIMITS
from cloudrc.exposition.part import Handlers, Readings, by, per_axis, plain
from cloudrc.messages import NEVER_NS, GuardState
from cloudrc.records import (
    CommandApplied,
    Contact,
    GroundTruth,
    GuardChange,
    Lateness,
    SessionOpened,
    TelemetrySent,
)

STEP_NS = 1_000_000_000
STEPS = 10
"""The real-time factor is that of the last 10 s, or of what there is."""
ADMITTED = "cloud said hello"
"""Why a session is opened for a cloud that had none; see `cloudrc.records.SessionOpened`."""


class WorldEnd(End):
    """The robot's end."""

    def __init__(self) -> None:
        """Begin on the ground."""
        uplink, downlink = DIRECTIONS
        super().__init__(incoming=downlink, outgoing=uplink)
        self._truth: GroundTruth | None = None
        self._guard = GuardState.GROUND
        self._changes = dict.fromkeys(GUARD_STATES, 0)
        self._contacts = dict.fromkeys(BODIES, 0)
        self._slip_ns = self._admitted = 0
        self._basis_ns, self._command_age = NEVER_NS, Histogram(DELAY_BUCKETS)
        # Instants of world's clock and of the machine's [ns].
        self._instants: deque[tuple[int, int]] = deque(maxlen=STEPS + 1)
        self._instant_ns = NEVER_NS

    def handlers(self) -> Handlers:
        """See `Part`."""
        return {
            **super().handlers(),
            GroundTruth: self._see_truth,
            TelemetrySent: self._see_telemetry,
            CommandApplied: self._see_command,
            GuardChange: self._see_guard,
            Contact: self._see_contact,
        }

    @property
    def has_peer(self) -> bool:
        """As of any end; a cloud that has nothing to command yet is heard once, at its hello."""
        return super().has_peer or (self._opened_ns != NEVER_NS and self._silent)

    def _see_session(self, record: SessionOpened) -> None:
        super()._see_session(record)
        self._admitted += record.cause == ADMITTED

    def _see_truth(self, record: GroundTruth) -> None:
        self._truth = record

    def _see_command(self, record: CommandApplied) -> None:
        self._basis_ns = record.basis_stamp_ns

    def _see_telemetry(self, record: TelemetrySent) -> None:
        self._see_age(record.stamp_ns)
        if record.telemetry.guard is GuardState.TRACK:  # nowhere else a command is in use
            self._command_age.observe((record.stamp_ns - self._basis_ns) * 1e-9)

    def _see_guard(self, record: GuardChange) -> None:
        if record.state != self._guard or record.state is GuardState.GROUND:
            self._changes[GUARD_STATES[record.state]] += 1  # touch-down is told, but stays LAND
        self._guard = record.state

    def _see_contact(self, record: Contact) -> None:
        kind = record.body.rstrip("_0123456789")
        self._contacts[kind if kind in self._contacts else "other"] += 1

    def _see_wake(self, record: Lateness) -> None:
        super()._see_wake(record)
        now_ns = self._deadline_ns
        self._slip_ns = record.slip_ns
        if now_ns >= self._instant_ns:
            self._instant_ns = now_ns + STEP_NS
            self._instants.append((record.stamp_ns, now_ns))

    def read(self) -> Readings:
        """See `Part`."""
        readings = super().read()
        readings |= {
            "cloudrc_clouds_admitted_total": plain(self._admitted),
            "cloudrc_sessions_refused_total": plain(self._counts.get("busy", 0)),
            "cloudrc_command_age_seconds": self._command_age,
            "cloudrc_guard_state": plain(self._guard),
            "cloudrc_guard_transitions_total": by(self._changes),
            "cloudrc_guard_limited_total": by(
                {limit: self._counts.get(f"limited_{limit}", 0) for limit in LIMITS}
            ),
            "cloudrc_guard_held_seconds_total": plain(self._counts.get("held_seconds", 0)),
            "cloudrc_guard_starts_refused_total": plain(self._counts.get("start_refused", 0)),
            "cloudrc_contacts_total": by(self._contacts),
            "cloudrc_world_slip_seconds_total": plain(self._slip_ns * 1e-9),
            "cloudrc_world_stalls_total": plain(self._counts.get("stalls", 0)),
        }
        if self._truth is not None:
            readings["cloudrc_position_meters"] = per_axis(self._truth.odometry.position)
            readings["cloudrc_tip_force_newtons"] = plain(self._truth.tip_force)
        factor = self._real_time_factor()
        if factor is not None:
            readings["cloudrc_real_time_factor"] = plain(factor)
        return readings

    def _real_time_factor(self) -> float | None:
        instants = list(self._instants)
        if len(instants) < 2:
            return None
        (world_ns, machine_ns), (world_end_ns, machine_end_ns) = instants[0], instants[-1]
        return (world_end_ns - world_ns) / (machine_end_ns - machine_ns)
