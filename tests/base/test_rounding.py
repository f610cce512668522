# SPDX-License-Identifier: Apache-2.0

"""Numbers that are equal up to rounding are equal."""

from math import inf, nan

import numpy as np
import pytest

from cloudrc.base.rounding import differences, exceeds


@pytest.mark.parametrize(
    ("a", "b", "difference"),
    [
        (0.3, 0.1 + 0.2, 0.0),
        (1.0, 1.5, 0.5),
        (0.0, 7e-14, 0.0),  # 0 has no size of which it could be a share
        (3e-13, -3e-13, 0.0),
        (0.0, 2e-12, 2e-12),
    ],
)
def test_a_difference_below_rounding_is_none(a, b, difference):
    assert differences(a, b) == difference
    assert exceeds(b, a) == (difference > 0.0)
    assert exceeds(a, b) == (difference < 0.0)


def test_differences_of_arrays_are_taken_one_by_one():
    assert differences([0.3, 1.0], [0.1 + 0.2, 2.0]).tolist() == [0.0, 1.0]
    assert np.isnan(differences(nan, 1.0))
    assert not exceeds(3.0, inf)
