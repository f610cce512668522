# SPDX-License-Identifier: Apache-2.0

"""A rule that holds the pole of CartPole: an answer has one action."""

from typing import Any


def infer(observation: dict[str, Any]) -> dict[str, Any]:
    """Return the push for a state."""
    x, speed, angle, turn = map(float, observation["observation/state"])
    return {"actions": [[int(10 * angle + 2 * turn + 0.1 * x + 0.3 * speed > 0)]]}
