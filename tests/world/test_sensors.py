# SPDX-License-Identifier: Apache-2.0

"""Odometry for cloud is the truth, or the truth plus seeded noise."""

import numpy as np
import pytest

from cloudrc.config import disturbances
from cloudrc.wire.messages import Odometry
from cloudrc.world.sensors import Sensors

TRUTH = Odometry(5, (1.0, 2.0, 3.0), (0.6, 0.0, 0.8, 0.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0))


def sensors(**errors):
    return Sensors(
        disturbances.SensorsConfig(**errors), np.random.default_rng(1), np.random.default_rng(2)
    )


def test_attitude_and_rate_have_their_bias_about_the_body_axes():
    errors = {"attitude_bias_deg": (0.0, 0.0, 90.0), "rate_bias_radps": (0.1, -0.2, 0.3)}
    biased = sensors(**errors).measure(TRUTH)
    # (.6 + .8 j) (1 + k) = .6 + .8 i + .8 j + .6 k, and all by the root of a half
    turned = pytest.approx(np.sqrt(0.5) * np.array((0.6, 0.8, 0.8, 0.6)))
    expected = TRUTH._replace(orientation_wxyz=turned)
    assert biased == expected._replace(angular_velocity_body=pytest.approx((7.1, 7.8, 9.3)))


def test_noise_has_the_configured_deviation_per_axis():
    """Noise of attitude and rate does not change that of position and velocity."""
    errors = {"position_noise_m": 0.005, "velocity_noise_mps": 0.02}
    turns = {"attitude_noise_deg": float(np.degrees(0.01)), "rate_noise_radps": 0.05}
    plain, noisy = (
        [one.measure(TRUTH) for _ in range(2000)]
        for one in (sensors(**errors), sensors(**errors, **turns))
    )
    parts = {"orientation_wxyz": TRUTH.orientation_wxyz}
    parts["angular_velocity_body"] = TRUTH.angular_velocity_body
    assert plain == [each._replace(**parts) for each in noisy]
    deviations = {"position": 0.005, "velocity": 0.02, "angular_velocity_body": 0.05}
    for name, deviation in deviations.items():
        errors = np.array([getattr(each, name) for each in noisy]) - getattr(TRUTH, name)
        # 2000 samples: the deviation within 5 %, the mean within 3 standard errors.
        assert errors.std(axis=0) == pytest.approx([deviation] * 3, rel=0.05)
        assert np.all(abs(errors.mean(axis=0)) <= 3.0 * deviation / np.sqrt(2000))
    turned = np.array([each.orientation_wxyz for each in noisy]) @ TRUTH.orientation_wxyz
    angles = np.arccos(2 * turned**2 - 1)
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(0.01 * np.sqrt(3), rel=0.05)
    assert {type(x) for x in (*plain[0].position, *plain[0].velocity)} == {float}
