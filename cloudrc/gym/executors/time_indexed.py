"""Executor: action i of an answer belongs to the i-th tick after its observation, however late."""

from __future__ import annotations

from typing import Any

from cloudrc.gym.executors import Chunk, Executor


class TimeIndexed(Executor):
    """The newest answer wins. An action that comes too late for its tick is skipped."""

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode."""
        self._chunk = Chunk(-1, ())

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take the answer if it is newer than the present one."""
        if chunk.basis > self._chunk.basis:
            self._chunk = chunk

    def action(self, tick: int) -> Any:
        """Return the action that the policy meant for this tick."""
        self.basis, actions = self._chunk
        place = tick - self._chunk.basis
        return actions[place] if place < len(actions) else None


def build() -> TimeIndexed:
    """Make the executor."""
    return TimeIndexed()
