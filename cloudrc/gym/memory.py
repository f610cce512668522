"""What a policy may remember, beside its observation: how old it is, and its own last actions.

With the actions that are under way, the state of a world behind a constant delay is complete again
(K. V. Katsikopoulos, S. E. Engelbrecht, "Markov Decision Processes with Delays and Asynchronous
Cost Collection", IEEE TAC 48(4), 2003).
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array

from cloudrc.outside.values import Quantity, to_boolean

ACTIONS = Quantity(ge=0, le=1000, whole=True)
"""Number of actions."""


class Remembering:
    """Puts memory beside an observation.

    Attributes:
        space: That of an observation with memory: `observation`, that of the environment; `age`
            [s], shape (1,); `actions`, the last ones that the policy has sent, the oldest first.
            Without memory, it is that of the environment.
    """

    def __init__(
        self,
        both: tuple[spaces.Space[Any], spaces.Space[Any]],
        age: bool,
        count: int,
        idle: Any,
    ) -> None:
        """Remember `count` actions and the age if asked; `idle` stands for those not sent yet.

        `both` are the spaces of observations and actions.
        """
        self._idle, self._count = idle, ACTIONS.of(count, "observe_actions")
        self.space, self._actions = both
        self._parts = {"observation": self.space}
        if to_boolean(age, "observe_age"):
            self._parts["age"] = spaces.Box(0.0, np.inf, (1,), np.float32)
        if self._count:
            self._parts["actions"] = batch_space(self._actions, self._count)
        if len(self._parts) > 1:
            self.space = spaces.Dict(self._parts)
        self.begin()

    def begin(self) -> None:
        """Forget the last episode."""
        self._sent = deque([self._idle] * self._count, maxlen=self._count)

    def add(self, action: Any) -> None:
        """Remember an action that the policy has sent."""
        self._sent.append(action)

    def beside(self, observation: Any, age: float) -> Any:
        """Return an observation of this `age` [s] with the memory."""
        if len(self._parts) == 1:
            return observation
        found = {"observation": observation}
        if "age" in self._parts:
            found["age"] = np.array([age], np.float32)
        if self._count:
            out: Any = create_empty_array(self._actions, self._count)
            found["actions"] = concatenate(self._actions, self._sent, out)
        return found
