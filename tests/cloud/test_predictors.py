# SPDX-License-Identifier: Apache-2.0

"""Predictors by hand-worked numbers."""

from math import pi, sqrt

import pytest

from cloudrc.cloud.predictors import commanded_velocity, constant_acceleration, constant_velocity
from cloudrc.wire.messages import UPRIGHT, Command, Odometry

HALF = sqrt(0.5)
SAMPLE = Odometry(1_000_000_000, (1.0, 2.0, 3.0), UPRIGHT, (0.5, -1.0, 2.0), (0.0, 0.0, pi / 2))


def test_constant_velocity_is_equation_3():
    stamp_ns, position, _, *rates = constant_velocity.build().predict(SAMPLE, 0.1)
    assert (stamp_ns, position) == (1_100_000_000, pytest.approx((1.05, 1.9, 3.2)))
    assert rates == [SAMPLE.velocity, SAMPLE.angular_velocity_body]


@pytest.mark.parametrize("module", [constant_velocity, commanded_velocity, constant_acceleration])
@pytest.mark.parametrize(
    ("before", "after"),
    [
        (UPRIGHT, (HALF, 0.0, 0.0, HALF)),  # a quarter turn in 1 s
        # About the body's axes: about the world's z axis it would be (.5, .5, .5, .5).
        ((HALF, HALF, 0.0, 0.0), (0.5, 0.5, -0.5, 0.5)),
    ],
)
def test_the_rate_turns_about_the_axes_of_the_body(module, before, after):
    turning = SAMPLE._replace(orientation_wxyz=before)
    assert module.build().predict(turning, 1.0).orientation_wxyz == pytest.approx(after)


def test_commanded_velocity_uses_the_last_command():
    predictor = commanded_velocity.build()
    for velocity in ((9.0, 9.0, 9.0), (1.0, 0.0, -2.0)):
        predictor.commanded(Command(0, 0, 0, velocity, 0.0))
    prediction = predictor.predict(SAMPLE, 0.2)
    assert prediction.position == pytest.approx((1.2, 2.0, 2.6))
    assert prediction.velocity == SAMPLE.velocity
    assert commanded_velocity.build().predict(SAMPLE, 0.2).position == SAMPLE.position


def accelerated(velocities, window=0.05, more=()):
    """Return a prediction by 0.1 s after these x velocities, 10 ms apart."""
    predictor = constant_acceleration.build(window=window)
    for k, velocity in enumerate(velocities):
        newest = SAMPLE._replace(stamp_ns=k * 10_000_000, velocity=(velocity, 0.0, 0.0))
        predictor.observe(newest)
    for stamp_ns in more:
        predictor.observe(newest._replace(stamp_ns=stamp_ns, velocity=(5.0, 5.0, 5.0)))
    return predictor.predict(newest, 0.1)


def test_constant_acceleration_uses_the_velocities_of_its_window():
    prediction = accelerated([0.0, 0.1, 0.2])  # 10 m/s^2
    # x: 1 + .2 * .1 + .5 * 10 * .01; v: .2 + 10 * .1
    assert prediction.position == pytest.approx((1.07, 2.0, 3.0))
    assert prediction.velocity == pytest.approx((1.2, 0.0, 0.0))
    assert accelerated([0.0, 0.1, 0.2], more=(20_000_000, 5_000_000)) == prediction, "late stamps"
    settled = accelerated([0.0, 5.0, 6.0, 6.0, 6.0], window=0.02)
    assert settled.velocity == pytest.approx((6.0, 0.0, 0.0))
    after_a_gap = accelerated([0.0, 1.0], more=(10_000_000_000,))
    assert after_a_gap.velocity == pytest.approx((1.0, 0.0, 0.0))
