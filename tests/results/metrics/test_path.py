# SPDX-License-Identifier: Apache-2.0

"""The distance between two paths depends on where they lead, not on how fast the robot flies."""

from types import SimpleNamespace

import numpy as np
import pytest

from cloudrc.results.metrics.path import path_of, rms_distance

TURN = np.linspace(0.0, np.pi, 200)
ARC = np.stack([np.cos(TURN), np.sin(TURN), np.ones(200)], axis=1)


def path(places):
    return path_of(SimpleNamespace(truth={"position": np.asarray(places, dtype=float)}))


def test_a_path_is_sampled_every_5_mm_and_a_robot_that_waits_adds_no_samples():
    straight = path([[0, 0, 1], [0.01, 0, 1], [0.01, 0, 1], [0.01, 0, 1], [0.1, 0, 1]])
    assert straight[:, 0] == pytest.approx(np.linspace(0.0, 0.1, 21))
    assert len(path([[0, 0, 1]] * 9)) == 1
    assert path(np.empty((0, 3))).shape == (0, 3)


def test_the_distance_of_a_path_to_itself_is_0():
    assert rms_distance(path(ARC), path(ARC)) == 0.0


@pytest.mark.parametrize(("scale", "distance"), [(1.01, 0.01), (0.98, 0.02)])
def test_the_distance_is_that_to_the_nearest_point(scale, distance):
    """Beside an arc of 1 m, in its plane."""
    other = ARC * (scale, scale, 1.0)
    assert rms_distance(path(other), path(ARC)) == pytest.approx(distance, rel=1e-3)


def test_distances_are_averaged_over_the_length_as_squares():
    """Of 1 m, a quarter is 4 cm beside the line."""
    ideal, flown = path([[0, 0, 1], [1, 0, 1]]), path([[0, 0.04, 1], [0.25, 0.04, 1]])
    flown = np.concatenate([flown, path([[0.25, 0, 1], [1, 0, 1]])])
    assert rms_distance(flown, ideal) == pytest.approx(0.02, rel=0.01)
