# SPDX-License-Identifier: Apache-2.0

"""Fly towards the place, the slower the nearer; the controller on board holds the velocity."""

from typing import Any

GAIN = 0.8
"""Velocity per distance [1/s]."""


def infer(observation: dict[str, Any]) -> dict[str, Any]:
    """Return the velocity for a position."""
    x, y, z = -GAIN * observation["observation/state"][:3]
    return {"actions": [[x, y, z, 0.0]]}
