"""Executor: play a whole chunk from its beginning, then ask for the next one and wait for it.

This is what a client does that asks only when its chunk is used up.
"""

from __future__ import annotations

from typing import Any

from cloudrc.gym.executors.newest import Newest


class Broker(Newest):
    """One observation leaves per chunk. If no answer comes, the robot asks again."""

    needs_chunk = True

    def __init__(self, patience: float) -> None:
        """Wait for `patience` [s] before asking again."""
        self._patience = patience

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode; the observation of tick 0 is the first question."""
        super().begin(ticks_late, period_ns)
        self._asked, self._waits = 0, self._patience * 1e9 / period_ns

    def asks(self, tick: int, observation: Any) -> bool:
        """Return whether the chunk is used up and no question is under way."""
        is_used_up = tick >= self._start + len(self._chunk.actions)
        is_open = self._asked > self._chunk.basis and tick - self._asked < self._waits
        if is_used_up and not is_open:
            self._asked = tick
            return True
        return False


def build(patience: float = 1.0) -> Broker:
    """Make the executor.

    Args:
        patience: Time without an answer after which the robot asks again [s].
    """
    return Broker(patience)
