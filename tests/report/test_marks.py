"""Figures show the delays of the link profile, and mark changes of the link and HOLD."""

import json
import math

import numpy as np
import pytest

from cloudrc.config.profile import ChangeConfig, DirectionConfig
from cloudrc.messages import GuardState
from cloudrc.records import GuardChange, LinkChanged
from cloudrc.report.figures.marks import HELD, bounds, legend, mark_events
from cloudrc.report.figures.style import Subject, new_figure
from tests.metrics.conftest import ONE_PIPE, at, flown

CALM = DirectionConfig(delay_ms=50.0)


def changed(time, direction, cause, age=0.0, *, uplink=True):
    conditions = json.dumps(direction.model_dump(mode="json", exclude_defaults=True))
    measured = (0.0, 0.0, 0.0, math.nan)
    return LinkChanged(at(time), uplink, "relay", cause, age, age, *measured, conditions)


def subject_of(*changes, uplink=CALM, log=None):
    log = log or flown()
    log.world += [change for change in changes if change.uplink]
    log.cloud += [change for change in changes if not change.uplink]
    return Subject(log.flight(ONE_PIPE), uplink, CALM)


def band(subject, time, *, uplink=True):
    """Return the bounds of the delay [ms] at a time since the start of the flight [s]."""
    return bounds(subject, np.array([time]), uplink=uplink)[:, 0].tolist()


def test_the_band_follows_the_profile():
    steps = (ChangeConfig(at_s=5.0, delay_ms=70.0), ChangeConfig(at_s=9.0, jitter_ms=5.0))
    timed = DirectionConfig(delay_ms=5.0, jitter_ms=20.0, changes=steps)
    # The link started one second before the mission. A delay is never negative.
    assert band(subject_of(uplink=timed), 3.99) == pytest.approx((0, 25))
    assert band(subject_of(uplink=timed), 4.0) == pytest.approx((50, 90))


def test_a_profile_that_another_version_recorded_is_left_out():
    change = changed(2.0, CALM, "set")._replace(conditions='{"delay_ms": 5, "ecn": true}')
    assert band(subject_of(change), 3.0) == pytest.approx((50, 50))


def test_holds_are_marked():
    assert legend(subject_of()) == ""
    log = flown()
    log.world += [
        GuardChange(at(2), GuardState.HOLD, "command age"),
        GuardChange(at(3), GuardState.TRACK, "fresh command"),
    ]
    subject = subject_of(log=log)
    assert legend(subject) == HELD
    axes = new_figure(2.0, 3.0).subplots()
    mark_events(axes, subject)
    (patch,) = axes.patches
    assert (patch.get_x(), patch.get_width()) == pytest.approx((2.0, 1.0))
