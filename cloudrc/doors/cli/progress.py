# SPDX-License-Identifier: Apache-2.0

"""Show on stderr what a long command does: a moving line on a terminal, else a line every 10 s."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable
from threading import Event, Thread
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    RenderableColumn,
    SpinnerColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.table import Column
from rich.text import Text

from cloudrc.base.text import escape
from cloudrc.doors.cli.output import is_live, print_or_drop
from cloudrc.flight.pod.process import in_words
from cloudrc.wire.messages import NEVER_NS, GuardState, Vector
from cloudrc.wire.records import (
    Control,
    Fault,
    GuardChange,
    LinkChanged,
    MissionEvent,
    Record,
    TelemetrySent,
)

if TYPE_CHECKING:
    from cloudrc.flight.trials.rows import Row

ENDINGS = ("done", "cancelled", "timed_out")
PERIOD = 10.0
"""Time from one line to the next on a stream that is no terminal [s]."""


class Progress:
    """Shows the present step of a command in a `with` block, and how much of it is done."""

    def __init__(
        self, step: str = "", total: int | None = None, *, on_stdout: bool = False
    ) -> None:
        """Set the first step, such as "reads the recording", and the number of its pieces of work.

        `say` prints on stderr, or with `on_stdout` on stdout.
        """
        self._step = step
        is_moving = is_live(sys.stderr)
        bar = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) if total else ()
        self._bars = Bars(
            SpinnerColumn(),
            RenderableColumn(self, table_column=Column(no_wrap=True, overflow="crop")),
            *bar,
            console=Console(stderr=True),
            transient=True,
            disable=not is_moving,
            # What goes elsewhere must not appear on this terminal.
            redirect_stdout=is_live(sys.stdout),
            redirect_stderr=is_moving,
            speed_estimate_period=600.0,  # a piece of work may take minutes
        )
        self._bars.add_task("", total=total)
        (self._work,) = self._bars.tasks
        self._closed, self._thread = Event(), Thread(target=self._log, daemon=True)
        self._bars.start()
        # Now: rich has replaced the streams, and while plug-ins run, sys.stdout is stderr.
        self._out = sys.stdout if on_stdout else sys.stderr
        if not is_moving:
            self._thread.start()

    def __rich__(self) -> Text:
        """Return the present step, and how long it takes."""
        return Text(f"{escape(self._step)} ({self._work.elapsed or 0:.0f} s)")

    def _log(self) -> None:
        while not self._closed.wait(PERIOD):
            if line := self.log_line():
                print_or_drop(line, sys.stderr)

    def log_line(self) -> str:
        """Return the line for a stream that is no terminal; "": none."""
        line, left = str(self.__rich__()), self._work.time_remaining
        if self._work.total:
            line = f"{line}  {self._work.completed:.0f}/{self._work.total:.0f}"
        return line if left is None else f"{line}, {left:.0f} s left"

    def tell(self, step: str) -> None:
        """Set the next step."""
        self._step = step
        self._bars.reset(self._work.id, total=self._work.total)

    def count(self, done: int) -> None:
        """Show that `done` pieces of work are done."""
        self._bars.update(self._work.id, completed=done)

    def say(self, line: str) -> None:
        """Print a line for good; on a terminal, above the moving one."""
        print_or_drop(escape(line), self._out)

    def __enter__(self) -> Self:
        """Show the step during the block."""
        return self

    def __exit__(self, *_: object) -> None:
        """Erase the moving line."""
        self._closed.set()
        self._bars.stop()
        if self._thread.is_alive():
            self._thread.join()


class FlightView(Progress):
    """Prints the events of a flight, and shows its state.

    All times are those of the report: since the mission's start, on world's clock.
    """

    def __init__(self, waypoints: int, unit: str = "waypoint", *, events: bool = True) -> None:
        """Set the number of waypoints (0: a session); show a status line at once.

        `unit` is what the mission counts; "": nothing. With `events`, print them on stdout.
        """
        self._waypoints, self._unit, self._events = waypoints, unit, events
        self._now_ns = self._start_ns = NEVER_NS
        self._mission = 0  # number of the mission in the newest telemetry
        self._position: Vector = (math.nan, math.nan, math.nan)
        self._delay, self._waypoint = math.nan, -1
        self._guard, self._ended = GuardState.GROUND, False
        self._logged = ""  # the newest line for a log
        super().__init__(on_stdout=events)

    def see(self, records: Iterable[Record]) -> None:
        """Show new records of world or cloud, in the order of time."""
        for record in records:
            match record:
                case TelemetrySent(telemetry=seen):
                    if seen.mission_id != self._mission:
                        self._mission, self._start_ns = seen.mission_id, record.stamp_ns
                    self._now_ns, self._position = record.stamp_ns, seen.odometry.position
                case Control():
                    # The horizon is 0 and meaningless before the first round trip.
                    self._delay = math.nan if math.isnan(record.rtt) else record.horizon
                    self._waypoint = record.waypoint
                case GuardChange():
                    self._guard = record.state
                    # The robot holds its position after every mission: do not print this.
                    is_usual = self._ended and record.state is GuardState.HOLD
                    if record.state > GuardState.TRACK and not is_usual:
                        self._event(f"{record.state.name}: {record.cause}", record.stamp_ns)
                case MissionEvent():
                    self._ended = record.event in ENDINGS
                    self._event(record.text, record.stamp_ns)
                case Fault() | LinkChanged():
                    self._event(in_words(record), record.stamp_ns)

    def __rich__(self) -> Text:
        """Return the status line; it ends with the least important part, which may be cropped."""
        if self._step:
            return super().__rich__()
        since = self._now_ns - self._start_ns if self._start_ns != NEVER_NS else 0
        cells = (
            f"{since * 1e-9:6.1f} s",
            f"{self._guard.name:<6}",
            self._leg(),
            self._place(),
            "" if math.isnan(self._delay) else f"delay {self._delay * 1e3:3.0f} ms",
        )
        line = Text(_joined(cells))
        colour = "green" if self._guard == GuardState.TRACK else "yellow"
        line.highlight_words([self._guard.name], colour)
        return line

    def log_line(self) -> str:
        """Return the line for a log; "" if it is the line before, as while the flight waits.

        A session may wait for its next mission for days.
        """
        line = super().log_line() if self._waypoints or self._step else ""
        if line == self._logged:
            return ""
        self._logged = line
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
        self.say(_joined((time, f"{text:<44}", self._place())))


def _joined(cells: Iterable[str]) -> str:
    return "  ".join(cell for cell in cells if cell).rstrip()


class SweepView(Progress):
    """Counts flights; prints the first failure of each verdict."""

    def __init__(self, head: str, total: int, *, on_stdout: bool = False) -> None:
        """Print the headline `head`; set `total`, the number of flights to fly."""
        super().__init__("flies", total, on_stdout=on_stdout)
        self.say(head)
        self._failed, self._told = 0, set[str]()

    def see(self, row: Row) -> None:
        """Count a finished flight, and tell about it."""
        self._bars.advance(self._work.id)
        if row["verdict"] != "success":
            self._failed += 1
            self._step = f"flies, {self._failed} failed"
        self._tell(row)

    def _tell(self, row: Row) -> None:
        """Print the first failure of each verdict, and why a metric has no value once per text."""
        kind = row["verdict"] if row["failures"] else row["text"]
        if row["text"] and kind not in self._told:
            self._told.add(kind)
            self.say(f"{row['key']}: {row['verdict']}: {row['text']}")


class SeedsView(SweepView):
    """Prints a line per flight, with its seed, its verdict and why it failed."""

    def _tell(self, row: Row) -> None:
        """Print the line of a flight; say why a metric has no value once per text."""
        count = f"{self._work.completed:.0f}/{self._work.total:.0f}"
        line = f"{count:>7}  seed {row['seed']}  {row['verdict']}"
        if row["failures"] or row["text"] not in ("", *self._told):
            line += f": {row['text']}"
        self._told.add(row["text"])
        self.say(line)
