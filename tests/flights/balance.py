# SPDX-License-Identifier: Apache-2.0

"""Policy of the evaluations in hashes.json: balance a pole, in chunks of 8 actions."""

import numpy as np

STEP = 0.02
"""Time of a step of CartPole [s]."""
TURN = 0.3
"""By how much a push changes the rate of the pole in a step [rad/s]."""


def infer(observation):
    """Push the cart to the side to which the pole falls, and expect what each push does."""
    angle, rate = observation["observation/state"][2:4]
    actions = []
    for _ in range(8):
        push = int(angle + 0.3 * rate > 0)
        actions.append([push])
        rate += TURN if push == 0 else -TURN
        angle += rate * STEP
    return {"actions": np.array(actions)}
