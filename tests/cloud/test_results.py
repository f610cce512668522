"""Results of plug-ins: only numbers of the right shape pass, and orientations of length 1."""

from math import cos, sin, sqrt

import pytest

from cloudrc.cloud.results import check_estimate
from cloudrc.messages import UPRIGHT, ZERO, Odometry
from cloudrc.outside.values import InvalidValueError

SAMPLE = Odometry(7, (1.0, 2.0, 3.0), UPRIGHT, (0.1, 0.2, 0.3), ZERO)


def of_length(length):
    return tuple(length * part for part in (cos(0.3), 0.0, sin(0.3), 0.0))


@pytest.mark.parametrize("length", [0.0, 0.99, 1.01])
def test_an_orientation_that_is_no_rotation_is_refused(length):
    with pytest.raises(
        InvalidValueError, match=r"^its orientation \(.*\) has the length .*, not 1$"
    ):
        check_estimate(SAMPLE._replace(orientation_wxyz=of_length(length)))


@pytest.mark.parametrize("length", [0.9951, 1.0049])
def test_a_length_near_1_is_scaled_away(length):
    orientation = check_estimate(SAMPLE._replace(orientation_wxyz=of_length(length)))[2]
    assert orientation == pytest.approx(of_length(1.0))
    assert sqrt(sum(part * part for part in orientation)) == pytest.approx(1.0, abs=1e-15)
