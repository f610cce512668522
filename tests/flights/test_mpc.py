# SPDX-License-Identifier: Apache-2.0

"""Model predictive control flies every robot over a slow and lossy link, closer to the path."""

import pytest

from tests.conftest import nightly
from tests.flights.conftest import both_ways, fly, numbers

PLANS = ("cloud.predictor=model_based", "cloud.estimator=earliest", "cloud.plan_s=0.4")
FLIGHTS = {
    "pelican": ("fast", "mission=legs"),
    "x2": ("fast", "mission=legs", "world.robot=x2"),
    "nano": ("fast", "mission=legs", "world.robot=nano"),
    "rover": ("pillars", *PLANS, "cloud.freeze_after_s=0.6"),
}
PATH_MAX = {"pelican": 0.015, "x2": 0.015, "nano": 0.04, "rover": 0.3}
"""Largest RMS distance from the path [m]; the rover's setpoint jumps, and it cuts the corners."""


@pytest.mark.parametrize("robot", ["x2", *nightly("pelican", "nano", "rover")])
@pytest.mark.parametrize("rtt", [400, *nightly(0, 1000)])
def test_it_succeeds_near_the_path(robot, rtt):
    experiment, *settings = FLIGHTS[robot]
    slow = ["guard.command_age_max_ms=1300", "cloud.horizon_max_s=1.2"]
    link = ["link.profile=ideal", *both_ways(delay_ms=rtt / 2, loss=0.1)]
    flight = fly(experiment, "cloud.controller=mpc", *settings, *slow, *link)
    assert flight.verdict.failures == ()
    assert numbers(flight)["cross_track_rms"] < PATH_MAX[robot]
