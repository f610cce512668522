# SPDX-License-Identifier: Apache-2.0

"""Executor: action i of an answer belongs to the i-th tick after its observation, however late."""

from __future__ import annotations

from cloudrc.gym.executors import Chunk
from cloudrc.gym.executors.newest import Newest


class TimeIndexed(Newest):
    """The newest answer wins. An action that comes too late for its tick is skipped."""

    needs_chunk = True

    def doubt(self, count: int, ticks_late: int) -> str:
        """Say that hardly an action acts, if most come too late for their ticks."""
        if ticks_late < count:
            return ""
        return (
            f"an answer has actions for {count} steps from that of its observation on, and arrives "
            "later: few of them act, or none; answer with more actions, or choose executor 'newest'"
        )

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take the answer if it is newer than the present one; it begins at its observation."""
        super().receive(chunk, chunk.basis)


build = TimeIndexed
