"""Train a policy of stable-baselines3 through a link: it has to become better. Half a minute.

`make nightly` runs it in an environment of its own, because PyTorch takes 5 GB.
"""

from __future__ import annotations

import json
import sys

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from cloudrc.gym import Networked

WAY = {"delay_ms": 20.0, "jitter_ms": 5.0, "loss": 0.02}
STEPS, EPISODES = 12_000, 10
BETTER = 1.5
"""Least quotient of the mean rewards after and before the training."""


def make() -> Networked:
    """Make CartPole behind a link with a round trip of 40 ms."""
    link = {"uplink": WAY, "downlink": WAY}
    return Networked(gymnasium.make("CartPole-v1"), link, seed=1, start="answer")


def main() -> int:
    """Train, and print the mean rewards of an episode as JSON."""
    torch.set_num_threads(1)
    check_env(make())
    judge = make_vec_env(make, 1, seed=9)
    model = PPO("MlpPolicy", make_vec_env(make, 4, seed=0), seed=0, device="cpu", n_steps=256)
    before, _ = evaluate_policy(model, judge, EPISODES)
    model.learn(STEPS)
    after, _ = evaluate_policy(model, judge, EPISODES)
    print(json.dumps({"before": before, "after": after, "steps": STEPS}))
    return 0 if after > BETTER * before else 1


if __name__ == "__main__":
    sys.exit(main())
