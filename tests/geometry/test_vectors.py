"""A velocity moves towards another one by at most a step."""

import pytest

from cloudrc.geometry.vectors import step_towards
from cloudrc.messages import ZERO


@pytest.mark.parametrize("step", [1e-9, 0.024, 3.0])
def test_step_towards_moves_by_at_most_a_step(step):
    far = step_towards((1.0, 1.0, 1.0), (4.0, 1.0, 5.0), step)
    assert far == pytest.approx((1 + 0.6 * step, 1, 1 + 0.8 * step), rel=1e-12)
    for share in (0.5, 1.0):
        end = (share * step, 0.0, 0.0)
        assert step_towards(ZERO, end, step) is end
