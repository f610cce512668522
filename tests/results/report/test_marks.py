# SPDX-License-Identifier: Apache-2.0

"""Figures show the delays of the link profile, and mark changes of the link and HOLD."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cloudrc.config.faults import FaultConfig
from cloudrc.config.profile import ChangeConfig, DirectionConfig
from cloudrc.results.report.figures.marks import HELD, bounds, legend, mark_events
from cloudrc.results.report.figures.style import Subject, new_figure
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry
from cloudrc.wire.records import GroundTruth, GuardChange, LinkChanged
from tests.results.metrics.conftest import ONE_PIPE, at, flown

CALM = DirectionConfig(delay_ms=50.0)


def subject_of(*more, uplink=CALM, log=None):
    """Return what figures show of a flight in which world recorded more."""
    log = log or flown()
    log.world += more
    return Subject(log.flight(ONE_PIPE), uplink, CALM)


def band(subject, time):
    """Return the bounds of the uplink's delay [ms] at a time since the start of the flight [s]."""
    return bounds(subject, np.array([time]), uplink=True)[:, 0].tolist()


def test_the_band_follows_the_profile():
    steps = (ChangeConfig(at_s=5.0, delay_ms=70.0), ChangeConfig(at_s=9.0, jitter_ms=5.0))
    timed = DirectionConfig(delay_ms=5.0, jitter_ms=20.0, changes=steps)
    # The link started one second before the mission. A delay is never negative.
    assert band(subject_of(uplink=timed), 3.99) == pytest.approx((0, 25))
    assert band(subject_of(uplink=timed), 4.0) == pytest.approx((50, 90))


def test_a_profile_that_another_version_recorded_is_left_out():
    unknown = '{"delay_ms": 5, "ecn": true}'
    change = LinkChanged(at(2.0), True, "relay", "", *(0.0,) * 5, math.nan, unknown)
    assert band(subject_of(change), 3.0) == pytest.approx((50, 50))


def test_holds_are_marked():
    assert legend(subject_of()) == ""
    hold = GuardChange(at(2), GuardState.HOLD, "command age")
    subject = subject_of(hold, GuardChange(at(3), GuardState.TRACK, "fresh command"))
    assert legend(subject) == HELD
    axes = new_figure(2.0, 3.0).subplots()
    mark_events(axes, subject)
    (patch,) = axes.patches
    assert (patch.get_x(), patch.get_width()) == pytest.approx((2.0, 1.0))


LINK_STATE = LinkChanged(at(0.5), True, "relay", "", 0.0, 3.25, *(0.0,) * 4, "{}")
VIRTUAL = GroundTruth(0, Odometry(0, ZERO, UPRIGHT, ZERO, ZERO), ZERO)


@pytest.mark.parametrize(
    ("more", "begin"),
    [
        ((), 1.0),  # telemetry began one second before the mission
        ((LINK_STATE,), 2.0 + 0.5 - 3.25),
        ((VIRTUAL,), 2.0 - at(0.0) * 1e-9),
    ],
)
def test_faults_are_marked_where_the_link_has_come_up(more, begin):
    fault = FaultConfig(kind="partition", at_s=2.0, duration_s=0.5)
    log = flown()
    log.world[:0] = more
    subject = replace(subject_of(log=log), faults=(fault,))
    assert "(partition, 2 to 2.5 s since the link came up)" in legend(subject)
    axes = new_figure(2.0, 3.0).subplots()
    mark_events(axes, subject)
    (patch,) = axes.patches
    assert (patch.get_x(), patch.get_width()) == pytest.approx((begin, 0.5))
