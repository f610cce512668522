# SPDX-License-Identifier: Apache-2.0

"""Swing a pendulum up by its energy, then hold it: for gymnasium's Pendulum-v1.

Source: K. J. Astrom, K. Furuta, "Swinging up a pendulum by energy control", 2000.
"""

from math import atan2
from typing import Any


def infer(observation: dict[str, Any]) -> dict[str, Any]:
    """Return the torque [N m] for a state."""
    cosine, sine, turn = map(float, observation["observation/state"])
    angle = atan2(sine, cosine)
    if abs(angle) < 0.4:
        torque = -12.0 * angle - 3.0 * turn
    else:
        missing = 15.0 * (1.0 - cosine) - turn * turn / 2.0  # to the energy of standing [1/s^2]
        torque = missing * (1.0 if turn >= 0.0 else -1.0)
    return {"actions": [[max(-2.0, min(2.0, torque))]]}
