"""Progress of a flight: a status line on a terminal, one line per event elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from typing import TextIO

from rich.live import Live
from rich.text import Text

from cloudrc.cli.output import console, escape, is_live
from cloudrc.drivers.process import in_words
from cloudrc.messages import NEVER_NS, GuardState, Vector
from cloudrc.records import (
    Control,
    Fault,
    GuardChange,
    LinkChanged,
    MissionEvent,
    Record,
    TelemetrySent,
)

ENDINGS = ("done", "cancelled", "timed_out")
REDRAW_PERIOD = 0.1
"""Minimum time between two drawings of the status line [s]."""
FILE_COLUMNS = 100
"""Maximum width of an event's line with its position."""


class FlightView:
    """Show a flight on a stream, as a status line and one line per event."""

    def __init__(
        self, stream: TextIO, waypoints: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start without writing anything.

        Args:
            stream: Where to write; never stdout if that carries JSON or YAML.
            waypoints: Number of the mission's waypoints.
            clock: Returns the monotonic time [s].
        """
        self._waypoints, self._clock = waypoints, clock
        self._console = console(stream)
        self._status: Live | None = None
        if is_live(stream):
            self._status = Live(console=self._console, transient=True, auto_refresh=False)
        self._first_ns = self._now_ns = NEVER_NS
        self._began = self._drawn = clock()
        self._position: Vector = (math.nan, math.nan, math.nan)
        self._delay, self._waypoint = math.nan, -1
        self._guard, self._ended = GuardState.GROUND, False

    def see(self, records: Iterable[Record]) -> None:
        """Process records of world or cloud, oldest first."""
        for record in records:
            match record:
                case TelemetrySent():
                    if self._first_ns == NEVER_NS:
                        self._first_ns, self._began = record.stamp_ns, self._clock()
                    self._now_ns = record.stamp_ns
                    self._position = record.telemetry.odometry.position
                case Control():
                    # The horizon is 0 and meaningless before the first round trip.
                    self._delay = math.nan if math.isnan(record.rtt) else record.horizon
                    self._waypoint = record.waypoint
                case GuardChange():
                    self._guard = record.state
                    # The robot always holds after its mission; that is no event.
                    if record.state > GuardState.TRACK and not self._ended:
                        self._event(f"{record.state.name}: {record.cause}")
                case Fault():
                    self._event(record.text)
                case LinkChanged():
                    self._event(in_words(record))
                case MissionEvent():
                    self._ended = record.event in ENDINGS
                    self._event(record.text)
        if self._status and self._clock() - self._drawn >= REDRAW_PERIOD:
            self._drawn = self._clock()
            self._status.start()
            self._status.update(self.line(), refresh=True)

    def line(self) -> Text:
        """Return the status line; a narrow terminal cuts off its end, the least important part."""
        elapsed, flown = self._clock() - self._began, (self._now_ns - self._first_ns) * 1e-9
        number = self._waypoint + 1
        cells = (
            f"{flown:6.1f} s",
            f"{self._guard.name:<6}",
            f"waypoint {number}/{self._waypoints}" if number else "",
            self._position_text(),
            self._delay_text(),
            f"x{flown / elapsed:.2f}" if elapsed > 0 and flown > 0 else "",
        )
        line = Text(_joined(cells), no_wrap=True, overflow="crop")
        colour = "green" if self._guard == GuardState.TRACK else "yellow"
        line.highlight_words([self._guard.name], colour)
        return line

    def _position_text(self) -> str:
        # Round first, then add 0.0: that turns a negative zero into a positive one.
        x, y, z = (round(coordinate, 2) + 0.0 for coordinate in self._position)
        return "" if math.isnan(x) else f"({x:5.2f}, {y:5.2f}, {z:4.2f}) m"

    def _delay_text(self) -> str:
        return "" if math.isnan(self._delay) else f"delay {self._delay * 1e3:3.0f} ms"

    def _event(self, text: str) -> None:
        """Write the line of an event, with position and delay if there is room."""
        line = f"  {escape(text)}"
        for cells in ((self._position_text(), self._delay_text()), (self._position_text(),)):
            longer = _joined((f"{line:<46}", *cells))
            if len(longer) <= min(self._console.width, FILE_COLUMNS):
                line = longer
                break
        self._console.print(Text(line))

    def close(self) -> None:
        """Erase the status line."""
        if self._status:
            self._status.stop()


def _joined(cells: Iterable[str]) -> str:
    return "  ".join(cell for cell in cells if cell).rstrip()
