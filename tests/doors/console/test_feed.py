# SPDX-License-Identifier: Apache-2.0

"""What the console shows follows from the statuses of the robot."""

from math import isnan

import pytest

from cloudrc.config.world import ResolvedWorld
from cloudrc.doors.console.feed import (
    CHARTED_FROM,
    DOWNLINK,
    ERROR,
    ESTIMATE,
    SPEED,
    STALE,
    UPLINK,
    FlightFeed,
)
from cloudrc.physics.geometry.scene import load_scene
from cloudrc.wire.messages import GuardState
from tests.doors.console.conftest import control, status


@pytest.fixture
def feed():
    return FlightFeed()


def test_the_downlink_s_delay_is_round_trip_minus_uplink(feed):
    first = control(0.1, rtt=0.080, horizon=0.085)
    feed.take(status(0.1, control=first, uplink_delay=0.030), 1.0)
    sample = feed.samples[-1]
    assert (sample[UPLINK], sample[ESTIMATE]) == (0.030, 0.085)
    assert sample[DOWNLINK] == pytest.approx(0.050)
    # The round trip is the old one: the new delay of the uplink says nothing about it.
    feed.take(status(0.2, control=control(0.2, rtt=0.080), uplink_delay=0.060), 1.1)
    assert feed.samples[-1][DOWNLINK] == pytest.approx(0.050)


def test_error_and_speed_are_those_of_the_newest_status(feed):
    near = control(0.1, setpoint=(0.0, 0.3, 1.4))
    feed.take(status(0.1, control=near, velocity=(0.6, 0.0, -0.8)), 1.0)
    assert feed.samples[-1][CHARTED_FROM:] == [pytest.approx(0.5)]
    assert feed.columns()[-1].tolist() == [pytest.approx(0.5)]
    assert feed.samples[-1][SPEED] == pytest.approx(1.0)


def test_a_prediction_is_compared_at_its_own_instant(feed):
    for step in range(8):  # 1 m/s; each prediction for 60 ms later is 20 mm too far
        at, x = 0.03 * step, 0.03 * step
        ahead = control(at, at, measured=(x, 0, 1), position=(x + 0.08, 0, 1), horizon=0.06)
        feed.take(status(at, control=ahead), 1.0 + at)
    assert isnan(feed.samples[0][ERROR])
    assert feed.samples[-1][ERROR] == pytest.approx(0.020)


def test_error_and_estimate_are_unknown_without_control(feed):
    feed.take(status(0.1, control=control(0.1)), 1.0)
    assert feed.control(1.0)
    assert not feed.control(1.0 + STALE)
    feed.take(status(0.7, control=control(0.1)), 1.6)  # no new command
    feed.take(status(0.8, control=control(0.8), guard=GuardState.GROUND), 1.7)
    for sample in [*feed.samples][1:]:
        assert isnan(sample[CHARTED_FROM])
        assert isnan(sample[ESTIMATE])


def test_the_trail_is_coloured_by_the_clearance_from_the_pipes():
    feed = FlightFeed(load_scene("pipes").tubes, ResolvedWorld(robot="pelican").files.hull)
    feed.take(status(0.1, (0.5, 0.0, 0.7)), 1.0)
    feed.take(status(0.2, (0.505, 0.0, 0.7)), 1.1)  # too near to be a new point
    feed.take(status(0.3, (0.7, 0.0, 0.7)), 1.2)
    points, clearances = feed.trail()
    assert points.tolist() == [[0.5, 0.0, 0.7], [0.7, 0.0, 0.7]]
    assert clearances[1] == pytest.approx(clearances[0] + 0.2, abs=0.01)
    feed.take(status(0.4, (0.0, 0.0, 0.1)), 1.3)  # reset
    assert feed.trail()[0].tolist() == [[0.0, 0.0, 0.1]]
