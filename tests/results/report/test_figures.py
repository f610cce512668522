# SPDX-License-Identifier: Apache-2.0

"""Every flight can be drawn, also with little data; only cloudrc decides the style."""

from dataclasses import replace

import matplotlib
import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.results.report.figures import FIGURES, PRINT_KINDS, draw_all, own_settings
from cloudrc.results.report.figures.style import RC, Look, Subject
from cloudrc.results.report.shapes import read_shapes
from tests.results.metrics.conftest import OPEN_AIR, START, flown
from tests.results.report.test_marks import CALM, subject_of


@pytest.mark.parametrize("end_ns", [0, START], ids=["empty", "ends at the start"])
@pytest.mark.parametrize("name", FIGURES)
def test_a_flight_without_data_is_drawn(name, end_ns):
    log = flown()
    log.keep(lambda stamp_ns: stamp_ns <= end_ns)
    with matplotlib.rc_context(RC):
        FIGURES[name][0](subject_of(log=log)).draw_without_rendering()


def test_figures_ignore_the_users_matplotlib_settings(monkeypatch):
    """matplotlib reads settings in the working folder, which may be a run from somebody else."""
    monkeypatch.setattr("cloudrc.results.report.figures.FIGURES", {"error": FIGURES["error"]})
    (picture,) = draw_all(subject_of())
    theirs = {"text.usetex": True, "axes.facecolor": "red", "lines.linestyle": ":"}
    with matplotlib.rc_context(theirs):
        assert draw_all(subject_of()) == [picture]
        assert matplotlib.rcParams["text.usetex"], "put back"


def test_text_stays_text_and_a_flight_in_real_time_has_a_date(monkeypatch):
    monkeypatch.setattr("cloudrc.results.report.figures.FIGURES", {"error": FIGURES["error"]})
    subject = replace(subject_of(), look=Look(3.5, 8.0))
    (picture,) = draw_all(subject)
    assert b"1970-01-0" not in picture.files["svg"]
    subject.flight.recording.metadata = {"wall_clock_offset_ns": "86400000000000"}
    (picture,) = draw_all(subject, PRINT_KINDS)
    assert b"<text" in picture.files["svg"]
    assert b"8px" in picture.files["svg"], "the size of the font"
    assert b'width="252pt"' in picture.files["svg"], "3.5 in"
    assert b"/CIDFontType2" in picture.files["pdf"]
    assert b"/Type3" not in picture.files["pdf"]
    assert b"1970-01-02" in picture.files["svg"]
    assert b"1970-01-02" in picture.files["png"]
    assert b"D:19700102" in picture.files["pdf"]


def test_the_figure_of_a_robot_on_the_ground_shows_obstacles_but_no_heights():
    log = flown(lambda seconds: (seconds, np.sin(seconds), 0.1))
    shapes = read_shapes(load_experiment("pillars", ("world.robot=rover",)).world)
    subject = Subject(log.flight(OPEN_AIR), CALM, CALM, shapes=shapes)
    with own_settings(Look()):
        figures = [FIGURES[name][0](subject) for name in ("flight", "odom")]
    (above,), over_time = (figure.axes for figure in figures)
    assert above.get_title(loc="left") == "(a) path from above"
    assert [axes.get_ylabel() for axes in over_time] == ["$x$ (m)", "$y$ (m)"]
    seen = [
        np.concatenate([path.vertices for path in each.get_paths()]) for each in above.collections
    ]
    centres = {tuple(np.round((each.max(0) + each.min(0)) / 2, 2) + 0.0) for each in seen}
    assert {(1.5, 0.0), (3.5, 2.5), (1.5, -2.2)} <= centres
    assert len(seen) == len(shapes.scene)
