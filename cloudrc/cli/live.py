"""What a flight shows while it lasts: records come in, a living line or plain lines go out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from typing import TextIO

from cloudrc.cli.output import is_live, paint
from cloudrc.messages import NEVER_NS, GuardState, Vector
from cloudrc.records import Control, Fault, GuardChange, MissionEvent, Record, TelemetrySent

ENDINGS = ("done", "cancelled", "timed_out")
REDRAW_PERIOD = 0.1  # [s]: faster than one can read, slow enough to cost nothing


class FlightView:
    """Shows a flight on a stream: a line that is rewritten, or one line per event."""

    def __init__(
        self, stream: TextIO, waypoints: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin with nothing on the stream.

        Args:
            stream: Where to write; never stdout of a machine-readable output.
            waypoints: How many the mission has.
            clock: Rising seconds; for the real-time factor and the rate of redrawing [s].
        """
        self._stream, self._waypoints, self._clock = stream, waypoints, clock
        self._live = is_live(stream)
        self._first_ns = self._now_ns = NEVER_NS
        self._began = self._drawn = clock()
        self._position: Vector = (math.nan, math.nan, math.nan)
        self._delay, self._waypoint = math.nan, -1
        self._guard, self._ended = GuardState.GROUND, False

    def see(self, records: Iterable[Record]) -> None:
        """Take in records of either end, oldest first."""
        for record in records:
            match record:
                case TelemetrySent():
                    self._see_telemetry(record)
                case Control():
                    self._delay, self._waypoint = record.horizon, record.waypoint
                case GuardChange():
                    self._guard = record.state
                    # That the robot holds once its mission has ended is no news.
                    if record.state > GuardState.TRACK and not self._ended:
                        self._event(f"{record.state.name}: {record.cause}")
                case Fault():
                    self._event(record.text)
                case MissionEvent():
                    self._ended = record.event in ENDINGS
                    self._event(record.text)
        if self._live and self._clock() - self._drawn >= REDRAW_PERIOD:
            self._drawn = self._clock()
            self._stream.write("\r\x1b[2K" + self.line())
            self._stream.flush()

    def _see_telemetry(self, record: TelemetrySent) -> None:
        if self._first_ns == NEVER_NS:
            self._first_ns, self._began = record.stamp_ns, self._clock()
        self._now_ns = record.stamp_ns
        self._position = record.telemetry.odometry.position

    @property
    def flown(self) -> float:
        """Time since the first telemetry [s], world's clock."""
        return (self._now_ns - self._first_ns) * 1e-9

    def line(self) -> str:
        """Say in one line of at most 80 columns how the flight goes."""
        elapsed = self._clock() - self._began
        factor = f"x{self.flown / elapsed:.3g}" if elapsed > 0 and self.flown > 0 else ""
        colour = "green" if self._guard == GuardState.TRACK else "yellow"
        guard = paint(f"{self._guard.name:<6}", colour, self._stream)
        return (
            f"{self.flown:6.1f} s  waypoint {self._waypoint + 1}/{self._waypoints}"
            f"  {self._where()}  {guard} {factor}"
        )

    def _where(self) -> str:
        x, y, z = self._position
        if math.isnan(x):
            return ""
        late = "" if math.isnan(self._delay) else f"  delay {self._delay * 1e3:3.0f} ms"
        return f"({x:5.2f}, {y:5.2f}, {z:4.2f}) m{late}"

    def _event(self, text: str) -> None:
        if self._live:
            self._stream.write("\r\x1b[2K")
        self._stream.write(f"  {text:<45}{self._where()}\n")
        self._stream.flush()

    def close(self) -> None:
        """Take the living line away."""
        if self._live:
            self._stream.write("\r\x1b[2K")
            self._stream.flush()
