"""Odometry for cloud is the truth, or the truth plus seeded noise."""

import numpy as np
import pytest

from cloudrc.config import disturbances
from cloudrc.messages import Odometry
from cloudrc.world.sensors import Sensors

TRUTH = Odometry(5, (1.0, 2.0, 3.0), (0.6, 0.0, 0.8, 0.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0))


def sensors(**errors):
    return Sensors(
        disturbances.SensorsConfig(**errors), np.random.default_rng(1), np.random.default_rng(2)
    )


def test_attitude_and_rate_have_their_bias_about_the_body_axes():
    errors = {"attitude_bias_deg": (0.0, 0.0, 90.0), "rate_bias_radps": (0.1, -0.2, 0.3)}
    biased = sensors(**errors).measure(TRUTH)
    half = np.sqrt(0.5)  # (.6 + .8 j) (half + half k) = .6 half + .8 half i + .8 half j + .6 half k
    assert biased.orientation_wxyz == pytest.approx(
        (0.6 * half, 0.8 * half, 0.8 * half, 0.6 * half)
    )
    assert biased.angular_velocity_body == pytest.approx((7.1, 7.8, 9.3))
    same = TRUTH.position, TRUTH.velocity
    assert (biased.position, biased.velocity) == same


def test_noise_has_the_configured_deviation_per_axis():
    """Noise of attitude and rate does not change that of position and velocity."""
    errors = {"position_noise_m": 0.005, "velocity_noise_mps": 0.02}
    turns = {"attitude_noise_deg": float(np.degrees(0.01)), "rate_noise_radps": 0.05}
    plain, noisy = sensors(**errors), sensors(**errors, **turns)
    pairs = [(plain.measure(TRUTH), noisy.measure(TRUTH)) for _ in range(2000)]
    assert all(a.position == b.position and a.velocity == b.velocity for a, b in pairs)
    deviations = {"position": 0.005, "velocity": 0.02, "angular_velocity_body": 0.05}
    for name, deviation in deviations.items():
        errors = np.array([getattr(b, name) for _, b in pairs]) - getattr(TRUTH, name)
        # 2000 samples: the deviation within 5 %, the mean within 3 standard errors.
        assert errors.std(axis=0) == pytest.approx([deviation] * 3, rel=0.05)
        assert np.all(abs(errors.mean(axis=0)) <= 3.0 * deviation / np.sqrt(2000))
    products = [2 * np.dot(TRUTH.orientation_wxyz, b.orientation_wxyz) ** 2 - 1 for _, b in pairs]
    assert np.sqrt(np.mean(np.arccos(products) ** 2)) == pytest.approx(0.01 * np.sqrt(3), rel=0.05)
    last = pairs[-1][0]
    assert last._replace(position=TRUTH.position, velocity=TRUTH.velocity) == TRUTH
    assert {type(x) for x in (*last.position, *last.velocity)} == {float}
