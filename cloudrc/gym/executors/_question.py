"""Executors that have one question open at a time, and ask again after a loss."""

from __future__ import annotations

from typing import Any

from cloudrc.gym.executors import Executor
from cloudrc.outside.values import Quantity

PATIENCE = Quantity("s", gt=0.0, le=3600.0)
"""Time without an answer after which the robot asks again."""


class OneQuestion(Executor):
    """Asks when `wants` says so, unless a question is open.

    The observation of tick 0 is the first question.
    """

    def __init__(self, patience: float) -> None:
        """Wait for `patience` [s] before asking again."""
        self._patience = PATIENCE.of(patience, "patience")

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode."""
        self._asked, self._waits = 0, self._patience * 1e9 / period_ns

    def answered(self) -> int:
        """Return the tick of the observation to which the newest answer belongs; -1 if none."""
        raise NotImplementedError

    def wants(self, tick: int) -> bool:
        """Return whether the robot needs a new answer."""
        raise NotImplementedError

    def asks(self, tick: int, observation: Any) -> bool:
        """Return whether the robot sends the observation of this tick."""
        is_open = self._asked > self.answered() and tick - self._asked < self._waits
        if is_open or not self.wants(tick):
            return False
        self._asked = tick
        return True
