"""Every flight can be drawn, also with little data; only cloudrc decides the style."""

import itertools
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection

from cloudrc.config.load import load_experiment
from cloudrc.config.schema import DirectionConfig
from cloudrc.geometry.shapes import Shapes, box, terrain
from cloudrc.record.holes import Hole
from cloudrc.records import Control
from cloudrc.report.figures import FIGURES, PRINT_KINDS, draw_all, own_settings
from cloudrc.report.figures.labels import FREE, place_labels
from cloudrc.report.figures.projection import View, glass, simplified
from cloudrc.report.figures.style import RC, Look, Subject, sampled
from cloudrc.world.shapes import read_shapes
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


def test_a_sampled_path_has_both_sides_of_a_hole_and_no_line_between_them():
    rows, is_line = sampled(12, np.array([7]))
    assert rows.tolist() == [0, 5, 6, 7, 10, 11]
    assert is_line.tolist() == [True, True, False, True, True]
    assert [len(each) for each in sampled(0, np.zeros(0, int))] == [0, 0]


def samples(figure, axes):
    """Return points on all lines in `axes`, at most a pixel apart [pixels], shape (n, 2)."""
    lines = [line for line in axes.lines if line.get_zorder() > 0]
    drawn = [line.get_transform().transform(line.get_xydata()) for line in lines]
    for collection in axes.collections:
        if isinstance(collection, LineCollection):
            drawn += [collection.get_transform().transform(s) for s in collection.get_segments()]
    found = [np.zeros((0, 2))]
    for points in drawn:
        points = points[np.isfinite(points).all(axis=1)]
        for a, b in itertools.pairwise(points):
            count = min(int(np.abs(b - a).max()) + 2, 5000)
            found.append(np.linspace(a, b, count))
    return np.concatenate(found)


def covered(figure):
    """List the labels that lie on a curve or on another label, and those outside their panel."""
    wrong = []
    for axes in figure.axes:
        labels = [text for text in axes.texts if text.get_gid() == FREE]
        points, boxes = samples(figure, axes), [label.get_window_extent() for label in labels]
        for label, place in zip(labels, boxes, strict=True):
            on_curve = ((points > place.min) & (points < place.max)).all(axis=1).any()
            outer = axes.bbox.padded(1)
            inside = outer.contains(*place.min) and outer.contains(*place.max)
            if on_curve or place.count_overlaps(boxes) > 1 or not inside:
                wrong.append(label.get_text())
    return wrong


@pytest.mark.parametrize("width", [3.5, 7.16])
@pytest.mark.parametrize("name", FIGURES)
def test_no_label_of_a_figure_lies_on_a_curve(name, width):
    look = Look(width)
    with own_settings(look):
        figure = FIGURES[name][0](replace(subject_of(flown()), look=look))
        place_labels(figure)
        assert figure.get_figwidth() == width
        assert covered(figure) == []


