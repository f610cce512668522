"""Executor: as time_indexed, but the policy knows the actions that are executed before its answer.

`info["cloudrc"]["prefix"]` has them: what the policy has sent for the ticks from that of the
observation to the expected arrival of the answer. The policy begins its chunk with them and
continues from the state to which they lead.
"""

from __future__ import annotations

from typing import Any

from cloudrc.gym.executors import Chunk
from cloudrc.gym.executors.time_indexed import TimeIndexed


class Prefix(TimeIndexed):
    """Remembers what the policy has sent."""

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode; the prefix has `ticks_late` actions."""
        super().begin(ticks_late, period_ns)
        self._late, self._sent = ticks_late, dict[int, Any]()

    def sent(self, chunk: Chunk) -> None:
        """Remember the actions of an answer; they replace those of earlier answers."""
        for place, action in enumerate(chunk.actions):
            self._sent[chunk.basis + place] = action
        for tick in [each for each in self._sent if each < chunk.basis]:
            del self._sent[tick]

    def prefix(self, basis: int) -> list[Any]:
        """Return the actions for the ticks in which no answer can have arrived."""
        found = list[Any]()
        for tick in range(basis, basis + self._late):
            if tick not in self._sent:
                break
            found.append(self._sent[tick])
        return found


def build() -> Prefix:
    """Make the executor."""
    return Prefix()
