"""Judge link, cloud and robot by cloud's records, for `/diagnostics`."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from math import isnan
from statistics import fmean

from cloudrc.messages import NEVER_NS, GuardState, Telemetry
from cloudrc.metrics.definitions import DatagramTally, age
from cloudrc.record.live import ERROR, OK, STALE, WARN, HealthStatus
from cloudrc.records import Arrival, Control, Counted, Lateness, Record, TelemetrySent

WINDOW_NS = 5_000_000_000
"""Time over which delays and lateness are taken [ns]."""
REPORTS = 5
"""Number of reports over which the loss is taken."""
SILENCE = 0.5
"""Age of the newest telemetry above which the robot's state is unknown [s]."""
MISSED_MAX = 5
"""Number of periods that cloud may miss between two reports."""
LEVELS = {GuardState.GROUND: OK, GuardState.TRACK: OK, GuardState.HOLD: WARN}
"""State of the guard -> level; that of all others is ERROR."""
UNKNOWN = "unknown"


class FlightHealth:
    """What cloud's records of the last seconds say about the flight.

    Attributes:
        telemetry: The newest telemetry; None before the first.
    """

    def __init__(self) -> None:
        self.telemetry: Telemetry | None = None
        self._arrivals: deque[Arrival] = deque()
        self._tally = DatagramTally()
        # Lost and expected datagrams at the last reports.
        self._counted: deque[tuple[int, int]] = deque([(0, 0)], REPORTS + 1)
        self._lateness: deque[Lateness] = deque()
        self._control: Control | None = None
        self._missed = self._missed_before = self._dropped_before = 0

    def take(self, record: Record) -> None:
        """Add a record."""
        if isinstance(record, TelemetrySent):
            self.telemetry = record.telemetry
        elif isinstance(record, Arrival):
            self._arrivals.append(record)
            self._tally.take(record.epoch, record.counter)
        elif isinstance(record, Lateness):
            self._lateness.append(record)
        elif isinstance(record, Control):
            self._control = record
        elif isinstance(record, Counted) and record.name == "missed_periods":
            self._missed = record.total

    def report(self, now_ns: int, dropped: int) -> list[HealthStatus]:
        """Return the health of robot, link and cloud at `now_ns` [ns], cloud's clock.

        `dropped` is the number of records that did not arrive here.
        """
        for recent in (self._arrivals, self._lateness):
            while recent and now_ns - recent[0].stamp_ns > WINDOW_NS:
                recent.popleft()
        return [self._robot(now_ns), self._link(now_ns), self._cloud(dropped)]

    def _robot(self, now_ns: int) -> HealthStatus:
        telemetry = self.telemetry
        if telemetry is None:
            return HealthStatus(STALE, "robot", "no telemetry yet", {})
        silence = age(now_ns, telemetry.stamp_ns + telemetry.slip_ns)
        has_command = telemetry.echo_stamp_ns != NEVER_NS
        values = {
            "guard": telemetry.guard.name,
            "cause": telemetry.cause.words,
            "telemetry age": _time(silence),
            "command age": _time(telemetry.echo_hold_ns * 1e-9) if has_command else UNKNOWN,
        }
        if silence > SILENCE:
            return HealthStatus(STALE, "robot", f"no telemetry for {silence:.1f} s", values)
        level = LEVELS.get(telemetry.guard, ERROR)
        text = f"{telemetry.guard.name}: {telemetry.cause.words}"
        return HealthStatus(level, "robot", text, values)

    def _link(self, now_ns: int) -> HealthStatus:
        self._counted.append((self._tally.lost, self._tally.expected))
        if not self._arrivals or age(now_ns, self._arrivals[-1].stamp_ns) > SILENCE:
            return HealthStatus(ERROR, "link", "no telemetry arrives", {})
        (lost, expected), (lost_now, expected_now) = self._counted[0], self._counted[-1]
        loss = UNKNOWN
        if expected_now > expected:
            loss = f"{(lost_now - lost) / (expected_now - expected) * 100.0:.1f} %"
        delays = [each.delay for each in self._arrivals if not isnan(each.delay)]
        values = {
            "uplink delay, mean": _mean(delays),
            "uplink delay, max": _most(delays),
            "uplink loss": loss,
        }
        if self._control is not None:
            values["round trip"] = _time(self._control.rtt)
            values["loop delay"] = _time(self._control.loop_delay)
        text = f"delay {values['uplink delay, mean']}, loss {loss}"
        return HealthStatus(OK, "link", text, values)

    def _cloud(self, dropped: int) -> HealthStatus:
        lateness = [each.lateness for each in self._lateness]
        values = {
            "lateness, mean": _mean(lateness),
            "lateness, max": _most(lateness),
            "missed periods": str(self._missed),
            "records dropped": str(dropped),
        }
        level, text = OK, f"lateness {values['lateness, mean']}"
        if dropped > self._dropped_before:
            level, text = WARN, "this bridge is too slow: records were dropped"
        if self._missed - self._missed_before > MISSED_MAX:
            level, text = WARN, "cloud misses periods"
        self._missed_before, self._dropped_before = self._missed, dropped
        return HealthStatus(level, "cloud", text, values)


def _mean(times: Iterable[float]) -> str:
    known = [*times]
    return _time(fmean(known)) if known else UNKNOWN


def _most(times: Iterable[float]) -> str:
    known = [*times]
    return _time(max(known)) if known else UNKNOWN


def _time(seconds: float) -> str:
    return UNKNOWN if isnan(seconds) else f"{seconds * 1e3:.1f} ms"