@pytest.mark.parametrize("every", [2_000, 150], ids=["one step", "no room"])
def test_the_inset_of_a_step_has_a_place_without_curves(every):
    log, step = flown(), every * 1_000_000
    for n, record in enumerate(log.cloud):
        if isinstance(record, Control):
            to = (5.0 * ((record.stamp_ns - START) // step % 2), 0.0, 0.7)
            log.cloud[n] = record._replace(setpoint=to)
    subject = subject_of(log)
    with own_settings(Look()):
        figure = FIGURES["odom"][0](subject)
        place_labels(figure)
        ((axes, inset),) = [(a, i) for a in figure.axes for i in a.child_axes]
    points, box = samples(figure, axes), inset.get_tightbbox()
    assert not ((points > box.min) & (points < box.max)).all(axis=1).any()
    begin, end = inset.get_xlim()
    control = subject.flight.control
    time = subject.flight.seconds(control["stamp_ns"])
    shown = control["setpoint"][(time >= begin) & (time <= end)]
    assert np.abs(np.diff(shown, axis=0)).max() > 0.2, "a step is in it"


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


def polygons(axes):
    """Return the corners of all drawn polygons, each with its colour."""
    return [
        (path.vertices[:-1], tuple(colour))
        for collection in axes.collections
        if isinstance(collection, PolyCollection)
        for path, colour in zip(collection.get_paths(), collection.get_facecolors(), strict=False)
    ]


@pytest.mark.parametrize("robot", ["pelican", "x2", "nano"])
def test_the_overview_has_the_robot_in_its_size_and_colours(robot):
    log = flown(lambda seconds: (0.0, 0.0, 1.0))
    subject, figure = drawn("overview", robot, log=log)
    found = polygons(figure.axes[0])
    width = np.ptp(np.concatenate([corners for corners, _ in found]), axis=0).max()
    assert 0.6 * subject.shapes.size < width < 1.05 * subject.shapes.size
    parts = {surface.rgba[3] for surface in subject.shapes.robot}
    assert {round(colour[3], 3) for _, colour in found} == {round(part, 3) for part in parts}


def test_an_inset_enlarges_a_robot_that_is_too_small_to_see():
    for robot, insets in (("nano", 1), ("pelican", 0)):
        subject, figure = drawn("overview", robot, scene=ONE_PIPE)
        (axes,) = figure.axes
        assert len(axes.child_axes) == insets
        assert ("inset" in FIGURES["overview"][1](subject)) == bool(insets)
    subject, figure = drawn("overview", "nano", scene=ONE_PIPE)
    (inset,) = figure.axes[0].child_axes
    corners = np.concatenate([corners for corners, _ in polygons(inset)])
    assert np.ptp(inset.get_xlim()) < 2 * np.ptp(corners, axis=0).max()
    (bar,) = inset.lines
    assert inset.texts[0].get_text() == f"{np.ptp(bar.get_xdata()) * 100:g} cm"


def test_a_robot_on_the_ground_has_no_panels_with_its_height():
    log = flown(lambda seconds: (seconds, np.sin(seconds), 0.1))
    subject, figure = drawn("flight", "rover", "pillars", log)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[0] == "(a) from above"
    assert not any("height" in title for title in titles)
    assert "eight" not in FIGURES["flight"][1](subject)
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


def test_what_is_above_the_robot_is_an_outline():
    roof = replace(box((5.0, 5.0, 0.1)), body="roof").placed((5.0, 0.0, 4.0), np.eye(3))
    block = replace(box((0.5, 0.5, 0.5)), body="block").placed((5.0, 2.0, 0.5), np.eye(3))
    subject = replace(subject_of(flown()), shapes=Shapes(scene=(roof, block)))
    with own_settings(Look()):
        figure = FIGURES["flight"][0](subject)
    widths = {
        round(float(np.ptp(each.get_xy()[:, 0]))): each.get_facecolor()[3]
        for each in figure.axes[0].patches
    }
    assert widths == {10: 0.0, 1: 1.0}


def test_an_obstacle_in_front_of_the_path_is_translucent():
    near, far = (
        replace(box((1.0, 0.1, 1.0)), body=name).placed((5.0, y, 1.0), np.eye(3))
        for name, y in (("near", -1.0), ("far", 1.0))
    )
    view = View(np.array([1.0, 0.0, 0.0]), np.radians(38.0))
    path = np.stack([np.linspace(0, 10, 50), np.zeros(50), np.ones(50)], axis=1)
    assert (view.hides(near, path), view.hides(far, path)) == (True, False)
    assert {part.colours[0, 3] for part in glass(view, near)} == {0.3, 0.8}


def test_a_mesh_loses_details_that_are_smaller_than_a_dot():
    fine = terrain(np.zeros((60, 60)), 1.0, 1.0, 0.1)
    mesh = replace(fine, faces=(fine.triangles,))
    few = simplified(mesh, 0.2)
    assert len(few.triangles) < len(mesh.triangles) / 20
    assert np.abs(few.corners).max() == pytest.approx(1.0)
