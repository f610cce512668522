# SPDX-License-Identifier: Apache-2.0

"""The truth decides whether the target of a mission was in view."""

import pytest

from cloudrc.config.follow import Follow
from cloudrc.config.schema import MissionConfig
from cloudrc.wire.records import TargetSeen
from tests.results.metrics.conftest import PERIOD, SECOND, START, at, flown, judged, measured

MISSION = MissionConfig(follow=Follow(target="board", lost_after_s=2.0, distance_max_m=6.0))
BESIDE, FAR = (3.0, False), (6.5, True)
"""Distance [m] of a target that is out of view, and whether it is inside the picture."""


def followed(*away):
    """Fly; each of the times `away` has begin and end [s], and how the target is out of view."""
    log = flown()
    for stamp_ns in range(START, at(10) + 1, PERIOD):
        seconds = (stamp_ns - START) / SECOND
        view = next((how for begin, end, how in away if begin <= seconds < end), (3.0, True))
        log.world.append(TargetSeen(stamp_ns, (3.0, 0.0, 1.0), 0.3, *view))
    return log.flight(mission=MISSION)


def lost(flight):
    return [each for each in judged(flight).failures if each.code == "target_lost"]


@pytest.mark.parametrize("how", [BESIDE, FAR])
def test_a_target_out_of_view_for_too_long_is_lost_and_the_flight_goes_on(how):
    flight = followed((1.0, 2.0, how), (4.0, 6.4, how), (7.0, 10.1, how))
    (failure,) = lost(flight)
    assert failure.text.startswith("board was out of view for 2.4 s, ")
    assert failure.text.endswith("lost_after_s 2, and 1 times more")
    assert (failure.time, failure.place) == (pytest.approx(4.0), pytest.approx((4.0, 0.0, 1.0)))
    assert measured(flight, "duration") == 10.0


def test_a_target_may_be_out_of_view_for_a_short_time():
    flight = followed((2.0, 4.0, BESIDE), (8.0, 10.1, FAR))
    assert judged(flight).outcome == "success"
    assert measured(flight, "waypoints_reached") == 1
    assert measured(flight, "out_of_view") == pytest.approx(101 / 251)
    assert measured(flight, "bearing_error_rms") == pytest.approx(0.3)


def test_a_mission_without_a_target_has_no_such_numbers():
    flight = flown().flight()
    assert measured(flight, "out_of_view") is measured(flight, "bearing_error_rms") is None
