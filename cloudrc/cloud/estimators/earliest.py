# SPDX-License-Identifier: Apache-2.0

"""Estimator: the exact age of the odometry, plus the shortest delay of recent commands.

Use it with plans (`cloud.plan_s`): a plan begins at the earliest possible arrival of its command.
If the command arrives later, world skips the beginning of the plan.

Source: docs/reference/control.md, "Plans".
"""

from __future__ import annotations

from collections import deque

from cloudrc.cloud.estimators import Estimator
from cloudrc.config.cloud import Count


class Earliest(Estimator):
    """Estimator: the odometry's age plus the smallest delay of the last `count` commands.

    Args:
        count: Number of recent commands whose smallest delay is used [1]; at least 1.
    """

    def __init__(self, count: Count = 200) -> None:
        self._offsets: deque[float] = deque(maxlen=count)

    def add_applied(self, applied_minus_stamp: float) -> None:
        """Store `applied_minus_stamp` [s]: downlink delay of a command minus the clock offset."""
        self._offsets.append(applied_minus_stamp)

    def horizon(self, age: float) -> float:
        """Return the horizon [s]; 0 before the first echo of a command.

        The horizon is `age`, the age of the odometry, plus the smallest stored delay of a command.
        The clock offset adds to `age` and reduces the delay, so the sum does not contain it.
        """
        return max(0.0, age + min(self._offsets)) if self._offsets else 0.0


build = Earliest
