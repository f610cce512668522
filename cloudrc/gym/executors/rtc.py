# SPDX-License-Identifier: Apache-2.0

"""Executor: real-time chunking; the policy fits its answer to what the robot will have executed.

With the observation travel the actions that are left, and how many of them the robot executes
before the answer arrives. The policy keeps those (they are executed anyway) and changes the others
gently: its in-painting is its own.

Source: K. Black, M. Y. Galliker, S. Levine, "Real-Time Execution of Action Chunking Flow Policies",
2025, algorithm 1.
"""

from __future__ import annotations

from collections import deque

from cloudrc.base.outside.values import Quantity
from cloudrc.gym.executors import Chunk, Committed
from cloudrc.gym.executors._question import OneQuestion
from cloudrc.gym.executors.time_indexed import TimeIndexed

STEPS = Quantity(ge=1, le=10_000, whole=True)
"""Number of steps."""


class RealTimeChunking(OneQuestion, TimeIndexed):
    """Asks when `execute` actions of a chunk are executed.

    Args:
        execute: How many actions of a chunk the robot executes before it asks; None: half of them.
        memory: Number of last answers whose largest delay is expected of the next.
        patience: Time without an answer after which the robot asks again [s].
    """

    def __init__(self, execute: int | None = None, memory: int = 10, patience: float = 1.0) -> None:
        super().__init__(patience)
        self._execute = None if execute is None else STEPS.of(execute, "execute")
        self._memory = STEPS.of(memory, "memory")

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode."""
        super().begin(ticks_late, period_ns)
        self._delays = deque([ticks_late], maxlen=self._memory)

    def wants(self, tick: int) -> bool:
        """Return whether enough of the chunk is executed."""
        basis, actions = self._chunk
        return tick - basis >= (self._execute or max(len(actions) // 2, 1))

    def committed(self, tick: int) -> Committed:
        """Return all that is left of the chunk, and the largest delay of late."""
        actions = self._chunk.actions[tick - self._chunk.basis :]
        return Committed(actions, min(max(self._delays), len(actions)))

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take the answer, and note how long it took."""
        if chunk.basis:  # the first answer may be there from the start
            self._delays.append(tick - chunk.basis)
        super().receive(chunk, tick)


build = RealTimeChunking
