"""Show the progress of a flight or of a sweep; on a terminal, in a status line."""

from __future__ import annotations

import math
from collections.abc import Iterable
from threading import Timer
from time import monotonic
from typing import TYPE_CHECKING, TextIO

from rich.console import Console
from rich.live import Live
from rich.text import Text

from cloudrc.cli.output import is_live, print_or_drop
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
from cloudrc.text import escape

if TYPE_CHECKING:
    from cloudrc.runs.flight import Row

ENDINGS = ("done", "cancelled", "timed_out")
FIRST_WAIT = 3.0
"""Time from the first result to the first line of progress on a stream that is no terminal [s]."""
FLIGHTS_PERIOD, CHECK_PERIOD = 30.0, 10.0
"""Time between two further lines [s]: while flights are flown, and while points are checked."""
REPORT_AFTER = 1.0
"""Time without a record after the end of a mission, from which on the report is written [s]."""
PLAN_WAIT = 1.0
"""Time after which the check of a sweep, or a report, shows its progress [s]."""


class FlightView:
    """Prints the events of a flight to a stream and, on a terminal, updates a status line.

    All times are those of the report: since the mission's start, on world's clock.
    """

    def __init__(self, stream: TextIO, waypoints: int, unit: str = "waypoint") -> None:
        """Set the stream and the number of waypoints (0: unknown); show a status line at once.

        `unit` is what the mission counts; "": nothing.
        """
        self._stream, self._waypoints, self._unit = stream, waypoints, unit
        self._first_ns = self._now_ns = self._start_ns = NEVER_NS
        self._mission = 0  # number of the mission in the newest telemetry
        self._began = self._seen = monotonic()
        self._position: Vector = (math.nan, math.nan, math.nan)
        self._delay, self._waypoint = math.nan, -1
        self._guard, self._ended = GuardState.GROUND, False
        self._status: Live | None = None
        if is_live(stream):
            terminal = Console(file=stream)
            self._status = Live(console=terminal, transient=True, get_renderable=self.line)
            self._status.start(refresh=True)  # now: the preparation takes a second

    def see(self, records: Iterable[Record]) -> None:
        """Show new records of world or cloud, in the order of time."""
        for record in records:
            match record:
                case TelemetrySent():
                    self._see_telemetry(record)
                case Control():
                    # The horizon is 0 and meaningless before the first round trip.
                    self._delay = math.nan if math.isnan(record.rtt) else record.horizon
                    self._waypoint = record.waypoint
                case GuardChange():
                    self._see_guard(record)
                case MissionEvent():
                    self._ended = record.event in ENDINGS
                    self._event(record.text, record.stamp_ns)
                case Fault() | LinkChanged():
                    self._event(in_words(record), record.stamp_ns)

    def _see_telemetry(self, record: TelemetrySent) -> None:
        if self._first_ns == NEVER_NS:
            self._first_ns, self._began = record.stamp_ns, monotonic()
        if record.telemetry.mission_id != self._mission:
            self._mission, self._start_ns = record.telemetry.mission_id, record.stamp_ns
        self._now_ns, self._seen = record.stamp_ns, monotonic()
        self._position = record.telemetry.odometry.position

    def _see_guard(self, record: GuardChange) -> None:
        self._guard = record.state
        # The robot holds its position after every mission: do not print this.
        is_usual = self._ended and record.state is GuardState.HOLD
        if record.state > GuardState.TRACK and not is_usual:
            self._event(f"{record.state.name}: {record.cause}", record.stamp_ns)
        if record.state > GuardState.HOLD and not self._waypoints:
            self.say("  to fly again, find the cause, then: cloudrc mission acknowledge")

    def line(self) -> Text:
        """Return the status line; it ends with the least important part, which may be cropped."""
        if self._ended and monotonic() - self._seen > REPORT_AFTER:
            return Text("the mission is over: writes the report")
        elapsed, flown = self._seen - self._began, (self._now_ns - self._first_ns) * 1e-9
        since = self._now_ns - self._start_ns if self._start_ns != NEVER_NS else 0
        cells = (
            f"{since * 1e-9:6.1f} s",
            f"{self._guard.name:<6}",
            self._leg(),
            self._place(),
            "" if math.isnan(self._delay) else f"delay {self._delay * 1e3:3.0f} ms",
            f"x{flown / elapsed:.2f}" if elapsed > 0 and flown > 0 else "",
        )
        line = Text(_joined(cells), no_wrap=True, overflow="crop")
        colour = "green" if self._guard == GuardState.TRACK else "yellow"
        line.highlight_words([self._guard.name], colour)
        return line

    def _leg(self) -> str:
        number = self._waypoint + 1
        if not (number and self._unit):
            return ""
        return f"{self._unit} {number}{f'/{self._waypoints}' * bool(self._waypoints)}"

    def _place(self) -> str:
        # Round first, then add 0.0: that turns a negative zero into a positive one.
        x, y, z = (round(coordinate, 2) + 0.0 for coordinate in self._position)
        return "" if math.isnan(x) else f"({x:5.2f}, {y:5.2f}, {z:4.2f}) m"

    def _event(self, text: str, stamp_ns: int) -> None:
        since = (stamp_ns - self._start_ns) * 1e-9
        time = " " * 9 if self._start_ns == NEVER_NS else f"{since:7.2f} s"
        self.say(_joined((time, f"{escape(text):<44}", self._place())))

    def say(self, line: str) -> None:
        """Print a line above the status line."""
        if self._status:
            self._status.console.print(Text(line))
        else:
            print_or_drop(line, self._stream)

    def close(self) -> None:
        """Erase the status line."""
        if self._status:
            self._status.stop()


