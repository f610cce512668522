"""Estimator: the exact age of the odometry, plus the shortest delay of recent commands.

For plans (`cloud.plan_s`): a plan begins when its command can arrive at the earliest. World skips
the first part of a plan that arrives later, so that this delay needs no estimate.

Source: docs/reference/control.md, "Plans".
"""

from __future__ import annotations

from collections import deque

from cloudrc.cloud.estimators import Estimator
from cloudrc.config.schema import Count


class Earliest(Estimator):
    """Takes the minimum over the last applied commands."""

    def __init__(self, count: int) -> None:
        self._offsets: deque[float] = deque(maxlen=count)

    def add_applied(self, applied_minus_stamp: float) -> None:
        """Note one `applied_minus_stamp` [s]: a delay and the offset between the clocks."""
        self._offsets.append(applied_minus_stamp)

    def horizon(self, age: float) -> float:
        """Return the shortest time from odometry to command [s]; `age` [s] has the same offset."""
        return max(0.0, age + min(self._offsets)) if self._offsets else 0.0


def build(count: Count = 200) -> Earliest:
    """Make the estimator.

    Args:
        count: Number of commands in the minimum [1], at least 1.
    """
    return Earliest(count)
