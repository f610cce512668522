# SPDX-License-Identifier: Apache-2.0

"""Executor: as time_indexed, but the policy knows the actions that are executed before its answer.

They travel with the observation. The policy begins its chunk with them and continues from the state
to which they lead.
"""

from __future__ import annotations

from cloudrc.gym.executors import Committed
from cloudrc.gym.executors.time_indexed import TimeIndexed


class Prefix(TimeIndexed):
    """Sends the actions for the ticks in which no answer can have arrived."""

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode; the prefix has at most `ticks_late` actions."""
        super().begin(ticks_late, period_ns)
        self._late = ticks_late

    def committed(self, tick: int) -> Committed:
        """Return the actions from this tick on, as far as the robot has them."""
        actions = self._chunk.actions[tick - self._chunk.basis :][: self._late]
        return Committed(actions, len(actions))


build = Prefix
