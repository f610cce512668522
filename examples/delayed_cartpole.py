# SPDX-License-Identifier: Apache-2.0

"""Train PPO on CartPole behind a delay, with and without memory of its own actions.

    pip install 'cloudrc[gym]' stable-baselines3
    python examples/delayed_cartpole.py [STEPS]     # 100,000 steps: some 10 minutes

With a delay of d steps, the state is the observation and the last d actions, which are still under
way. An observation alone is not enough to learn from.

Source: K. V. Katsikopoulos, S. E. Engelbrecht, "Markov Decision Processes with Delays and
Asynchronous Cost Collection", IEEE Transactions on Automatic Control 48 (4), 2003.
"""

from __future__ import annotations

import sys

import gymnasium
import torch
from gymnasium.wrappers import FlattenObservation
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from cloudrc.gym import Networked

DT = 0.02  # time of a step of CartPole [s]
DELAYS = 0, 5  # of the actions [steps]
BETTER = 1.5  # least quotient of the episodes' lengths with and without memory, at the long delay


def make(delay: int, has_memory: bool) -> gymnasium.Env:
    """Return CartPole whose actions come `delay` steps late."""
    link = {"downlink": {"delay_ms": 1e3 * delay * DT}}
    env = gymnasium.make("CartPole-v1")
    if not has_memory:
        return Monitor(Networked(env, link, seed=1))
    memory = {"observe_age": True, "observe_actions": max(delay, 1)}
    return Monitor(FlattenObservation(Networked(env, link, seed=1, **memory)))


def train(delay: int, has_memory: bool, steps: int) -> float:
    """Return the mean length of 20 episodes after `steps` of training; the longest is 500."""
    model = PPO("MlpPolicy", make(delay, has_memory), seed=1, device="cpu")
    model.learn(steps)
    env = make(delay, has_memory)
    env.reset(seed=1000)
    return float(evaluate_policy(model, env, n_eval_episodes=20)[0])


def main(steps: int) -> int:
    """Print the table; return 1 if the memory does not help at the long delay."""
    torch.set_num_threads(1)
    print("| delay [steps] | observation alone | with its last actions |\n|---|---|---|")
    for delay in DELAYS:
        alone, remembering = (train(delay, has_memory, steps) for has_memory in (False, True))
        print(f"| {delay} | {alone:.0f} | {remembering:.0f} |", flush=True)
    return 0 if remembering > BETTER * alone else 1


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if sys.argv[1:] else 100_000))
