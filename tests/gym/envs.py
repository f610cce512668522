# SPDX-License-Identifier: Apache-2.0

"""Small environments that tell what they were given."""

import gymnasium
import numpy as np
from gymnasium import spaces


class Counter(gymnasium.Env):
    """Observes the number of the step; keeps the actions that it executed."""

    dt = 0.01

    def __init__(self, action_space=None, limit=10**9):
        self.action_space = action_space or spaces.Box(-1000.0, 1000.0, (1,))
        self.observation_space = spaces.Box(0.0, np.inf, (1,), np.float64)
        self._limit = limit

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.executed, self._shared = [], np.zeros(1)  # changed in place, as some environments do
        return self._shared, {"count": 0}

    def step(self, action):
        self.executed.append(action)
        self._shared += 1.0
        count = int(self._shared[0])
        return self._shared, float(count), count >= self._limit, False, {"count": count}


class Mixed(gymnasium.Env):
    """Has spaces of every kind."""

    dt = 0.02

    def __init__(self):
        keys = spaces.Tuple((spaces.MultiBinary(2), spaces.MultiDiscrete([2, 3])))
        self.action_space = spaces.Dict(
            move=spaces.Box(-1, 1, (2,), np.float32), jump=spaces.Discrete(3), keys=keys
        )
        state = spaces.Tuple((spaces.Discrete(10), spaces.Box(-1, 1, (3,), np.float64)))
        self.observation_space = spaces.Dict(
            image=spaces.Box(0, 255, (4, 4), np.uint8), state=state
        )

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        reward = float(np.sum(action["move"])) + float(action["jump"])
        told = {"jumped": bool(action["jump"])}
        return self.observation_space.sample(), reward, False, False, told


def told(env, steps, seed=None):
    """Begin an episode and answer 0 in each step; return what the steps tell about the link."""
    env.reset(seed=seed)
    return [env.step(np.zeros(1, np.float32))[4]["cloudrc"] for _ in range(steps)]


def both_ways(up_ms, down_ms, **keys):
    """Return a link with constant delays [ms]."""
    return {"uplink": {"delay_ms": up_ms, **keys}, "downlink": {"delay_ms": down_ms, **keys}}
