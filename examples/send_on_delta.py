# SPDX-License-Identifier: Apache-2.0

"""Executor: send the observation only if it is at least `delta` away from 0; act on each answer.

`asks` sees the observation of each step on board; the policy has what is sent:

    Networked(env, link, executor={"name": "examples/send_on_delta.py", "delta": 2.0})
    cloudrc eval ... --executor examples/send_on_delta.py --set delta=2

Source: K. J. Åström, B. Bernhardsson, "Comparison of Riemann and Lebesgue Sampling for First Order
Stochastic Systems", CDC 2002.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cloudrc.plugin import Newest


class SendOnDelta(Newest):
    """Plays the newest answer, and asks for few."""

    def __init__(self, delta: float) -> None:
        self._delta = delta

    def asks(self, tick: int, observation: NDArray[np.float64]) -> bool:
        """Return whether the observation, shape (n,), is far from 0."""
        return bool(np.abs(observation).max() >= self._delta)


def build(delta: float = 1.0) -> SendOnDelta:
    """Build the executor; `delta` has the unit of the observation."""
    return SendOnDelta(delta)
