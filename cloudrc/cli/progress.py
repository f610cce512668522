"""Show what a long command does: on a terminal in a moving line, else in a line every 10 s."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable
from threading import Event, Lock, Thread
from time import monotonic
from typing import TYPE_CHECKING, TextIO

from rich.console import Console
from rich.live import Live
from rich.spinner import Spinner
from rich.text import Text

from cloudrc.cli.output import is_live, print_or_drop
from cloudrc.drivers.process import in_words
from cloudrc.messages import NEVER_NS, GuardState, Vector
from cloudrc.records import (
    CONTROLLER_LOST,
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
FIRST_WAIT, PERIOD = 3.0, 10.0
"""Time to the first line on a stream that is no terminal, and from one line to the next [s]."""
STEP_WAIT = 1.0
"""Time after which a terminal shows the step of a command, or the check of a sweep [s]."""


class StatusLine:
    """Shows one line about a work until it is closed: a terminal or a log is never silent.

    On a terminal the line moves. On another stream it is printed `FIRST_WAIT` after the beginning,
    and then whenever nothing was printed for `PERIOD`.
    """

    def __init__(
        self,
        stream: TextIO,
        line: Callable[[], str | Text],
        wait: float = 0.0,
        *,
        in_logs: bool = True,
    ) -> None:
        """Set the stream and the function that returns the line.

        A terminal shows the line after `wait` [s]. Without `in_logs`, other streams
        get it after `begin_log`.
        """
        self._stream, self._line, self._wait = stream, line, wait
        self._began, self._quiet_since = monotonic(), monotonic() - PERIOD
        self._closed, self._printing = Event(), Lock()
        self._live: Live | None = None
        self._thread: Thread | None = None
        if is_live(stream):
            self._spinner = Spinner("dots")
            terminal = Console(file=stream)
            self._live = Live(
                console=terminal,
                transient=True,
                get_renderable=self._moving,
                # What goes elsewhere must not appear on this terminal.
                redirect_stdout=is_live(sys.stdout),
                redirect_stderr=is_live(sys.stderr),
            )
            self._live.start(refresh=True)  # now: the work may begin with a long import
        elif in_logs:
            self.begin_log()

    def begin_log(self) -> None:
        """Print the line from now on, if the stream is no terminal."""
        if not self._live and not self._thread:
            self._thread = Thread(target=self._print, daemon=True)
            self._thread.start()

    @property
    def elapsed(self) -> str:
        """The time since the beginning, for people."""
        return f"{monotonic() - self._began:.0f} s"

    def _moving(self) -> Text:
        line = Text(no_wrap=True, overflow="crop")
        if monotonic() - self._began >= self._wait:
            line.append(str(self._spinner.render(monotonic()))).append(" ").append(self._line())
        return line

    def _print(self) -> None:
        wait = FIRST_WAIT
        while not self._closed.wait(wait):
            wait = PERIOD - (monotonic() - self._quiet_since)
            if wait <= 0.0:
                wait = PERIOD
                self.say(str(self._line()))

    def say(self, line: str) -> None:
        """Print a line for good; on a terminal, above the moving one."""
        self._quiet_since = monotonic()
        if self._live:
            self._live.console.print(Text(line))
            return
        with self._printing:
            print_or_drop(line, self._stream)

    def close(self) -> None:
        """Erase the moving line."""
        self._closed.set()
        if self._thread:
            self._thread.join()
        if self._live:
            self._live.stop()


class FlightView(StatusLine):
    """Prints the events of a flight to a stream, and shows its state.

    All times are those of the report: since the mission's start, on world's clock.
    """

    def __init__(
        self, stream: TextIO, waypoints: int, unit: str = "waypoint", *, events: bool = True
    ) -> None:
        """Set the stream and the number of waypoints (0: unknown); show a status line at once.

        `unit` is what the mission counts; "": nothing. Without `events`, print no events.
        """
        self._waypoints, self._unit, self._events = waypoints, unit, events
        self._first_ns = self._now_ns = self._start_ns = NEVER_NS
        self._mission = 0  # number of the mission in the newest telemetry
        self._moved_at = self._seen = monotonic()
        self._position: Vector = (math.nan, math.nan, math.nan)
        self._delay, self._waypoint = math.nan, -1
        self._guard, self._ended = GuardState.GROUND, False
        self._step = ""  # what the command does after the flight
        # A session, which has no waypoints, may wait for its next mission for days.
        super().__init__(stream, self.line, in_logs=bool(waypoints))

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
                case Fault(code=code) if code in CONTROLLER_LOST:
                    pass  # the error at the end of the command says it
                case Fault() | LinkChanged():
                    self._event(in_words(record), record.stamp_ns)

    def _see_telemetry(self, record: TelemetrySent) -> None:
        if self._first_ns == NEVER_NS:
            self._first_ns, self._moved_at = record.stamp_ns, monotonic()
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
        if self._step:
            return Text(f"{self._step} ({self.elapsed})")
        elapsed, flown = self._seen - self._moved_at, (self._now_ns - self._first_ns) * 1e-9
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
        if not self._events:
            return
        since = (stamp_ns - self._start_ns) * 1e-9
        time = " " * 9 if self._start_ns == NEVER_NS else f"{since:7.2f} s"
        self.say(_joined((time, f"{escape(text):<44}", self._place())))

    def tell(self, step: str) -> None:
        """Show what the command does after the flight."""
        self._step, self._began = step, monotonic()
        self.begin_log()


def _joined(cells: Iterable[str]) -> str:
    return "  ".join(cell for cell in cells if cell).rstrip()


class CountView(StatusLine):
    """Shows how much of a long work is done, and how long the rest takes."""

    def __init__(self, stream: TextIO, total: int, unit: str) -> None:
        """Set the amount of work `total` and its `unit`, such as "flights"."""
        self._total, self._unit, self._done, self._more = total, unit, 0, ""
        self._first, self._at_first = math.nan, 0
        super().__init__(stream, self.line)

    def count(self, done: int, more: str = "") -> None:
        """Show that `done` pieces of work are done; `more` ends the line."""
        if math.isnan(self._first):
            self._first, self._at_first = monotonic(), done
        self._done, self._more = done, more

    def line(self) -> str:
        """Return the line. The rate counts from the first result: workers take seconds to start."""
        line = f"{self._done}/{self._total} {self._unit}"
        more = self._done - self._at_first
        if not more:
            return f"{line}  {self.elapsed}{self._more}"
        rate = more / max(monotonic() - self._first, 1e-3)
        left = (self._total - self._done) / rate
        time = f"{left:.0f} s" if left < 120 else f"{left / 60:.0f} min"
        return f"{line}  {rate:.1f}/s, {time} left{self._more}"


class PlanView:
    """Shows how many points of a sweep are checked, if that takes longer than a second."""

    def __init__(self, stream: TextIO) -> None:
        """Print nothing yet."""
        self._stream, self._began = stream, monotonic()
        self._view: CountView | None = None

    def see(self, done: int, points: int, work: str) -> None:
        """Show that `done` of the points are checked; `work` has their number in words."""
        if monotonic() - self._began < STEP_WAIT or done == points:
            return
        if self._view is None:
            print_or_drop(f"checks {work}", self._stream)
            self._view = CountView(self._stream, points, "points")
        self._view.count(done)

    def close(self) -> None:
        """Erase the status line on a terminal."""
        if self._view:
            self._view.close()


class StepView(StatusLine):
    """Shows the present step of a command, if the command takes longer than a second."""

    def __init__(self, stream: TextIO, step: str) -> None:
        """Set the stream and the first step, such as "reads the recording"."""
        self._step = step
        super().__init__(stream, self.line, STEP_WAIT)

    def line(self) -> str:
        """Return the step, and how long the command has taken."""
        return f"{escape(self._step)} ({self.elapsed})"

    def tell(self, step: str) -> None:
        """Set the next step."""
        self._step = step


class SweepView(CountView):
    """Shows how many flights are done."""

    def __init__(self, stream: TextIO, head: str, total: int) -> None:
        """Print the headline `head`; set `total`, the number of flights to fly."""
        print_or_drop(escape(head), stream)
        super().__init__(stream, total, "flights")
        self._failed, self._told = 0, set[str]()

    def see(self, row: Row) -> None:
        """Count a finished flight; print its failure if it is the first of its verdict.

        Print why a metric has no value once per text.
        """
        self._failed += row["verdict"] != "success"
        kind = row["verdict"] if row["failures"] else row["text"]
        if row["text"] and kind not in self._told:
            self._told.add(kind)
            self.say(escape(f"{row['key']}: {row['verdict']}: {row['text']}"))
        self.count(self._done + 1, f", {self._failed} failed" if self._failed else "")


class SeedsView(CountView):
    """Prints a line per flight with its seed, its verdict and why it failed."""

    def __init__(self, stream: TextIO, head: str, total: int) -> None:
        """Print the headline `head`; set `total`, the number of flights to fly."""
        print_or_drop(escape(head), stream)
        super().__init__(stream, total, "flights")
        self._told = set[str]()

    def see(self, row: Row) -> None:
        """Print the line of a finished flight; say why a metric has no value once per text."""
        self.count(self._done + 1)
        count = f"{self._done}/{self._total}"
        line = f"{count:>7}  seed {row['seed']}  {row['verdict']}"
        if row["failures"] or row["text"] not in ("", *self._told):
            line += f": {row['text']}"
        self._told.add(row["text"])
        self.say(escape(line))
