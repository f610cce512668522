"""Every flight can be drawn, also with little data; only cloudrc decides the style."""

import itertools
from dataclasses import replace

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from cloudrc.config.schema import Direction
from cloudrc.records import Control
from cloudrc.report.figures import FIGURES, draw_all, overview, own_settings
from cloudrc.report.figures.labels import FREE, place_labels
from cloudrc.report.figures.style import RC, Look, Subject
from cloudrc.report.solids import robot_faces
from tests.metrics.conftest import ONE_PIPE, START, flown

CALM = Direction(delay_ms=50.0)


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
        for label, box in zip(labels, boxes, strict=True):
            on_curve = ((points > box.min) & (points < box.max)).all(axis=1).any()
            outer = axes.bbox.padded(1)
            inside = outer.contains(*box.min) and outer.contains(*box.max)
            if on_curve or box.count_overlaps(boxes) > 1 or not inside:
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
    (picture,) = draw_all(subject)
    assert b"<text" in picture.files["svg"]
    assert b"8px" in picture.files["svg"], "the size of the font"
    assert b'width="252pt"' in picture.files["svg"], "3.5 in"
    assert b"/CIDFontType2" in picture.files["pdf"]
    assert b"/Type3" not in picture.files["pdf"]
    assert not [kind for kind, data in picture.files.items() if b"1970-01-0" in data]
    subject.flight.recording.metadata = {"wall_clock_offset_ns": "86400000000000"}
    (picture,) = draw_all(subject)
    assert b"1970-01-02" in picture.files["svg"]
    assert b"1970-01-02" in picture.files["png"]
    assert b"D:19700102" in picture.files["pdf"]


def test_a_robot_whose_shape_is_not_known_is_a_marker_and_the_caption_says_so():
    pelican = subject_of(flown())
    assert overview.MARKED in overview.caption(replace(pelican, robot="rover"))
    assert overview.MARKED not in overview.caption(pelican)
    assert len(robot_faces("rover")) < len(robot_faces())
