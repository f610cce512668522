# SPDX-License-Identifier: Apache-2.0

"""A task without weights on which a policy's answers disagree: pass poles on the left or right.

    python examples/fork.py [EPISODES]     # the table of docs/executors.md

The policy draws the side anew for each answer, as a generative policy with two modes does. An
executor that mixes answers steers between both sides, into the pole. With `rtc`, the policy sees
the actions that the robot is going to execute, and fits its answer to them: the in-painting is
exact here, as there are only two modes.

Source of task and order: K. Black, M. Y. Galliker, S. Levine, "Real-Time Execution of Action
Chunking Flow Policies", 2025; soft mask: its equation 5.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from math import exp, hypot, tanh
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cloudrc.gym import Networked

Floats = NDArray[np.float64]
State = tuple[float, float, float]  # x, y [m], speed along y [m/s]
DT = 0.05  # time of a step [s]
SPEED = 1.0  # along x [m/s]
POLES = 1.5, 3.5, 5.5, 7.5  # their x; all have y = 0 [m]
RADIUS, WALL = 0.25, 1.2  # of a pole, and |y| of the walls [m]
ASIDE = 0.45  # y at which the policy passes a pole [m]
LARGEST = 4.0  # acceleration [m/s^2]
CHUNK = 16
EXECUTORS = {
    "rtc": "rtc",
    "async, weighted": {"name": "async", "aggregate": "weighted"},
    "broker": "broker",
    "ensemble": "ensemble",
}
DELAYS = 0, 2, 4, 6, 8  # of an answer [steps]


def move(state: State, action: float, gust: float = 0.0) -> State:
    """Simulate a step."""
    x, y, speed = state
    speed += DT * (action + gust)
    return x + DT * SPEED, y + DT * speed, speed


class Fork(gymnasium.Env[Floats, Floats]):
    """A mass that flies along x through four poles; it is steered along y."""

    dt = DT
    observation_space = spaces.Box(-9.0, 9.0, (3,), np.float64)
    action_space = spaces.Box(-LARGEST, LARGEST, (1,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin before the first pole."""
        super().reset(seed=seed)
        self._state = self.np_random.uniform(-0.5, 0.5), self.np_random.normal(0.0, 0.05), 0.0
        return np.array(self._state), {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Steer; the episode ends at a pole, at a wall, or behind the last pole."""
        push = min(max(float(action[0]), -LARGEST), LARGEST)
        self._state = move(self._state, push, self.np_random.normal(0.0, 0.5))
        x, y, _ = self._state
        hit = abs(y) > WALL or any(hypot(x - pole, y) < RADIUS for pole in POLES)
        return np.array(self._state), 0.0, hit, x > 9.0, {"success": not hit and x > 9.0}


def plan(state: State, side: int, count: int) -> list[float]:
    """Return actions that pass the next pole on a side."""
    found = []
    for _ in range(count):
        near = [pole for pole in POLES if -0.35 < pole - state[0] < 1.2]
        goal = side * ASIDE if near else 0.0
        push = 16.0 * (goal - state[1]) - 6.0 * state[2]
        found.append(min(max(push, -LARGEST), LARGEST))
        state = move(state, found[-1])
    return found


class Policy:
    """Draws a side for each answer; the chance follows the state and the prefix."""

    def __init__(self, seed: int) -> None:
        """Begin an episode."""
        self._noise = np.random.default_rng(seed)

    def __call__(self, observation: Floats, prefix: Sequence[Any], delay: int) -> Floats:
        """Return a chunk, shape (16, 1); its first `delay` actions are those of the prefix."""
        x, y, speed = map(float, observation)
        known = [float(each[0]) for each in prefix]
        frozen, state = known[:delay], (x, y, speed)
        for action in frozen:
            state = move(state, action)
        left = (1.0 + tanh((y + 0.1 * speed) / 0.24)) / 2.0
        plans = {side: frozen + plan(state, side, CHUNK - len(frozen)) for side in (1, -1)}
        fits = {side: exp(-misfit(known, plans[side], delay) / 2.0) for side in plans}
        up, down = left * fits[1], (1.0 - left) * fits[-1]
        side = 1 if self._noise.random() * (up + down) < up else -1
        return np.array(plans[side])[:, None]


def misfit(known: Sequence[float], planned: Sequence[float], delay: int) -> float:
    """Return how far a plan is from what the robot has: weight 1 for what is frozen, then less."""
    total = 0.0
    for place, (had, wanted) in enumerate(zip(known, planned, strict=False)):
        rest = (len(known) - place) / (len(known) - delay + 1)
        weight = 1.0 if place < delay else rest * (exp(rest) - 1.0) / (exp(1.0) - 1.0)
        total += weight * (had - wanted) ** 2
    return min(total, 600.0)


def success(executor: Any, delay: int, episodes: int) -> float:
    """Return the share of episodes that end behind the last pole."""
    link = {"downlink": {"delay_ms": 1e3 * delay * DT}}
    done = 0
    for seed in range(episodes):
        env = Networked(Fork(), link, seed, chunk=CHUNK, executor=executor, start="answer")
        policy, (seen, info) = Policy(seed), env.reset(seed=seed)
        answer, over = policy(seen, (), 0), False
        while not over:
            seen, _, ended, passed, info = env.step(answer)
            told, over = info["cloudrc"], ended or passed
            if told["asked"]:
                answer = policy(seen, told.get("prefix", ()), told.get("delay", 0))
        done += env.world_info["success"]
    return done / episodes


def main(episodes: int) -> None:
    """Print the table."""
    print(f"| delay [steps] | {' | '.join(map(str, DELAYS))} |\n|---|{'---|' * len(DELAYS)}")
    for name, executor in EXECUTORS.items():
        cells = [f"{success(executor, delay, episodes):.0%}" for delay in DELAYS]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if sys.argv[1:] else 200)
