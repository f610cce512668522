# SPDX-License-Identifier: Apache-2.0

"""Executors that have one question open at a time, and ask again after a loss."""

from __future__ import annotations

from typing import Any

from cloudrc.base.outside.values import Quantity
from cloudrc.gym.executors import Chunk, Executor

PATIENCE = Quantity("s", gt=0.0, le=3600.0)
"""Time without an answer after which the robot asks again."""


class OneQuestion(Executor):
    """Asks when `wants` says so, unless a question is open.

    The observation of tick 0 is the first question.

    Args:
        patience: Time without an answer after which the robot asks again [s].
    """

    def __init__(self, patience: float = 1.0) -> None:
        self._patience = PATIENCE.of(patience, "patience")

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode."""
        super().begin(ticks_late, period_ns)
        self._waits = self._patience * 1e9 / period_ns
        # Ticks of the newest question, and of that to which the newest answer belongs.
        self._asked, self._answered = 0, -1

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take an answer, and note its question."""
        self._answered = max(self._answered, chunk.basis)
        super().receive(chunk, tick)

    def wants(self, tick: int) -> bool:
        """Return whether the robot needs a new answer."""
        raise NotImplementedError

    def asks(self, tick: int, observation: Any) -> bool:
        """Return whether the robot sends the observation of this tick."""
        is_open = self._asked > self._answered and tick - self._asked < self._waits
        if is_open or not self.wants(tick):
            return False
        self._asked = tick
        return True
