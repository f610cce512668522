# SPDX-License-Identifier: Apache-2.0

"""Judge link, cloud and robot by cloud's records, for `/diagnostics`."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import isnan, nan
from statistics import fmean

from cloudrc.results.metrics.definitions import DatagramTally, age
from cloudrc.results.record.live import ERROR, OK, STALE, WARN, HealthStatus
from cloudrc.wire.messages import NEVER_NS, GuardState, Telemetry
from cloudrc.wire.records import Arrival, Control, Counted, Lateness, Record, TelemetrySent

WINDOW_NS = 5_000_000_000
"""Time over which delays, loss and lateness are taken [ns]."""
SILENCE = 0.5
"""Age of the newest telemetry above which the robot's state is unknown [s]."""
MISSED_MAX = 5
"""Number of periods that cloud may miss between two reports."""
LEVELS = {GuardState.GROUND: OK, GuardState.TRACK: OK, GuardState.HOLD: WARN}
"""State of the guard -> level; that of all others is ERROR."""
UNKNOWN = "unknown"


class FlightHealth:
    """What cloud's records of the last seconds say about the flight."""

    def __init__(self) -> None:
        self._telemetry: Telemetry | None = None
        self._control: Control | None = None
        self._arrivals: deque[Arrival] = deque()
        self._lateness: deque[Lateness] = deque()
        self._missed = self._missed_before = self._dropped_before = 0

    def take(self, record: Record) -> None:
        """Add a record."""
        if isinstance(record, TelemetrySent):
            self._telemetry = record.telemetry
        elif isinstance(record, Arrival):
            self._arrivals.append(record)
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
        telemetry = self._telemetry
        if telemetry is None:
            return HealthStatus(STALE, "robot", "no telemetry yet", {})
        silence = age(now_ns, telemetry.stamp_ns + telemetry.slip_ns)
        has_command = telemetry.echo_stamp_ns != NEVER_NS
        values = {
            "guard": telemetry.guard.name,
            "cause": telemetry.cause.words,
            "telemetry age": _time(silence),
            "command age": _time(telemetry.echo_hold_ns * 1e-9 if has_command else nan),
        }
        if silence > SILENCE:
            return HealthStatus(STALE, "robot", f"no telemetry for {silence:.1f} s", values)
        level = LEVELS.get(telemetry.guard, ERROR)
        text = f"{telemetry.guard.name}: {telemetry.cause.words}"
        return HealthStatus(level, "robot", text, values)

    def _link(self, now_ns: int) -> HealthStatus:
        arrivals, tally = self._arrivals, DatagramTally()
        if not arrivals or age(now_ns, arrivals[-1].stamp_ns) > SILENCE:
            return HealthStatus(ERROR, "link", "no telemetry arrives", {})
        for each in arrivals:
            tally.take(each.epoch, each.counter)
        loss = f"{tally.lost / tally.expected * 100.0:.1f} %" if tally.expected else UNKNOWN
        values = _times("uplink delay", [each.delay for each in arrivals])
        values["uplink loss"] = loss
        if self._control is not None:
            values["round trip"] = _time(self._control.rtt)
            values["loop delay"] = _time(self._control.loop_delay)
        text = f"delay {values['uplink delay, mean']}, loss {loss}"
        return HealthStatus(OK, "link", text, values)

    def _cloud(self, dropped: int) -> HealthStatus:
        values = _times("lateness", [each.lateness for each in self._lateness])
        values |= {"missed periods": str(self._missed), "records dropped": str(dropped)}
        level, text = OK, f"lateness {values['lateness, mean']}"
        if dropped > self._dropped_before:
            level, text = WARN, "this bridge is too slow: records were dropped"
        if self._missed - self._missed_before > MISSED_MAX:
            level, text = WARN, "cloud misses periods"
        self._missed_before, self._dropped_before = self._missed, dropped
        return HealthStatus(level, "cloud", text, values)


def _times(name: str, times: Sequence[float]) -> dict[str, str]:
    """Return mean and maximum of times [s], of which NaN is unknown."""
    known = [time for time in times if not isnan(time)] or [nan]
    return {f"{name}, mean": _time(fmean(known)), f"{name}, max": _time(max(known))}


def _time(seconds: float) -> str:
    return UNKNOWN if isnan(seconds) else f"{seconds * 1e3:.1f} ms"
