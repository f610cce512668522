"""What both ends of the tunnel expose: session, datagrams, one-way delay, how the loop keeps up."""

from __future__ import annotations

from math import nan

from cloudrc.exposition.check import Check
from cloudrc.exposition.histogram import Histogram
from cloudrc.exposition.labels import (
    DELAY_BUCKETS,
    DIRECTIONS,
    GAP_BUCKETS,
    LATENESS_BUCKETS,
    ONLY_CLOUD,
    ONLY_WORLD,
    OUTCOMES,
    PERIOD_BUCKETS,
    Labels,
)
from cloudrc.exposition.part import Handlers, Readings, chosen, plain
from cloudrc.exposition.streams import Stream
from cloudrc.messages import NEVER_NS
from cloudrc.records import Arrival, Counted, Fault, Lateness, LinkChecked, SessionOpened

CLOCK_SET = "wall_clock"
"""Code of the fault that tells that the wall clock was set; see `cloudrc.drivers.wall_clock`."""
SILENCE_NS = 2_000_000_000
"""An end that has heard nothing for so long has no peer [ns]."""


class End:
    """World or cloud; the incoming direction is the one that it hears.

    Attributes:
        check: The standing check of that direction.
    """

    def __init__(self, incoming: str, outgoing: str) -> None:
        """Begin before the first session; the directions are "uplink" and "downlink"."""
        self._incoming, self._outgoing = incoming, outgoing
        others = ONLY_CLOUD if incoming == DIRECTIONS[1] else ONLY_WORLD
        self._outcomes = tuple(name for name in OUTCOMES[1:] if name not in others)
        self._counts: dict[str, int] = {}
        self._stream = Stream()
        self.check = Check(incoming)
        self._one_way, self._age = Histogram(DELAY_BUCKETS), Histogram(DELAY_BUCKETS)
        self._gap = Histogram(GAP_BUCKETS)
        self._period, self._lateness = Histogram(PERIOD_BUCKETS), Histogram(LATENESS_BUCKETS)
        self._busy = 0.0
        self._clock_steps = 0
        self._sessions, self._epoch, self._opened_ns = 0, 0, NEVER_NS
        self._heard_ns = self._woke_ns = self._deadline_ns = NEVER_NS
        self._silent = True  # no telemetry or command has arrived in this session
        # What the newest datagram used tells about the age of what this end knows.
        self._newest_ns, self._newest_delay = NEVER_NS, nan

    def handlers(self) -> Handlers:
        """See `Part`."""
        return {
            Arrival: self._see_arrival,
            Counted: self._see_count,
            Fault: self._see_fault,
            Lateness: self._see_wake,
            SessionOpened: self._see_session,
            LinkChecked: self.check.see,
        }

    @property
    def has_peer(self) -> bool:
        """Whether the other end has been heard within 2 s."""
        return self._opened_ns != NEVER_NS and self._woke_ns - self._heard_ns < SILENCE_NS

    def _see_arrival(self, record: Arrival) -> None:
        stamp_ns, _, epoch, counter, delay, used = record
        if self._stream.take(epoch, counter):  # those that are repeated anybody can send
            if not self._silent:
                self._gap.observe((stamp_ns - self._heard_ns) * 1e-9)
            self._heard_ns, self._silent = stamp_ns, False
        if delay == delay:  # not NaN: both ends share a clock
            self._one_way.observe(delay)
        if used:
            self._newest_ns, self._newest_delay = stamp_ns, delay

    def _see_count(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def _see_fault(self, record: Fault) -> None:
        self._clock_steps += record.code == CLOCK_SET

    def _see_session(self, record: SessionOpened) -> None:
        self._sessions += 1
        self._epoch = record.epoch
        self._opened_ns = self._heard_ns = record.stamp_ns
        self._silent = True
        self._newest_delay = nan

    def _see_wake(self, record: Lateness) -> None:
        stamp_ns, _, lateness, busy, slip_ns = record
        now_ns = stamp_ns + slip_ns
        if self._deadline_ns != NEVER_NS:
            self._period.observe((now_ns - self._deadline_ns) * 1e-9)
        self._deadline_ns, self._woke_ns = now_ns, stamp_ns
        self._lateness.observe(lateness)
        self._busy += busy

    def _see_age(self, now_ns: int) -> None:
        """Once per period: how old what this end knows is now [ns, own clock]."""
        delay = self._newest_delay
        if delay == delay:
            self._age.observe(delay + (now_ns - self._newest_ns) * 1e-9)

    def read(self) -> Readings:
        """See `Part`."""
        counts, stream, incoming = self._counts, self._stream, (self._incoming,)
        received = chosen(self._outcomes, counts)
        datagrams: dict[Labels, float] = {(*incoming, name): n for name, n in received.items()}
        datagrams[self._outgoing, "sent"] = counts.get("sent", 0)
        readings: Readings = self.check.read() | {
            "cloudrc_session_epoch": plain(self._epoch),
            "cloudrc_sessions_opened_total": plain(self._sessions),
            "cloudrc_datagrams_total": datagrams,
            "cloudrc_datagrams_expected_total": {incoming: stream.expected},
            "cloudrc_datagrams_lost_total": {incoming: stream.lost},
            "cloudrc_datagrams_reordered_total": {incoming: stream.reordered},
            "cloudrc_link_gap_seconds": self._gap,
            "cloudrc_loop_period_seconds": self._period,
            "cloudrc_loop_lateness_seconds": self._lateness,
            "cloudrc_loop_busy_seconds_total": plain(self._busy),
            "cloudrc_clock_steps_total": plain(self._clock_steps),
            "cloudrc_recorder_dropped_records_total": plain(counts.get("recorder_dropped", 0)),
        }
        if self._one_way.cumulative()[-1]:  # a delay that nobody can know is absent, never zero
            readings[f"cloudrc_{self._incoming}_delay_seconds"] = self._one_way
            readings["cloudrc_age_of_information_seconds"] = self._age
        return readings
