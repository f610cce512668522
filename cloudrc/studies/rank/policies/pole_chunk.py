# SPDX-License-Identifier: Apache-2.0

"""The rule of pole.py for the next 40 steps of a model of the pole: an answer has 40 actions."""

from math import cos, sin
from typing import Any

State = tuple[float, float, float, float]
"""Place and speed of the cart [m] [m/s], angle and turn of the pole [rad] [rad/s]."""
STEPS = 40


def push(state: State) -> int:
    """Return the action for a state."""
    x, speed, angle, turn = state
    return int(10 * angle + 2 * turn + 0.1 * x + 0.3 * speed > 0)


def move(state: State, action: int) -> State:
    """Return the state after a step of 20 ms, as gymnasium's CartPole-v1 computes it."""
    x, speed, angle, turn = state
    sine, cosine = sin(angle), cos(angle)
    force = ((10.0 if action else -10.0) + 0.05 * turn * turn * sine) / 1.1
    turning = (9.8 * sine - cosine * force) / (0.5 * (4.0 / 3.0 - 0.1 * cosine**2 / 1.1))
    moving = force - 0.05 * turning * cosine / 1.1
    return x + 0.02 * speed, speed + 0.02 * moving, angle + 0.02 * turn, turn + 0.02 * turning


def infer(observation: dict[str, Any]) -> dict[str, Any]:
    """Return the pushes for this step and the next ones."""
    x, speed, angle, turn = map(float, observation["observation/state"])
    state, actions = (x, speed, angle, turn), list[list[int]]()
    for _ in range(STEPS):
        actions.append([push(state)])
        state = move(state, actions[-1][0])
    return {"actions": actions}
