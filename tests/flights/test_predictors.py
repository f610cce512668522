# SPDX-License-Identifier: Apache-2.0

"""Predictors that replay commands: their errors at fast gains, and long links."""

import numpy as np
import pytest

from tests.conftest import nightly_rows
from tests.flights.conftest import both_ways, fly, numbers

pytestmark = pytest.mark.usefixtures("shared_files")

FAST = (
    "cloud.controller={name: pid, gain_p: [2.5, 2.5, 3.0], gain_d: [0.5, 0.5, 0.0]}",
    "world.onboard.integral_limit_xy=0.3",
    "cloud.estimator=split",
    "mission.steps.count=2",
)
BOX = "{name: model_based, integral_limit_xy: 0.3}"
FILTERED = "{name: kalman, parameters: {integral_limit_xy: 0.3}}"
LONG = both_ways(delay_ms=70, jitter_ms=40)


@pytest.mark.parametrize(
    ("predictor", "millimetres"), [("command_history", 8.0), (BOX, 3.0), (FILTERED, 3.5)]
)
def test_a_replay_knows_where_the_robot_will_be(predictor, millimetres):
    flight = fly("steps", *FAST, *LONG, f"cloud.predictor={predictor}")
    assert flight.verdict.failures == ()
    n = numbers(flight)
    assert n["estimate_error_rms"] < millimetres * 1e-3
    assert n["prediction_error_rms"] < 12.5e-3


@pytest.mark.parametrize(
    ("predictor", "each_way_ms"),
    [("command_history", 500), (BOX, 500), *nightly_rows((BOX, 1000))],
)
def test_a_replay_is_stable_at_round_trips_of_seconds(predictor, each_way_ms):
    limits = (
        *both_ways(delay_ms=each_way_ms, jitter_ms=0),
        f"guard.command_age_max_ms={2 * each_way_ms + 150}",
        f"cloud.horizon_max_s={2e-3 * each_way_ms + 0.2}",
        "cloud.controller.speed_max=2.3",
    )
    flight = fly("steps", *FAST, *limits, f"cloud.predictor={predictor}")
    assert flight.verdict.failures == ()


def test_before_the_first_echo_the_start_shows_the_delay():
    """On the ground, cloud knows no delay but the round trip of the operator's request."""
    link = both_ways(delay_ms=100, jitter_ms=0)
    control = fly("steps", "mission.steps.count=1", *link).flight.control
    first = control["horizon"][:10]
    assert np.isnan(control["rtt"][:10]).all()
    assert first == pytest.approx(np.full(10, 0.2), abs=0.02)
