# SPDX-License-Identifier: Apache-2.0

"""RAPTOR, a policy for any quadrotor that was trained to command its four motors.

Source: J. Eschmann, D. Albani, G. Loianno, "RAPTOR: a foundation policy for quadrotor control",
2025; the weights are in the package foundation-policy.
"""

from __future__ import annotations

from typing import Any

from foundation_policy import Raptor


class Policy:
    """Asks the network, which has a memory."""

    def __init__(self) -> None:
        self._network = Raptor()

    def reset(self) -> None:
        """Begin an episode."""
        self._network.reset()

    def infer(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the actions of the four motors."""
        return {"actions": self._network.evaluate_step(observation["observation/state"][None, :])}


build = Policy
