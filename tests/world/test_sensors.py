"""Odometry for cloud is the truth, or the truth plus seeded noise."""

import numpy as np
import pytest

from cloudrc.messages import Odometry
from cloudrc.world.sensors import Sensors

TRUTH = Odometry(5, (1.0, 2.0, 3.0), (0.6, 0.0, 0.8, 0.0), (4.0, 5.0, 6.0), (7.0, 8.0, 9.0))


def test_noise_has_the_configured_deviation_per_axis():
    position, velocity = 0.005, 0.02
    sensors = Sensors(position, velocity, np.random.default_rng(1))
    samples = [sensors.measure(TRUTH) for _ in range(2000)]
    again = Sensors(position, velocity, np.random.default_rng(1))
    assert again.measure(TRUTH) == samples[0], "the seed decides"
    for name, deviation in (("position", position), ("velocity", velocity)):
        errors = np.array([getattr(s, name) for s in samples]) - getattr(TRUTH, name)
        # 2000 samples: the deviation within 5 %, the mean within 3 standard errors.
        assert errors.std(axis=0) == pytest.approx([deviation] * 3, rel=0.05)
        assert np.all(abs(errors.mean(axis=0)) <= 3.0 * deviation / np.sqrt(2000))
    noisy = samples[-1]
    assert noisy._replace(position=TRUTH.position, velocity=TRUTH.velocity) == TRUTH
    assert {type(x) for x in (*noisy.position, *noisy.velocity)} == {float}
