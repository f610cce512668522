"""Hover and steps: the steady error of the published limits, and the prediction errors."""

from statistics import mean

import pytest

from tests.flights.conftest import fly, numbers


@pytest.mark.parametrize(("limit", "low", "high"), [(0.10, 0.030, 0.034), (0.30, 0.0, 0.001)])
def test_the_steady_error_is_that_of_the_integral_limit(limit, low, high):
    n = numbers(fly("hover", f"world.low_level.integral_limit_xy={limit}"))
    assert low <= n["steady_error_x"] <= high
    assert n["steady_error_y"] < 1e-4
    assert n["steady_error_z"] < 1e-4


def prediction_error(predictor, seeds):
    settings = ("link.profile=paper-p3", f"cloud.predictor={predictor}")
    flights = [fly("steps", *settings, f"seed={seed}") for seed in seeds]
    return mean(numbers(flight)["prediction_error_rms"] for flight in flights)


def test_constant_velocity_predicts_far_better_than_nothing():
    one = (1,)
    assert prediction_error("constant_velocity", one) < 0.3 * prediction_error("last_sample", one)


@pytest.mark.full
def test_the_prediction_error_is_the_one_expected():
    seeds = range(1, 11)
    assert prediction_error("constant_velocity", seeds) <= 0.013
    assert 0.045 <= prediction_error("last_sample", seeds) <= 0.065


def test_split_estimates_the_delay_better_than_the_running_mean():
    errors = {
        name: numbers(fly("steps", f"cloud.estimator={name}"))["delay_estimate_error_rms"]
        for name in ("running_mean", "split")
    }
    assert errors["split"] < 0.8 * errors["running_mean"]