def _joined(cells: Iterable[str]) -> str:
    return "  ".join(cell for cell in cells if cell).rstrip()


class CountView:
    """Shows how much of a long work is done: on a terminal in a status line, else in some lines."""

    def __init__(self, stream: TextIO, total: int, unit: str, period: float) -> None:
        """Set the amount of work `total` and its `unit`, such as "flights".

        If the stream is no terminal, print a line `FIRST_WAIT` after the first result, and then
        every `period` [s]. The rate counts from the first result: workers take seconds to start.
        """
        self._stream, self._total, self._unit, self._period = stream, total, unit, period
        self._began, self._at_first, self._next = math.nan, 0, math.inf
        self._status = Console(file=stream).status(f"0/{total}") if is_live(stream) else None
        if self._status:
            self._status.start()

    def count(self, done: int, more: str = "") -> None:
        """Show that `done` pieces of work are done; `more` ends the line."""
        now = monotonic()
        if math.isnan(self._began):
            self._began, self._at_first, self._next = now, done, now + FIRST_WAIT
        rate = (done - self._at_first) / max(now - self._began, 1e-3)
        line = f"{done}/{self._total}"
        if rate > 0.0:
            left = (self._total - done) / rate
            time = f"{left:.0f} s" if left < 120 else f"{left / 60:.0f} min"
            line += f"  {rate:.1f} {self._unit}/s, {time} left"
        line += more
        if self._status:
            self._status.update(line)
        elif now >= self._next:
            self._next = now + self._period
            print_or_drop(line, self._stream)

    def close(self) -> None:
        """Erase the status line on a terminal."""
        if self._status:
            self._status.stop()


class PlanView:
    """Shows how many points of a sweep are checked, if that takes longer than a second."""

    def __init__(self, stream: TextIO) -> None:
        """Print nothing yet."""
        self._stream, self._view = stream, list[CountView]()
        self._began = monotonic()

    def see(self, done: int, points: int, seeds: int) -> None:
        """Show that `done` points of a sweep are checked."""
        if monotonic() - self._began < PLAN_WAIT or done == points:
            return
        if not self._view:
            text = f"checks {points:,} points x {seeds:,} seeds: {points * seeds:,} flights"
            print_or_drop(text, self._stream)
            self._view.append(CountView(self._stream, points, "points", CHECK_PERIOD))
        self._view[0].count(done)

    def close(self) -> None:
        """Erase the status line on a terminal."""
        for view in self._view:
            view.close()


class StepView:
    """Shows the present step of a command: on a terminal in a status line, else in one line.

    Nothing is shown before `PLAN_WAIT` on a terminal, or `FIRST_WAIT` on another stream.
    """

    def __init__(self, stream: TextIO, step: str) -> None:
        """Set the stream and the first step, such as "reads the recording"."""
        self._stream, self._step = stream, step
        self._status = Console(file=stream).status(Text(escape(step))) if is_live(stream) else None
        self._timer = Timer(PLAN_WAIT if self._status else FIRST_WAIT, self._begin)
        self._timer.daemon = True
        self._timer.start()

    def _begin(self) -> None:
        if self._status:
            self._status.start()
        else:
            print_or_drop(escape(self._step), self._stream)

    def tell(self, step: str) -> None:
        """Set the next step."""
        self._step = step
        if self._status:
            self._status.update(Text(escape(step)))

    def close(self) -> None:
        """Erase the status line on a terminal."""
        self._timer.cancel()
        self._timer.join()
        if self._status:
            self._status.stop()


class SweepView(CountView):
    """Shows how many flights are done: on a terminal in a status line, else in a line per 30 s."""

    def __init__(self, stream: TextIO, head: str, total: int) -> None:
        """Print the headline `head`; set `total`, the number of flights to fly."""
        print_or_drop(escape(head), stream)
        super().__init__(stream, total, "flights", FLIGHTS_PERIOD)
        self._done, self._failed, self._told = 0, 0, set[str]()

    def see(self, row: Row) -> None:
        """Count a finished flight; print its failure if it is the first of its verdict.

        Print why a metric has no value once per text.
        """
        self._done += 1
        self._failed += row["verdict"] != "success"
        kind = row["verdict"] if row["failures"] else row["text"]
        if row["text"] and kind not in self._told:
            self._told.add(kind)
            text = f"{row['key']}: {row['verdict']}: {row['text']}"
            print_or_drop(escape(text), self._stream)
        self.count(self._done, f", {self._failed} failed" if self._failed else "")


class SeedsView:
    """Prints a line per flight with its seed, its verdict and why it failed."""

    def __init__(self, stream: TextIO, head: str, total: int) -> None:
        """Print the headline `head`; set `total`, the number of flights to fly."""
        print_or_drop(escape(head), stream)
        self._stream, self._total = stream, total
        self._done, self._told = 0, set[str]()

    def see(self, row: Row) -> None:
        """Print the line of a finished flight; say why a metric has no value once per text."""
        self._done += 1
        count = f"{self._done}/{self._total}"
        line = f"{count:>7}  seed {row['seed']}  {row['verdict']}"
        if row["failures"] or row["text"] not in ("", *self._told):
            line += f": {row['text']}"
        self._told.add(row["text"])
        print_or_drop(escape(line), self._stream)

    def close(self) -> None:
        """Do nothing: each line is final."""
