# SPDX-License-Identifier: Apache-2.0

"""Output: aligned columns, readable numbers, colour only on request, progress of a flight."""

import io
import json
from contextlib import redirect_stderr

import pytest
import yaml

from cloudrc.doors.cli import progress
from cloudrc.doors.cli.output import is_live, paint
from cloudrc.doors.cli.progress import FlightView, Progress
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.wire.records import Fault, GuardChange, MissionEvent, TelemetrySent
from tests.conftest import wait_until
from tests.doors.cli.conftest import SHORT
from tests.support.commands import python


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture(autouse=True)
def plain_environment(monkeypatch):
    for name in ("CI", "NO_COLOR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")


def test_colour_and_a_status_line_are_for_terminals(monkeypatch):
    monkeypatch.setattr("sys.stdout", Terminal())
    assert paint("x", "red") == "\x1b[31mx\x1b[0m"
    assert (is_live(Terminal()), is_live(io.StringIO())) == (True, False)
    monkeypatch.setenv("NO_COLOR", "1")
    assert (paint("x", "red"), is_live(Terminal())) == ("x", True)
    monkeypatch.setenv("TERM", "dumb")
    assert not is_live(Terminal())


def test_yaml_has_the_content_of_json(call, as_json):
    document = as_json("list")
    assert yaml.safe_load(call("list -o yaml").out) == document
    assert document["schemaVersion"] == 1


def test_a_log_gets_a_line_again_and_again(monkeypatch):
    monkeypatch.setattr(progress, "PERIOD", 0.05)
    with redirect_stderr(io.StringIO()) as stderr, Progress("flies", 9) as view:
        wait_until(lambda: stderr.getvalue().count("flies (0 s)  0/9\n") >= 2, 5.0)
        for done in (1, 2, 3):
            view.count(done)
        wait_until(lambda: "  3/9, 1 s left\n" in stderr.getvalue(), 5.0)


def test_events_are_plain_lines_or_wrapped_on_a_terminal(monkeypatch):
    streams = io.StringIO(), Terminal()
    odometry = Odometry(0, (-1.0, 2.5, -0.0004), UPRIGHT, ZERO, ZERO)
    before = Telemetry(0, odometry, (), -1, 0, 0, 0, GuardState.TRACK)
    seen = TelemetrySent(1_000_000_000, 1, 1, before._replace(mission_id=7))
    reached = MissionEvent(5_850_000_000, "reached", 1, "waypoint 2 of 7 reached")
    hold = GuardChange(6_000_000_000, GuardState.HOLD, "command age 0.252 s above 0.250 s")
    track = GuardChange(0, GuardState.TRACK, "fresh commands")
    late = Fault(6_100_000_000, "late", "plug-in " * 20)
    done = MissionEvent(7_000_000_000, "done", 6, "mission done")
    early = MissionEvent(0, "held", 0, "held")
    for stream in streams:
        monkeypatch.setattr("sys.stdout", stream)
        monkeypatch.setattr("sys.stderr", stream)
        with FlightView(7) as view:
            first = TelemetrySent(0, 1, 0, before)
            view.see([early, first, seen, reached, hold, track, late, done])
            view.see([hold, TelemetrySent(7_100_000_000, 1, 2, before._replace(mission_id=7))])
            assert str(view.__rich__()).lstrip().startswith("6.1 s")
    shown, wrapped = (stream.getvalue() for stream in streams)
    place = " (-1.00, 2.50, 0.00) m"
    assert [" ".join(line.split()) for line in shown.splitlines()] == [
        "held",  # before the mission's start there is no time
        f"4.85 s waypoint 2 of 7 reached{place}",
        f"5.00 s HOLD: command age 0.252 s above 0.250 s{place}",
        f"5.10 s {late.text.strip()}{place}",
        f"6.00 s mission done{place}",  # then the robot always holds
    ]
    assert max(map(len, wrapped.splitlines())) <= 90
    assert wrapped.endswith("\x1b[2K"), "the status line is erased"


@pytest.mark.parametrize("kind", [io.StringIO, Terminal])
def test_a_flight_shows_what_happens_before_it_and_after_it(kind, monkeypatch):
    """MuJoCo loads for a second, and the report takes several."""
    monkeypatch.setattr(progress, "PERIOD", 0.01)
    with redirect_stderr(kind()) as stderr, FlightView(7) as view:
        wait_until(lambda: "GROUND" in stderr.getvalue(), 5.0)
        view.tell("writes [it]")
        wait_until(lambda: "writes [it] (0 s)" in stderr.getvalue(), 5.0)


def test_a_flight_that_waits_logs_its_status_once():
    with redirect_stderr(io.StringIO()), FlightView(7) as view:
        view.log_line()
        assert view.log_line() == ""
        view.see([GuardChange(0, GuardState.TRACK, "fresh commands")])
        assert "TRACK" in view.log_line()


PRINTS = """\
import os, subprocess
os.write(1, b"descriptor\\n")
subprocess.run(["echo", "child"])
from cloudrc.cloud.predictors.last_sample import LastSample as build
"""


def test_nothing_that_a_plugin_prints_gets_into_a_document(folder):
    (folder / "prints.py").write_text(PRINTS)
    line = "-m cloudrc run steps --seeds 1 --set cloud.predictor=./prints.py -o json"
    done = python(*line.split(), *SHORT)
    assert json.loads(done.stdout)["schemaVersion"] == 1
    assert {"descriptor", "child"} <= set(done.stderr.splitlines())
