"""Figures mark events of the link and guard, and draw flights with little data."""

from __future__ import annotations

import importlib

import matplotlib
import numpy as np
import pytest

from cloudrc.config.schema import Blackout, Change, Direction
from cloudrc.geometry.scene import load_scene
from cloudrc.messages import GuardState
from cloudrc.records import Control, GuardChange
from cloudrc.report.figures import NAMES, draw_all, flight
from cloudrc.report.figures.marks import LEGEND, legend, mark_events
from cloudrc.report.figures.snapshots import WALL_COLOUR, is_inside_pipe, pipe_faces
from cloudrc.report.figures.style import RC, Subject, new_figure
from tests.metrics.conftest import ONE_PIPE, START, Log, at, flown

CALM = Direction(delay_ms=50.0)


def subject_of(log: Log, uplink: Direction = CALM) -> Subject:
    return Subject(log.flight(ONE_PIPE), uplink, CALM)


@pytest.mark.parametrize("empty", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_a_flight_without_data_is_drawn(name: str, empty: bool) -> None:
    """The recording is empty or ends at the start."""
    log = flown()
    log.world = [] if empty else [record for record in log.world if record.stamp_ns <= START]
    log.cloud = [] if empty else [record for record in log.cloud if record.stamp_ns <= START]
    drawing = importlib.import_module(f"cloudrc.report.figures.{name}")
    subject = subject_of(log)
    with matplotlib.rc_context(RC):
        drawing.draw(subject).draw_without_rendering()
    assert drawing.caption(subject)


def test_a_pipes_rim_inside_another_pipe_is_not_drawn() -> None:
    """Sorted by depth, its faces would appear between those of the other pipe."""
    first, second, _ = load_scene("pipes").pipes
    centre = np.array(second.centre)
    faces = pipe_faces(second, np.array([0.0, 0.0, 1.0]), centre, second.length)
    met = [face for face in faces if is_inside_pipe(face, first)]
    assert 0 < len(met) < len(faces)
    assert {face.colour for face in met} == {WALL_COLOUR}
    for face in met:
        offset = face.corners.mean(axis=0) - np.array(first.centre)
        assert np.hypot(offset[0], offset[2]) < first.outer  # its axis is y
        assert abs(offset[1]) < first.length / 2


def test_the_caption_names_the_end_of_the_clearance_axis() -> None:
    assert "Panel (c) ends at 0.8 m" in flight.caption(subject_of(flown()))


def test_a_calm_flight_has_no_marks() -> None:
    assert legend(subject_of(flown())) == ""


def test_holds_blackouts_and_changes_are_marked() -> None:
    log = flown()
    log.world += [
        GuardChange(at(2), GuardState.HOLD, "command age"),
        GuardChange(at(3), GuardState.TRACK, "fresh command"),
    ]
    # The link started one second before the mission.
    uplink = Direction(
        blackouts=(Blackout(start_s=3.0, duration_s=1.0), Blackout(start_s=500.0, duration_s=1.0)),
        changes=(Change(at_s=0.5, delay_ms=1.0), Change(at_s=6.0, delay_ms=9.0)),
    )
    subject = subject_of(log, uplink)
    assert legend(subject) == LEGEND
    axes = new_figure(3.0, 2.0).subplots()
    mark_events(axes, subject)
    spans = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches]
    assert spans == [pytest.approx((2.0, 3.0)), pytest.approx((2.0, 3.0))]
    assert [line.get_xdata()[0] for line in axes.lines] == pytest.approx([5.0])


def test_waypoints_are_the_first_setpoints_of_each() -> None:
    log = flown()

    def fly_to(n: int, control: Control) -> Control:
        waypoint = -1 if control.stamp_ns < at(1) else 0 if control.stamp_ns < at(4) else 1
        return control._replace(waypoint=waypoint, setpoint=(float(waypoint), 2.0, 3.0))

    log.change(Control, fly_to)
    assert subject_of(log).waypoints == {0: (0.0, 2.0, 3.0), 1: (1.0, 2.0, 3.0)}


def test_figures_ignore_the_users_matplotlib_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    """matplotlib reads settings in the working folder, which may be somebody else's run."""
    monkeypatch.setattr("cloudrc.report.figures.NAMES", ("error",))
    (picture,) = draw_all(subject_of(flown()))
    theirs = {"text.usetex": True, "axes.facecolor": "red", "lines.linestyle": ":"}
    with matplotlib.rc_context(theirs):
        assert draw_all(subject_of(flown())) == [picture]
        assert matplotlib.rcParams["text.usetex"], "put back"
