# SPDX-License-Identifier: Apache-2.0

"""Policy of the evaluations in hashes.json whose executor needs floats: brake a pendulum."""

import numpy as np


def infer(observation):
    """Turn against the fall and, less and less in the chunk of 8 actions, against the motion."""
    _, sine, rate = observation["observation/state"]
    torques = -2.0 * sine - rate * np.linspace(1.0, 0.3, 8)
    return {"actions": np.clip(torques, -2.0, 2.0).reshape(8, 1)}
