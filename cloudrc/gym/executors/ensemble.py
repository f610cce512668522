# SPDX-License-Identifier: Apache-2.0

"""Executor: the weighted mean of what all answers meant for the tick (temporal ensembling).

Source: T. Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", RSS
2023: weights exp(-m i), where i is 0 for the oldest answer.
"""

from __future__ import annotations

from math import exp
from typing import Any

import numpy as np

from cloudrc.gym.executors import Chunk, Executor
from cloudrc.gym.executors.time_indexed import TimeIndexed

DECAY = 0.01
"""How fast the weight falls from an older answer to the next newer one [1]."""


class Ensemble(Executor):
    """Keeps all answers with an action for the tick; jumps between answers become small."""

    needs_floats = True
    doubt = TimeIndexed.doubt

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Forget the last episode."""
        self._chunks: list[Chunk] = []

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Keep the answer."""
        self._chunks.append(chunk)
        self._chunks.sort(key=lambda each: each.basis)

    def action(self, tick: int) -> Any:
        """Return the mean action of the answers for this tick."""
        self._chunks = [each for each in self._chunks if tick - each.basis < len(each.actions)]
        if not self._chunks:
            return None
        meant = np.stack([each.actions[tick - each.basis] for each in self._chunks])
        weights = [exp(-DECAY * place) for place in range(len(meant))]
        bases = [each.basis for each in self._chunks]
        self.basis = float(np.average(bases, weights=weights))
        mean = np.average(meant, axis=0, weights=weights)
        return mean.astype(meant.dtype) if meant.dtype.kind == "f" else mean


build = Ensemble
