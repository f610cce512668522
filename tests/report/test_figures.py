"""Figures are drawn of any flight, also with little data, and in the style of cloudrc alone."""

import matplotlib
import pytest

from cloudrc.config.schema import Direction
from cloudrc.report.figures import FIGURES, draw_all
from cloudrc.report.figures.style import RC, Subject
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
    """matplotlib reads settings in the working folder, which may be somebody else's run."""
    monkeypatch.setattr("cloudrc.report.figures.NAMES", ("error",))
    (picture,) = draw_all(subject_of(flown()))
    theirs = {"text.usetex": True, "axes.facecolor": "red", "lines.linestyle": ":"}
    with matplotlib.rc_context(theirs):
        assert draw_all(subject_of(flown())) == [picture]
        assert matplotlib.rcParams["text.usetex"], "put back"
