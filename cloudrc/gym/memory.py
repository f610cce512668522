# SPDX-License-Identifier: Apache-2.0

"""What a policy may remember, beside its observation: its age, its step, its own last actions.

With the actions that are under way, the state of a world behind a constant delay is complete again
(K. V. Katsikopoulos, S. E. Engelbrecht, "Markov Decision Processes with Delays and Asynchronous
Cost Collection", IEEE TAC 48(4), 2003).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from cloudrc.base.outside.values import Quantity, to_boolean

ACTIONS = Quantity(ge=0, le=1000, whole=True)
"""Number of actions."""
NUMBERS = ("age", "step")
"""Numbers beside an observation."""


class Remembering:
    """Puts memory beside an observation.

    Attributes:
        adds: Whether an observation has memory.
        space: That of an observation with memory: `observation`, that of the environment; `age`
            [s], shape (1,); `step`, in which it was taken, shape (1,); `actions`, the last ones
            that the policy has sent, the oldest first. Without memory, it is that of the
            environment.
    """

    def __init__(
        self,
        both: tuple[spaces.Space[Any], spaces.Space[Any]],
        asked: Mapping[str, Any],
        idle: Any,
    ) -> None:
        """Remember what is `asked`; the action `idle` stands for those that are not sent yet.

        `both` are the spaces of observations and actions. `asked` has the arguments `observe_age`,
        `observe_step` and `observe_actions` of `Networked`.
        """
        self._idle = idle
        self._count = ACTIONS.of(asked["observe_actions"], "observe_actions")
        self.space, self._actions = both
        self._parts = {"observation": self.space}
        for name in NUMBERS:
            if to_boolean(asked[f"observe_{name}"], f"observe_{name}"):
                self._parts[name] = spaces.Box(0.0, np.inf, (1,), np.float32)
        if self._count:
            self._parts["actions"] = batch_space(self._actions, self._count)
        self.adds = len(self._parts) > 1
        if self.adds:
            self.space = spaces.Dict(self._parts)
        self.begin()

    def begin(self) -> None:
        """Forget the last episode."""
        self._sent = deque([self._idle] * self._count, maxlen=self._count)

    def add(self, action: Any) -> None:
        """Remember an action that the policy has sent."""
        self._sent.append(action)

    def beside(self, observation: Any, **numbers: float) -> Any:
        """Return an observation with the memory; `numbers` are its `age` [s] and its `step`."""
        found = {"observation": observation}
        for name in NUMBERS:
            if name in self._parts:
                found[name] = np.array([numbers[name]], np.float32)
        if self._count:
            out: Any = create_empty_array(self._actions, self._count)
            found["actions"] = concatenate(self._actions, self._sent, out)
        return found
