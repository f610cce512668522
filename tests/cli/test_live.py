"""What a flight shows: one living line on a terminal, one plain line per event elsewhere."""

from __future__ import annotations

import io

import pytest

from cloudrc.cli.live import FlightView
from cloudrc.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.records import Control, GuardChange, MissionEvent, Record, TelemetrySent

SECOND = 1_000_000_000
CONTROL = Control(
    stamp_ns=0, epoch=1, counter=1, basis_stamp_ns=0, horizon=0.0964, rtt=0.09, loop_delay=0.1,
    measured=ZERO, position=ZERO, orientation_wxyz=UPRIGHT, velocity=ZERO, setpoint=ZERO,
    waypoint=2, command=ZERO, yaw_rate=0.0, proportional=ZERO, integral=ZERO, derivative=ZERO,
)  # fmt: skip


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def telemetry(stamp_ns: int) -> TelemetrySent:
    odometry = Odometry(stamp_ns, (-1.0, 2.5, 0.7), UPRIGHT, ZERO, ZERO)
    return TelemetrySent(
        stamp_ns, 1, 1, Telemetry(stamp_ns, odometry, 0.0, -1, 0, 0, 0, GuardState.TRACK)
    )


@pytest.fixture(autouse=True)
def plain_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("CI", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm")


def seen(stream: io.StringIO, *records: Record) -> FlightView:
    ticks = iter(range(1000))
    view = FlightView(stream, 7, clock=lambda: float(next(ticks)))
    view.see(records)
    return view


def test_the_line_says_where_the_flight_is() -> None:
    guard = GuardChange(0, GuardState.TRACK, "mission started")
    view = seen(io.StringIO(), telemetry(SECOND), CONTROL, guard, telemetry(3 * SECOND))
    # Two seconds of flight; the clock above gave one second between first telemetry and now.
    assert view.line() == (
        "   2.0 s  waypoint 3/7  (-1.00,  2.50, 0.70) m  delay  96 ms  TRACK  x2"
    )


def test_the_line_fits_80_columns_at_its_longest() -> None:
    view = seen(io.StringIO(), telemetry(0), CONTROL, telemetry(1000 * SECOND))
    assert len(view.line()) <= 80


def test_a_terminal_gets_a_line_that_is_rewritten_and_taken_away() -> None:
    stream = Terminal()
    seen(stream, telemetry(0), CONTROL).close()
    assert stream.getvalue().startswith("\r\x1b[2K")
    assert "waypoint 3/7" in stream.getvalue()
    assert stream.getvalue().endswith("\r\x1b[2K")
    assert "\n" not in stream.getvalue()


def test_a_file_gets_plain_lines_for_events_only() -> None:
    stream = io.StringIO()
    event = MissionEvent(0, "reached", 1, "waypoint 2 of 7 reached at 4.85 s")
    hold = GuardChange(0, GuardState.HOLD, "command age 0.252 s above 0.250 s")
    track = GuardChange(0, GuardState.TRACK, "fresh commands")
    seen(stream, telemetry(0), CONTROL, event, hold, track).close()
    lines = stream.getvalue().splitlines()
    assert [" ".join(line.split()) for line in lines] == [
        "waypoint 2 of 7 reached at 4.85 s (-1.00, 2.50, 0.70) m delay 96 ms",
        "HOLD: command age 0.252 s above 0.250 s (-1.00, 2.50, 0.70) m delay 96 ms",
    ]
    assert "\x1b" not in stream.getvalue()
