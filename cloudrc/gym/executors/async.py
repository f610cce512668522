"""Executor: ask when few actions are left, and merge the answer with them (asynchronous inference).

An action has a number: how many actions had been executed at its observation, plus its place in the
chunk. So the count stands still while the robot has no action, and nothing is skipped then.

Source: the asynchronous inference of LeRobot, without its filter for similar observations.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cloudrc.gym.executors import Chunk, Executor
from cloudrc.outside.refusal import check_names
from cloudrc.outside.values import Quantity

AGGREGATES = {"latest": 1.0, "weighted": 0.7, "average": 0.5, "conservative": 0.3}
"""Way to merge two actions of one number -> weight of the newer one [1]."""
SHARE = Quantity(ge=0.0, le=1.0)
"""Share of a chunk."""
PATIENCE = Quantity("s", gt=0.0, le=3600.0)
"""Time without an answer after which the robot asks again."""


class Asynchronous(Executor):
    """Plays a queue of numbered actions; one question is open at a time."""

    def __init__(self, share: float, aggregate: str, patience: float) -> None:
        """See `build`; `share` [1], `patience` [s]."""
        check_names("aggregate", [aggregate], AGGREGATES)
        self._share, self._weight = SHARE.of(share, "share"), AGGREGATES[aggregate]
        self._patience = PATIENCE.of(patience, "patience")

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode; the observation of tick 0 is the first question."""
        self._queue = dict[int, tuple[Any, int]]()  # number -> action, and tick of its observation
        self._next = 0  # number of the next action
        self._numbers = {0: 0}  # tick of a question -> number of the first action of its answer
        self._asked, self._answered = 0, -1
        self._size = 1
        self._waits = self._patience * 1e9 / period_ns

    def asks(self, tick: int, observation: Any) -> bool:
        """Return whether few actions are left, and no question is under way."""
        is_open = self._asked > self._answered and tick - self._asked < self._waits
        if is_open or len(self._queue) > self._share * self._size:
            return False
        self._asked, self._numbers[tick] = tick, self._next
        return True

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Merge an answer with the actions that are left, unless it is older than they are."""
        if chunk.basis <= self._answered:
            return
        first, self._size = self._numbers.pop(chunk.basis), len(chunk.actions)
        merged = {}
        for number, action in enumerate(chunk.actions, first):
            if number in self._queue:
                before, _ = self._queue[number]
                action = self._merge(before, action)
            if number >= self._next:
                merged[number] = action, chunk.basis
        self._queue, self._answered = merged, chunk.basis

    def _merge(self, before: Any, action: Any) -> Any:
        """Return an action between an older and a newer one."""
        if self._weight == 1.0:
            return action
        if np.asarray(action).dtype.kind != "f":
            raise ValueError(
                "executor 'async' computes means of actions, which must be floating-point numbers; "
                "for other actions give aggregate=latest"
            )
        return (1.0 - self._weight) * before + self._weight * action

    def action(self, tick: int) -> Any:
        """Return the next action of the queue."""
        if self._next not in self._queue:
            return None
        action, self.basis = self._queue.pop(self._next)
        self._next += 1
        return action


def build(share: float = 0.5, aggregate: str = "weighted", patience: float = 1.0) -> Asynchronous:
    """Make the executor.

    Args:
        share: The robot asks when at most this share of a chunk is left [1].
        aggregate: Which action counts where two answers overlap: latest, or a mean with the weight
            .7 (weighted), .5 (average) or .3 (conservative) of the newer one.
        patience: Time without an answer after which the robot asks again [s].
    """
    return Asynchronous(share, aggregate, patience)
