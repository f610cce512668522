"""Progress of a flight: a status line on a terminal, one line per event elsewhere."""

from __future__ import annotations

import math
import textwrap
import time
from collections.abc import Callable, Iterable
from typing import TextIO

from rich.live import Live
from rich.text import Text

from cloudrc.cli.output import console, escape, is_live
from cloudrc.drivers.feed import in_words
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
"""Maximum width of an event's line where there is no terminal."""
DROPPED = ("factor", "delay", "position", "waypoint")
"""Cells that the status line drops, in this order, until the line fits."""


class FlightView:
    """Show a flight on a stream, as a status line and one line per event."""

    def __init__(
        self, stream: TextIO, waypoints: int, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start without writing anything.

        Args:
            stream: Where to write; never stdout if that carries JSON or YAML.
            waypoints: Number of the mission's waypoints.
            clock: Returns the monotonic time [s], for the real-time factor and for redrawing.
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
            # Leave one column free: some terminals wrap after the last one.
            self._status.update(self.line(self._console.width - 1), refresh=True)

    def line(self, width: int = 80) -> Text:
        """Return the status line, at most `width` columns wide."""
        elapsed, flown = self._clock() - self._began, (self._now_ns - self._first_ns) * 1e-9
        number = self._waypoint + 1
        cells = {
            "time": f"{flown:6.1f} s",
            "waypoint": f"waypoint {number}/{self._waypoints}" if number else "",
            "position": self._position_text(),
            "delay": self._delay_text(),
            "guard": f"{self._guard.name:<6}",
            "factor": f"x{flown / elapsed:.2f}" if elapsed > 0 and flown > 0 else "",
        }
        for name in DROPPED:
            if len(_joined(cells.values())) > width:
                cells[name] = ""
        line = Text(_joined(cells.values())[:width])
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
        text = escape(text)
        width = self._console.width if self._status else FILE_COLUMNS
        cells = [f"  {text:<44}", self._position_text(), self._delay_text()]
        lines = [_joined(cells), _joined(cells[:2]), f"  {text}"]
        line = next((line for line in lines if len(line) <= width), lines[-1])
        if self._status and len(line) > width:
            line = textwrap.fill(line, width, subsequent_indent="    ", break_on_hyphens=False)
        self._console.print(Text(line), soft_wrap=True)

    def close(self) -> None:
        """Erase the status line."""
        if self._status:
            self._status.stop()


def _joined(cells: Iterable[str]) -> str:
    return "  ".join(cell for cell in cells if cell).rstrip()
