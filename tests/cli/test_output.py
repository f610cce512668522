"""Output: aligned columns, readable numbers, colour only on request, progress of a flight."""

import io
import json
import math
import re

import pytest
import yaml

from cloudrc.cli.main import main
from cloudrc.cli.output import format_number, is_live, paint, table
from cloudrc.cli.progress import FILE_COLUMNS, FlightView
from cloudrc.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.records import Control, Fault, GuardChange, MissionEvent, TelemetrySent

SECOND = 1_000_000_000
CONTROL = Control(
    stamp_ns=0, epoch=1, counter=1, basis_stamp_ns=0, horizon=0.0964, rtt=0.09, loop_delay=0.1,
    measured=ZERO, position=ZERO, orientation_wxyz=UPRIGHT, velocity=ZERO, setpoint=ZERO,
    waypoint=2, command=ZERO, yaw_rate=0.0, proportional=ZERO, integral=ZERO, derivative=ZERO,
)  # fmt: skip
REACHED = MissionEvent(0, "reached", 1, "waypoint 2 of 7 reached at 4.85 s")


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def plain_environment(monkeypatch):
    for name in ("CI", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")


def test_columns_line_up_and_numbers_are_right_aligned():
    assert table([("name", "value"), ("a", "1.5"), ("longer", "10.5")], right=[1]) == (
        "name    value\na         1.5\nlonger   10.5"
    )
    assert table([("a", "short"), ("b", "much longer")]) == "a  short\nb  much longer"


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.1474, "0.1474"), (26.96, "26.96"), (0.0, "0"), (1234.5, "1234"), (-3e-7, "-3.000e-07")],
)
def test_numbers_have_four_digits(value, text):
    assert format_number(value) == text


def test_colour_and_a_status_line_are_for_terminals(monkeypatch):
    assert paint("x", "red", Terminal()) == "\x1b[31mx\x1b[0m"
    assert (is_live(Terminal()), is_live(io.StringIO())) == (True, False)
    for variable, value in (("NO_COLOR", "1"), ("CI", "1"), ("TERM", "dumb")):
        with monkeypatch.context() as changed:
            changed.setenv(variable, value)
            assert paint("x", "red", Terminal()) == "x"
            assert is_live(Terminal()) is (variable == "NO_COLOR")


@pytest.mark.parametrize("line", [["list"], ["faults", "list"]])
def test_yaml_has_the_content_of_json(line, capsys):
    documents = []
    for form, read in (("json", json.loads), ("yaml", yaml.safe_load)):
        main([*line, "-o", form])
        documents.append(read(capsys.readouterr().out))
    assert documents[0] == documents[1]
    assert documents[0]["schemaVersion"] == 1


def telemetry(stamp_ns):
    odometry = Odometry(stamp_ns, (-1.0, 2.5, -0.0004), UPRIGHT, ZERO, ZERO)
    sent = Telemetry(stamp_ns, odometry, 0.0, -1, 0, 0, 0, GuardState.TRACK)
    return TelemetrySent(stamp_ns, 1, 1, sent)


def seen(stream, *records):
    ticks = iter(range(1000))
    view = FlightView(stream, 7, clock=lambda: float(next(ticks)))
    view.see(records)
    return view


def test_the_status_line_shows_the_state_of_the_flight():
    guard = GuardChange(0, GuardState.TRACK, "mission started")
    flown = telemetry(SECOND), CONTROL, guard, telemetry(3 * SECOND)
    assert seen(io.StringIO()).line().plain == "   0.0 s  GROUND"
    early = CONTROL._replace(horizon=0.0, rtt=math.nan, waypoint=-1)
    assert seen(io.StringIO(), telemetry(0), early).line().plain == (
        "   0.0 s  GROUND  (-1.00,  2.50, 0.00) m"
    )
    # Two seconds of flight within one second of the clock above.
    assert seen(io.StringIO(), *flown).line().plain == (
        "   2.0 s  TRACK   waypoint 3/7  (-1.00,  2.50, 0.00) m  delay  96 ms  x2.00"
    )


def test_a_terminal_gets_a_status_line_that_is_erased():
    stream = Terminal()
    seen(stream, telemetry(0), CONTROL).close()
    assert "waypoint 3/7" in stream.getvalue()
    assert stream.getvalue().endswith("\x1b[2K")


def test_a_narrow_terminal_cuts_off_the_status_line(monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    stream = Terminal()
    seen(stream, telemetry(0), CONTROL)
    drawn = re.sub(r"\x1b\[[?0-9;]*[a-zA-Z]", "", stream.getvalue()).strip()
    assert drawn == "0.0 s  GROUND  wa"


def test_a_file_gets_plain_lines_for_events_only():
    stream = io.StringIO()
    hold = GuardChange(0, GuardState.HOLD, "command age 0.252 s above 0.250 s")
    track = GuardChange(0, GuardState.TRACK, "fresh commands")
    done = REACHED._replace(event="done", text="mission done")
    seen(stream, telemetry(0), CONTROL, REACHED, hold, track, done, hold).close()
    assert [" ".join(line.split()) for line in stream.getvalue().splitlines()] == [
        "waypoint 2 of 7 reached at 4.85 s (-1.00, 2.50, 0.00) m delay 96 ms",
        "HOLD: command age 0.252 s above 0.250 s (-1.00, 2.50, 0.00) m delay 96 ms",
        "mission done (-1.00, 2.50, 0.00) m delay 96 ms",  # then the robot always holds
    ]


def test_a_closed_pipe_does_not_end_the_flight():
    class Closed(Terminal):
        def write(self, text):
            raise BrokenPipeError

    seen(Closed(), telemetry(0), CONTROL, REACHED).close()


@pytest.mark.parametrize("length", [10, 44, 45, 60, 159])
def test_a_long_text_has_no_position_and_is_wrapped_on_a_terminal(length):
    text, file, terminal = ("plug-in " * 20)[:length].strip(), io.StringIO(), Terminal()
    for stream in (file, terminal):
        seen(stream, telemetry(0), CONTROL, Fault(0, "late", text))
    (line,) = file.getvalue().splitlines()
    assert line.startswith(f"  {text}")
    assert ("  (-1.00" in line) is (length < 70)
    assert len(line) <= max(FILE_COLUMNS, len(text) + 2)
    *lines, _ = terminal.getvalue().splitlines()  # the last one is the status line
    assert max(map(len, lines)) <= 80
