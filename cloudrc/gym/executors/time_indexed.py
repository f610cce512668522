"""Executor: action i of an answer belongs to the i-th tick after its observation, however late."""

from __future__ import annotations

from cloudrc.gym.executors import Chunk
from cloudrc.gym.executors.newest import Newest


class TimeIndexed(Newest):
    """The newest answer wins. An action that comes too late for its tick is skipped."""

    needs_chunk = True

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take the answer if it is newer than the present one; it begins at its observation."""
        super().receive(chunk, chunk.basis)


build = TimeIndexed
