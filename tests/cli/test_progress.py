"""Progress of a flight: a status line on a terminal, one line per event elsewhere."""

from __future__ import annotations

import io
import math

import pytest

from cloudrc.cli.progress import FILE_COLUMNS, FlightView
from cloudrc.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.records import Control, Fault, GuardChange, MissionEvent, Record, TelemetrySent

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


def flying(stamp_ns: int = 3 * SECOND) -> FlightView:
    guard = GuardChange(0, GuardState.TRACK, "mission started")
    return seen(io.StringIO(), telemetry(SECOND), CONTROL, guard, telemetry(stamp_ns))


def test_the_status_line_shows_the_state_of_the_flight() -> None:
    # Two seconds of flight within one second of the clock above.
    assert flying().line().plain == (
        "   2.0 s  waypoint 3/7  (-1.00,  2.50, 0.70) m  delay  96 ms  TRACK   x2.00"
    )


@pytest.mark.parametrize(
    ("width", "line"),
    [
        (120, "1000.0 s  waypoint 3/7  (-1.00,  2.50, 0.70) m  delay  96 ms  TRACK   x1000.00"),
        (76, "1000.0 s  waypoint 3/7  (-1.00,  2.50, 0.70) m  delay  96 ms  TRACK"),
        (60, "1000.0 s  waypoint 3/7  (-1.00,  2.50, 0.70) m  TRACK"),
        (40, "1000.0 s  waypoint 3/7  TRACK"),
        (20, "1000.0 s  TRACK"),
        (12, "1000.0 s  TR"),
    ],
)
def test_a_narrow_terminal_gets_a_shorter_line(width: int, line: str) -> None:
    assert flying(1001 * SECOND).line(width).plain == line
    assert len(line) <= width


def test_unknown_values_are_not_shown() -> None:
    early = CONTROL._replace(horizon=0.0, rtt=math.nan, waypoint=-1)
    assert seen(io.StringIO(), telemetry(0), early).line().plain == (
        "   0.0 s  (-1.00,  2.50, 0.70) m  GROUND"
    )
    assert seen(io.StringIO()).line().plain == "   0.0 s  GROUND"


def test_zero_has_no_sign() -> None:
    sent = telemetry(0)
    odometry = sent.telemetry.odometry._replace(position=(-0.004, -0.0, -1e-9))
    sent = sent._replace(telemetry=sent.telemetry._replace(odometry=odometry))
    assert "( 0.00,  0.00, 0.00) m" in seen(io.StringIO(), sent).line().plain


def test_a_terminal_gets_a_status_line_that_is_erased() -> None:
    stream = Terminal()
    seen(stream, telemetry(0), CONTROL).close()
    assert "waypoint 3/7" in stream.getvalue()
    assert stream.getvalue().endswith("\x1b[2K")


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


@pytest.mark.parametrize("length", [10, 44, 45, 60])
def test_blanks_separate_a_text_from_the_position(length: int) -> None:
    stream = io.StringIO()
    seen(stream, telemetry(0), CONTROL, MissionEvent(0, "reached", 1, "x" * length))
    assert "x  " in stream.getvalue()
    assert len(stream.getvalue().rstrip("\n")) <= FILE_COLUMNS


def test_a_long_text_is_wrapped_on_a_terminal_only() -> None:
    text, file, terminal = " ".join(["plug-in"] * 20), io.StringIO(), Terminal()
    for stream in (file, terminal):
        seen(stream, telemetry(0), CONTROL, Fault(0, "late", text))
    assert file.getvalue() == f"  {text}\n"
    *lines, _ = terminal.getvalue().splitlines()  # the last one is the status line
    assert max(map(len, lines)) <= 80
    assert all(line.startswith("    plug-in") for line in lines[1:])


def test_a_closed_pipe_does_not_end_the_flight() -> None:
    class Closed(Terminal):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    seen(Closed(), telemetry(0), CONTROL, MissionEvent(0, "reached", 1, "reached")).close()
