# SPDX-License-Identifier: Apache-2.0

"""Play an episode with the executor beside this file, in virtual time; pytest runs it."""

from pathlib import Path

import gymnasium
import numpy as np

from cloudrc.gym import Networked

EXECUTOR = str(Path(__file__).with_name("executor.py"))
CHUNK = 16
"""Number of actions in an answer."""


def test_the_executor_brings_a_plant_to_rest() -> None:
    """The plant x + u without noise goes from 1 to 0 over the delays of a mobile network."""
    plant = gymnasium.make("cloudrc/Linear-v0", A=1.0, W=0.0, x0=1.0, dt=0.02)
    world = Networked(plant, "lte", seed=1, chunk=CHUNK, executor=EXECUTOR)
    x, _ = world.reset(seed=1)
    for _ in range(200):
        left = x[0] * 0.9 ** np.arange(CHUNK)  # the state in the next ticks, as the policy plans it
        x, *_ = world.step(-0.1 * left.reshape(CHUNK, 1))
    assert abs(x[0]) < 0.01
