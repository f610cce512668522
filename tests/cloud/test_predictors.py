"""Predictors by hand-worked numbers."""

from math import pi, sqrt

import pytest

from cloudrc.cloud.predictors import (
    commanded_velocity,
    constant_acceleration,
    constant_velocity,
    last_sample,
)
from cloudrc.messages import UPRIGHT, Command, Odometry

HALF = sqrt(0.5)
SAMPLE = Odometry(
    stamp_ns=1_000_000_000,
    position=(1.0, 2.0, 3.0),
    orientation_wxyz=UPRIGHT,
    velocity=(0.5, -1.0, 2.0),
    angular_velocity_body=(0.0, 0.0, pi / 2),
)
TURNING = [constant_velocity, commanded_velocity, constant_acceleration]


def command(velocity):
    return Command(0, 0, 0, velocity, 0.0)


def accelerate(predictor, velocities, period_ns=10_000_000):
    """Let the predictor observe these x velocities; return the last sample."""
    for k, velocity in enumerate(velocities):
        sample = SAMPLE._replace(stamp_ns=k * period_ns, velocity=(velocity, 0.0, 0.0))
        predictor.observe(sample)
    return sample


def test_last_sample_moves_nothing_but_the_stamp():
    prediction = last_sample.build().predict(SAMPLE, 0.1)
    assert prediction == SAMPLE._replace(stamp_ns=1_100_000_000)


def test_constant_velocity_is_equation_3():
    prediction = constant_velocity.build().predict(SAMPLE, 0.1)
    assert prediction.stamp_ns == 1_100_000_000
    assert prediction.position == pytest.approx((1.05, 1.9, 3.2))
    assert prediction.velocity == SAMPLE.velocity
    assert prediction.angular_velocity_body == SAMPLE.angular_velocity_body


@pytest.mark.parametrize("module", TURNING)
def test_a_quarter_turn_about_z_takes_one_second_at_half_pi(module):
    prediction = module.build().predict(SAMPLE, 1.0)
    assert prediction.orientation_wxyz == pytest.approx((HALF, 0.0, 0.0, HALF))


@pytest.mark.parametrize("module", TURNING)
def test_the_rate_turns_about_the_axes_of_the_body(module):
    rolled = SAMPLE._replace(orientation_wxyz=(HALF, HALF, 0.0, 0.0))
    prediction = module.build().predict(rolled, 1.0)
    # q * exp(z): about the world's z axis it would be (.5, .5, .5, .5).
    assert prediction.orientation_wxyz == pytest.approx((0.5, 0.5, -0.5, 0.5))


@pytest.mark.parametrize("module", TURNING)
def test_a_body_that_does_not_turn_keeps_its_orientation(module):
    still = SAMPLE._replace(angular_velocity_body=(0.0, 0.0, 0.0))
    assert module.build().predict(still, 1.0).orientation_wxyz == UPRIGHT


def test_commanded_velocity_uses_the_last_command():
    predictor = commanded_velocity.build()
    predictor.commanded(command((9.0, 9.0, 9.0)))
    predictor.commanded(command((1.0, 0.0, -2.0)))
    prediction = predictor.predict(SAMPLE, 0.2)
    assert prediction.position == pytest.approx((1.2, 2.0, 2.6))
    assert prediction.velocity == SAMPLE.velocity


def test_commanded_velocity_stands_still_without_a_command():
    predictor = commanded_velocity.build()
    assert predictor.predict(SAMPLE, 0.2).position == SAMPLE.position
    predictor.commanded(command((1.0, 0.0, 0.0)))
    predictor.reset()
    assert predictor.predict(SAMPLE, 0.2).position == SAMPLE.position


def test_constant_acceleration_uses_recent_velocities():
    predictor = constant_acceleration.build()
    newest = accelerate(predictor, [0.0, 0.1, 0.2])  # 10 m/s^2
    prediction = predictor.predict(newest, 0.1)
    # x: 1 + .2 * .1 + .5 * 10 * .01; v: .2 + 10 * .1
    assert prediction.position == pytest.approx((1.07, 2.0, 3.0))
    assert prediction.velocity == pytest.approx((1.2, 0.0, 0.0))
    assert prediction.stamp_ns == 120_000_000


def test_constant_acceleration_ignores_a_repeated_or_late_stamp():
    predictor, other = constant_acceleration.build(), constant_acceleration.build()
    newest = accelerate(predictor, [0.0, 0.1, 0.2])
    accelerate(other, [0.0, 0.1, 0.2])
    predictor.observe(newest._replace(velocity=(5.0, 5.0, 5.0)))
    predictor.observe(newest._replace(stamp_ns=5_000_000, velocity=(5.0, 5.0, 5.0)))
    assert predictor.predict(newest, 0.1) == other.predict(newest, 0.1)


def test_constant_acceleration_forgets_samples_before_its_window():
    predictor = constant_acceleration.build(window=0.02)
    newest = accelerate(predictor, [0.0, 5.0, 6.0, 6.0, 6.0])
    assert predictor.predict(newest, 0.1).velocity == pytest.approx((6.0, 0.0, 0.0))


def test_constant_acceleration_starts_anew_after_a_gap():
    predictor = constant_acceleration.build()
    accelerate(predictor, [0.0, 1.0])
    late = SAMPLE._replace(stamp_ns=10_000_000_000, velocity=(3.0, 0.0, 0.0))
    predictor.observe(late)
    assert predictor.predict(late, 0.1).velocity == pytest.approx((3.0, 0.0, 0.0))


@pytest.mark.parametrize("window", [0.0, -0.1, float("nan"), "short"])
def test_constant_acceleration_refuses_a_window_without_length(window):
    with pytest.raises(ValueError, match=r"^window: "):
        constant_acceleration.build(window=window)
