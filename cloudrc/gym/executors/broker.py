# SPDX-License-Identifier: Apache-2.0

"""Executor: play a whole chunk from its beginning, then ask for the next one and wait for it.

This is what a client does that asks only when its chunk is used up.
"""

from __future__ import annotations

from cloudrc.gym.executors._question import OneQuestion
from cloudrc.gym.executors.newest import Newest


class Broker(OneQuestion, Newest):
    """One observation leaves per chunk. If no answer comes, the robot asks again.

    Args:
        patience: Time without an answer after which the robot asks again [s].
    """

    needs_chunk = True

    def wants(self, tick: int) -> bool:
        """Return whether the chunk is used up."""
        return tick >= self._start + len(self._chunk.actions)


build = Broker
