# SPDX-License-Identifier: Apache-2.0

"""Count what a robot's episode is like, step by step, as the world sees it."""

from __future__ import annotations

from collections.abc import Mapping
from hashlib import sha256
from math import isfinite
from statistics import fmean
from typing import Any

import gymnasium
import numpy as np

from cloudrc.base.outside.values import RESULT, to_arrays, to_boolean
from cloudrc.base.rounding import exceeds
from cloudrc.gym.values import leaves
from cloudrc.studies.eval.setup import EvalSetup

SUCCESS = ("success", "is_success")
"""Keys of an environment's info that tell whether the task is done; one true value is enough."""


class Witness(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Sees what the world does, which no delay changes: executed actions, states, rewards.

    Attributes:
        digest: Hash of all that it has seen.
        action, reward, info: Those of the last step.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.digest = sha256()
        self.action: Any = None
        self.reward, self.info = 0.0, dict[str, Any]()

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(**given)
        self._note(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Execute an action."""
        self.action = action
        observation, given, terminated, truncated, info = self.env.step(action)
        reward = self.reward = _reward_of(given)
        self.info = dict(info)
        ends = [
            to_boolean(_one(each), name)
            for each, name in ((terminated, "terminated"), (truncated, "truncated"))
        ]
        self._note([action, observation, reward])
        return observation, reward, *ends, self.info

    def _note(self, values: Any) -> None:
        for value in leaves(values):
            self.digest.update(np.asarray(to_arrays(value)).tobytes())


def _reward_of(given: Any) -> float:
    """Return the reward of a step, which may be a boolean; raise a ValueError for a wrong value."""
    given = _one(given)
    is_boolean = isinstance(given, bool | np.bool_)
    return float(given) if is_boolean else RESULT.of(given, "reward")


def _one(given: Any) -> Any:
    """Return the value of an array of one, as environments that are made for vectors give it."""
    given = to_arrays(given)
    return given.reshape(())[()] if isinstance(given, np.ndarray) and given.size == 1 else given


class Tally:
    """What the steps of an episode were like.

    Attributes:
        steps: Number of steps.
    """

    def __init__(self, witness: Witness, setup: EvalSetup) -> None:
        """Count the steps that `witness` sees."""
        self._witness, self._success_at = witness, setup.success_at
        self.steps, self._stale, self._total = 0, 0, 0.0
        self._jumps, self._basis = list[float](), -1.0
        self._before: Any = None  # action of the step before
        self._success: bool | None = None

    def count(self, about: Mapping[str, Any], dt: float) -> None:
        """Count a step of `dt` [s]; `about` is what the loop then tells."""
        self.steps += 1
        self._total += self._witness.reward
        self._stale += about["held"]
        action = self._witness.action
        if isfinite(about["action_age"]) and not about["held"]:
            now = self.steps - 1 - about["action_age"] / dt
            if self._before is not None and abs(now - self._basis) > 1e-6:
                jump = np.subtract(action, self._before, dtype=float)  # they may be booleans
                self._jumps.append(float(np.linalg.norm(jump)))
            self._basis = now
        self._before = action
        if self._success_at is None:
            self._success = _success(self._success, self._witness.info)

    def numbers(self) -> tuple[bool | None, dict[str, float | None]]:
        """Return whether the episode is a success, None if nobody tells, and its numbers."""
        success = self._success
        if self._success_at is not None:
            success = not exceeds(self._success_at, self._total)
        return success, {
            "return": self._total,
            "steps": self.steps,
            "success": None if success is None else int(success),
            "stale_share": self._stale / self.steps,
            "seam_jump": fmean(self._jumps) if self._jumps else None,
        }


def _success(known: bool | None, info: Mapping[str, Any]) -> bool | None:
    """Return whether the task was done in any step so far; None if the info never told."""
    for key in SUCCESS:
        if info.get(key) is not None:
            name = f"info['{key}'] (see --success-at)"
            known = to_boolean(_one(info[key]), name) or bool(known)
    return known
