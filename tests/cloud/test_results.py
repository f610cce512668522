"""Results of plug-ins: only numbers of the right shape pass, and orientations of length 1."""

from math import cos, sin

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
