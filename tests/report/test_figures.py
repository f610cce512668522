"""Every flight can be drawn, also with little data; only cloudrc decides the style."""

from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from cloudrc.config.load import load_experiment
from cloudrc.config.profile import DirectionConfig
from cloudrc.record.holes import Hole
from cloudrc.records import Control
from cloudrc.report.figures import FIGURES, PRINT_KINDS, draw_all, own_settings
from cloudrc.report.figures.style import RC, Look, Subject
from cloudrc.robots.shapes import read_shapes
from tests.metrics.conftest import ONE_PIPE, OPEN_AIR, SECOND, START, flown

CALM = DirectionConfig(delay_ms=50.0)


def subject_of(log):
    return Subject(log.flight(ONE_PIPE), CALM, CALM)


@pytest.mark.parametrize("end_ns", [0, START], ids=["empty", "ends at the start"])
@pytest.mark.parametrize("name", FIGURES)
def test_a_flight_without_data_is_drawn(name, end_ns):
    log = flown()
    for records in (log.world, log.cloud):
        records[:] = [record for record in records if record.stamp_ns <= end_ns]
    draw, caption, _ = FIGURES[name]
    subject = subject_of(log)
    with matplotlib.rc_context(RC):
        draw(subject).draw_without_rendering()
    assert caption(subject)


def test_figures_ignore_the_users_matplotlib_settings(monkeypatch):
    """matplotlib reads settings in the working folder, which may be a run from somebody else."""
    monkeypatch.setattr("cloudrc.report.figures.FIGURES", {"error": FIGURES["error"]})
    (picture,) = draw_all(subject_of(flown()))
    theirs = {"text.usetex": True, "axes.facecolor": "red", "lines.linestyle": ":"}
    with matplotlib.rc_context(theirs):
        assert draw_all(subject_of(flown())) == [picture]
        assert matplotlib.rcParams["text.usetex"], "put back"


@pytest.mark.parametrize("name", ["flight", "delay", "odom", "error"])
def test_no_line_crosses_a_hole(name):
    """The robot flies at 1 m/s along x, of which 3 s are lost."""
    log, begin, end = flown(), START + 4 * SECOND, START + 7 * SECOND
    for records in (log.world, log.cloud):
        records[:] = [each for each in records if not begin < each.stamp_ns < end]
    subject = subject_of(log)
    assert longest(name, subject) > 2.9
    subject.flight.recording.holes = (Hole(begin, end),)
    assert longest(name, subject) < 1.1


def longest(name, subject):
    """Return the largest extent along x of a line between two points [m] or [s]."""
    with own_settings(Look()):
        figure = FIGURES[name][0](subject)
    found = []
    for axes in figure.axes:
        found += [line.get_xydata() for line in axes.lines if line.get_linestyle() != "None"]
        for each in axes.collections:
            is_path = isinstance(each, LineCollection) and each.get_array() is not None
            found += each.get_segments() if is_path else []
    return max(np.nanmax(np.abs(np.diff(points[:, 0])), initial=0.0) for points in found)


@pytest.mark.parametrize(("width", "panels"), [(3.5, 3), (7.16, 4)])
def test_a_wide_figure_enlarges_the_largest_step(width, panels):
    log = flown()
    for n, record in enumerate(log.cloud):
        if isinstance(record, Control):
            to = (5.0 * (record.stamp_ns > START + 2 * SECOND), 0.0, 0.7)
            log.cloud[n] = record._replace(setpoint=to)
    with own_settings(Look(width)):
        figure = FIGURES["odom"][0](replace(subject_of(log), look=Look(width)))
    assert len(figure.axes) == panels
    shown = [axes.get_xlim() for axes in figure.axes]
    assert any(begin < 2.0 < end < 4.0 for begin, end in shown) == (panels == 4)


def test_text_stays_text_and_a_flight_in_real_time_has_a_date(monkeypatch):
    monkeypatch.setattr("cloudrc.report.figures.FIGURES", {"error": FIGURES["error"]})
    subject = replace(subject_of(flown()), look=Look(3.5, 8.0))
    (picture,) = draw_all(subject, PRINT_KINDS)
    assert b"<text" in picture.files["svg"]
    assert b"8px" in picture.files["svg"], "the size of the font"
    assert b'width="252pt"' in picture.files["svg"], "3.5 in"
    assert b"/CIDFontType2" in picture.files["pdf"]
    assert b"/Type3" not in picture.files["pdf"]
    assert not [kind for kind, data in picture.files.items() if b"1970-01-0" in data]
    subject.flight.recording.metadata = {"wall_clock_offset_ns": "86400000000000"}
    (picture,) = draw_all(subject, PRINT_KINDS)
    assert b"1970-01-02" in picture.files["svg"]
    assert b"1970-01-02" in picture.files["png"]
    assert b"D:19700102" in picture.files["pdf"]


def drawn(name, robot="pelican", experiment="hover", log=None, scene=OPEN_AIR):
    """Draw a figure of a robot that flies through `scene`; return subject and figure."""
    world = load_experiment(experiment, (f"world.robot={robot}",)).world
    shapes = read_shapes(world)
    subject = Subject((log or flown()).flight(scene), CALM, CALM, shapes=shapes)
    with own_settings(Look()):
        return subject, FIGURES[name][0](subject)


def test_a_robot_on_the_ground_has_no_panels_with_its_height():
    log = flown(lambda seconds: (seconds, np.sin(seconds), 0.1))
    subject, figure = drawn("flight", "rover", "pillars", log)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[0] == "(a) from above"
    assert not any("side" in title for title in titles)
    assert "side" not in FIGURES["flight"][1](subject)
    _, figure = drawn("odom", "rover", "pillars", log)
    assert [axes.get_ylabel() for axes in figure.axes] == ["$x$ (m)", "$y$ (m)"]


def test_the_view_from_above_has_every_obstacle_and_the_robot():
    log = flown(lambda seconds: (seconds, 1.0, 0.1))
    subject, figure = drawn("flight", "rover", "pillars", log)
    patches = [each.get_xy() for each in figure.axes[0].patches]
    bodies = {surface.body for surface in subject.shapes.scene}
    assert len(patches) == len(bodies) + len(subject.shapes.robot)
    centres = {tuple(np.round((each.max(0) + each.min(0)) / 2, 2) + 0.0) for each in patches}
    assert {(1.5, 0.0), (3.5, 2.5), (1.5, -2.2)} <= centres


def test_a_tube_is_an_outline_from_above_and_from_the_side():
    with own_settings(Look()):
        figure = FIGURES["flight"][0](subject_of(flown()))
    for axes in figure.axes[:2]:
        (patch,) = axes.patches
        assert np.ptp(patch.get_xy(), axis=0) == pytest.approx((5.0, 1.4))
