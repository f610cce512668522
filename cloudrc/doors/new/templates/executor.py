# SPDX-License-Identifier: Apache-2.0

"""Executor: plays the newest answer by its time, and after its end repeats its last action.

A tick is a step of the environment. The first action of an answer is for the tick of the
observation, its basis, so a late answer is entered later.
"""

from cloudrc.plugin import Chunk, Executor


class Lasting(Executor):
    """Asks in every `period` ticks."""

    def __init__(self, period: int) -> None:
        self.period = period

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode; an answer is expected `ticks_late` ticks after its question."""
        self.chunk = Chunk(-1, ())

    def asks(self, tick: int, observation: object) -> bool:
        """Return whether the robot sends the observation of this tick to the policy."""
        return tick % self.period == 0

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take an answer; an older one may arrive after a newer one."""
        if chunk.basis > self.chunk.basis:
            self.chunk = chunk

    def action(self, tick: int) -> object:
        """Return the action of this tick, and set `basis`; None: the robot has none."""
        self.basis, actions = self.chunk
        return actions[min(tick - self.chunk.basis, len(actions) - 1)] if actions else None


def build(period: int = 2) -> Lasting:
    """Return the executor; `period` [ticks] is a parameter of `cloudrc eval --set`."""
    return Lasting(period)
