# SPDX-License-Identifier: Apache-2.0

"""Executor: ask when few actions are left, and merge the answer with them (asynchronous inference).

An action has a number: how many actions had been executed at its observation, plus its place in the
chunk. So the count stands still while the robot has no action, and nothing is skipped then.

Source: the asynchronous inference of LeRobot, without its filter for similar observations.
"""

from __future__ import annotations

from typing import Any

from cloudrc.base.outside.refusal import check_names
from cloudrc.base.outside.values import Quantity
from cloudrc.gym.executors import Chunk
from cloudrc.gym.executors._question import OneQuestion

AGGREGATES = {"latest": 1.0, "weighted": 0.7, "average": 0.5, "conservative": 0.3}
"""Way to merge two actions of one number -> weight of the newer one [1]."""
SHARE = Quantity(ge=0.0, le=1.0)
"""Share of a chunk."""


class Asynchronous(OneQuestion):
    """Plays a queue of numbered actions.

    Args:
        share: The robot asks when at most this share of a chunk is left [1].
        aggregate: Which action counts where two answers overlap: latest, or a mean with the weight
            .7 (weighted), .5 (average) or .3 (conservative) of the newer one.
        patience: Time without an answer after which the robot asks again [s].
    """

    def __init__(
        self, share: float = 0.5, aggregate: str = "weighted", patience: float = 1.0
    ) -> None:
        super().__init__(patience)
        check_names("aggregate", [aggregate], AGGREGATES)
        self._share: float = SHARE.of(share, "share")
        self._weight = AGGREGATES[aggregate]
        self.needs_floats = self._weight != 1.0

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode."""
        super().begin(ticks_late, period_ns)
        self._queue = dict[int, Any]()  # number -> action, all of the newest answer
        self._next = 0  # number of the next action
        self._numbers = {0: 0}  # tick of a question -> number of the first action of its answer
        self._size = 1  # of the newest answer

    def doubt(self, count: int, ticks_late: int) -> str:
        """Say that most steps have no action, if an answer has a single one."""
        if count > 1 or not ticks_late:
            return ""
        return (
            "an answer has one action, and the robot has no other until the next answer; answer "
            "with more actions, or choose executor 'newest'"
        )

    def wants(self, tick: int) -> bool:
        """Return whether few actions are left."""
        return len(self._queue) <= self._share * self._size

    def asks(self, tick: int, observation: Any) -> bool:
        """Return whether the robot sends the observation; then note the number of its action."""
        is_asked = super().asks(tick, observation)
        if is_asked:
            self._numbers[tick] = self._next
        return is_asked

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Merge an answer with the actions that are left, unless it is older than they are."""
        if chunk.basis <= self._answered:
            return
        first, self._size = self._numbers.pop(chunk.basis), len(chunk.actions)
        had, self._queue = self._queue, {}
        for number, action in enumerate(chunk.actions, first):
            if number >= self._next:
                is_new = number not in had
                self._queue[number] = action if is_new else self._merge(had[number], action)
        self._answered = chunk.basis

    def _merge(self, before: Any, action: Any) -> Any:
        """Return an action between an older and a newer one."""
        if self._weight == 1.0:
            return action
        return (1.0 - self._weight) * before + self._weight * action

    def action(self, tick: int) -> Any:
        """Return the next action of the queue."""
        if self._next not in self._queue:
            return None
        self.basis = self._answered
        self._next += 1
        return self._queue.pop(self._next - 1)


build = Asynchronous
