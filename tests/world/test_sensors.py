"""Odometry for cloud is the truth, or the truth plus seeded noise."""

import numpy as np
import pytest

from cloudrc.messages import Odometry
from cloudrc.world.sensors import Sensors

TRUTH = Odometry(5, (1.0, 2.0, 3.0), (0.6, 0.0, 0.8, 0.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0))


def test_without_noise_odometry_is_true_and_rng_is_unused():
    rng = np.random.default_rng(1)
    assert Sensors(0.0, 0.0, rng).measure(TRUTH) == TRUTH
    assert rng.random() == np.random.default_rng(1).random()


@pytest.mark.parametrize(("position", "velocity"), [(0.005, 0.0), (0.0, 0.02), (0.005, 0.02)])
def test_noise_has_the_configured_deviation_per_axis(position, velocity):
    sensors = Sensors(position, velocity, np.random.default_rng(1))
    samples = [sensors.measure(TRUTH) for _ in range(2000)]
    places = np.array([s.position for s in samples]) - TRUTH.position
    speeds = np.array([s.velocity for s in samples]) - TRUTH.velocity
    # 2000 samples: the deviation within 5 %, the mean within 3 standard errors.
    assert places.std(axis=0) == pytest.approx([position] * 3, rel=0.05)
    assert speeds.std(axis=0) == pytest.approx([velocity] * 3, rel=0.05)
    assert np.all(abs(places.mean(axis=0)) <= 3.0 * position / np.sqrt(2000))


def test_attitude_and_rates_stay_true_and_numbers_plain():
    odometry = Sensors(0.1, 0.1, np.random.default_rng(1)).measure(TRUTH)
    assert odometry.stamp_ns == 5
    assert odometry.orientation_wxyz == TRUTH.orientation_wxyz
    assert odometry.angular_velocity_body == TRUTH.angular_velocity_body
    assert {type(x) for x in (*odometry.position, *odometry.velocity)} == {float}


def test_the_seed_decides_the_noise():
    def first(seed: int) -> Odometry:
        return Sensors(0.1, 0.1, np.random.default_rng(seed)).measure(TRUTH)

    assert first(1) == first(1)
    assert first(1) != first(2)
