"""Executor: play a whole chunk from its beginning, then ask for the next one and wait for it.

This is what a client does that asks only when its chunk is used up.
"""

from __future__ import annotations

from cloudrc.gym.executors._question import OneQuestion
from cloudrc.gym.executors.newest import Newest


class Broker(OneQuestion, Newest):
    """One observation leaves per chunk. If no answer comes, the robot asks again."""

    needs_chunk = True

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode."""
        OneQuestion.begin(self, ticks_late, period_ns)
        Newest.begin(self, ticks_late, period_ns)

    def answered(self) -> int:
        """Return the tick of the observation to which the chunk is the answer."""
        return self._chunk.basis

    def wants(self, tick: int) -> bool:
        """Return whether the chunk is used up."""
        return tick >= self._start + len(self._chunk.actions)


def build(patience: float = 1.0) -> Broker:
    """Make the executor.

    Args:
        patience: Time without an answer after which the robot asks again [s].
    """
    return Broker(patience)
