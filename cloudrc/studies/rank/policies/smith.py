# SPDX-License-Identifier: Apache-2.0

"""The gain of linear.py behind a Smith predictor: own model, own last actions.

The policy finds the delay itself: it asks which of its actions has moved the plant.
Source: O. J. M. Smith, "Closer control of loops with dead time", 1957.
"""

from __future__ import annotations

from typing import Any

POLE, GAIN = 1.05, 0.12
ACTION_MAX = 100.0
"""Largest action [1]. Over a delay that varies the policy may find a wrong one, and its answers
would grow without a bound. A constant delay of 600 ms needs less."""


class Smith:
    """Answers for the state in which its answer will act."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin an episode."""
        self._sent, self._before, self._delay = list[float](), 0.0, 0

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the action for the state that the model predicts."""
        state = float(observation["observation/state"][0])
        if self._sent:
            moved = state - POLE * self._before
            apart = [abs(action - moved) for action in reversed(self._sent)]
            self._delay = apart.index(min(apart))
        self._before = state
        for action in self._sent[len(self._sent) - self._delay :]:
            state = POLE * state + action
        action = max(-ACTION_MAX, min(ACTION_MAX, -GAIN * state))
        self._sent.append(action)
        return {"actions": [[action]]}


build = Smith
