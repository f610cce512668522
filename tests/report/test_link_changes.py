"""Changes of the link in flight change the bands of figures and are marked with triangles."""

from __future__ import annotations

import itertools
import json
import math
from typing import Any

import matplotlib
import numpy as np
import pytest

from cloudrc.config.schema import Blackout, Change, Direction
from cloudrc.records import LinkChanged
from cloudrc.report.figures import delay
from cloudrc.report.figures.marks import bounds, legend, mark_events, set_in_flight, spans
from cloudrc.report.figures.style import RC, Subject, new_figure
from tests.metrics.conftest import ONE_PIPE, Log, at, flown

CALM = Direction(delay_ms=50.0)
TIMED = Direction(
    delay_ms=20.0,
    changes=(Change(at_s=2.0, delay_ms=90.0), Change(at_s=99.0, delay_ms=9.0)),
    blackouts=(Blackout(start_s=1.0, duration_s=9.0),),
)


def changed(
    time: float, uplink: bool, direction: Direction, cause: str, age: float = 0.0, **more: Any
) -> LinkChanged:
    conditions = json.dumps(direction.model_dump(mode="json", exclude_defaults=True))
    line = more.get("time_line", age)
    return LinkChanged(
        at(time), uplink, "relay", cause, age, line, 0.0, 0.0, 0.0, math.nan, conditions
    )


def subject_of(*changes: LinkChanged, uplink: Direction = CALM) -> Subject:
    log: Log = flown()
    log.world += [change for change in changes if change.uplink]
    log.cloud += [change for change in changes if not change.uplink]
    return Subject(log.flight(ONE_PIPE), uplink, CALM)


def low(subject: Subject, time: float, *, uplink: bool = True) -> float:
    found = bounds(subject, np.array([time]), uplink=uplink)
    assert found is not None
    return float(found[0][0])


def test_a_change_affects_only_its_own_direction() -> None:
    subject = subject_of(
        changed(3.05, True, Direction(delay_ms=120.0), "uplink.delay_ms=120", 0.05)
    )
    assert [low(subject, time) for time in (2.9, 3.1)] == pytest.approx([0.05, 0.12])
    assert low(subject, 3.1, uplink=False) == pytest.approx(0.05)
    assert set_in_flight(subject) == [(pytest.approx(3.0), "uplink.delay_ms=120")]


def test_a_time_line_starts_at_its_change_and_ends_at_the_next() -> None:
    subject = subject_of(
        changed(1.0, True, TIMED, "profile timed"), changed(4.0, True, CALM, "profile calm")
    )
    assert [low(subject, t) for t in (0.5, 1.5, 3.5, 4.5)] == pytest.approx(
        [0.05, 0.02, 0.09, 0.05]
    )
    axes = new_figure(3.0, 2.0).subplots()
    mark_events(axes, subject)
    spans_drawn = [(patch.get_x(), patch.get_x() + patch.get_width()) for patch in axes.patches]
    assert spans_drawn == [pytest.approx((2.0, 4.0))], "the blackout ends with its time line"
    assert (
        "Triangles: the link was set in flight (1: profile timed, at 1.0 s; 2: profile calm, "
        "at 4.0 s)." in legend(subject)
    )


def test_changing_one_value_keeps_the_time_line() -> None:
    timed = TIMED.model_copy(update={"jitter_ms": 5.0})
    subject = subject_of(
        changed(1.0, True, TIMED, "profile timed"),
        changed(2.0, True, timed, "uplink.jitter_ms=5", time_line=1.0),
        changed(2.5, True, TIMED, "uplink.jitter_ms=0", time_line=math.nan),
    )
    assert [low(subject, t) for t in (2.2, 2.9, 3.1)] == pytest.approx([0.015, 0.02, 0.09])


def test_repeated_records_are_no_changes() -> None:
    subject = subject_of(
        changed(-1.0, True, CALM, "", time_line=math.nan),  # the link started as configured
        changed(3.0, True, Direction(delay_ms=9.0), "by hand"),
        changed(5.0, True, Direction(delay_ms=9.0), "by hand", 2.0),  # a repeated record
        changed(3.1, False, Direction(delay_ms=9.0), "by hand"),
    )
    assert len(spans(subject, uplink=True)) == 2
    assert set_in_flight(subject) == [(pytest.approx(3.0), "by hand")]


def test_a_change_before_the_mission_holds_from_its_start() -> None:
    subject = subject_of(changed(-0.5, True, Direction(delay_ms=9.0), "by hand", 300.0))
    assert low(subject, 0.0) == pytest.approx(0.009)
    assert set_in_flight(subject) == []


@pytest.mark.parametrize("count", [4, 8])
def test_numbers_of_close_changes_do_not_overlap(count: int) -> None:
    each = [changed(3.0 + 0.1 * n, True, CALM, f"number {n + 1}") for n in range(count)]
    subject = subject_of(*each, changed(6.0, True, CALM, "the last"))
    with matplotlib.rc_context(RC):
        figure = delay.draw(subject)
        figure.draw_without_rendering()
        for axes in figure.axes:
            labels = [text for text in axes.texts if text.get_text().isdecimal()]
            boxes = [label.get_window_extent() for label in labels]
            assert len(boxes) == count + 1
            overlaps = [a.overlaps(b) for a, b in itertools.combinations(boxes, 2)]
            assert not any(overlaps)
            assert boxes[-1].y0 == pytest.approx(boxes[0].y0), "back in the first row"


def test_the_delay_figure_draws_changes() -> None:
    subject = subject_of(changed(1.0, True, TIMED, "profile timed"))
    with matplotlib.rc_context(RC):
        delay.draw(subject).draw_without_rendering()
    assert "profile timed, at 1.0 s" in delay.caption(subject)
