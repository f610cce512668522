# SPDX-License-Identifier: Apache-2.0

"""A gain of .12 for the plant x+ = 1.05 x + u: it is stable up to a delay of 10 steps."""

from typing import Any


def infer(observation: dict[str, Any]) -> dict[str, Any]:
    """Return the action for a state."""
    return {"actions": [[-0.12 * float(observation["observation/state"][0])]]}
