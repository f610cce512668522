# SPDX-License-Identifier: Apache-2.0

"""Executor: play the newest answer from its first action on."""

from __future__ import annotations

from typing import Any

from cloudrc.gym.executors import Chunk, Executor


class Newest(Executor):
    """The newest answer wins. It is played from the tick in which it arrives."""

    needs_chunk = False

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode."""
        self._chunk, self._start = Chunk(-1, ()), 0

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take the answer if it is newer than the present one."""
        if chunk.basis > self._chunk.basis:
            self._chunk, self._start = chunk, tick

    def action(self, tick: int) -> Any:
        """Return the next action of the newest answer."""
        self.basis, actions = self._chunk
        place = tick - self._start
        return actions[place] if place < len(actions) else None


build = Newest
