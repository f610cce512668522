"""Measure which way of executing a policy's answers keeps CartPole standing over which network.

Writes the table of docs/gym.md. Run as `python -m tools.survival`, a minute; `--seeds 5` is
faster and only prints the table.
"""

from __future__ import annotations

import argparse
from functools import partial
from math import cos, sin
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import gymnasium

from cloudrc.gym import Networked
from cloudrc.statistics import exact_interval

PAGE = Path(__file__).parents[1] / "docs" / "gym.md"
BEGIN, END = "<!-- python -m tools.survival: begin -->\n", "<!-- end -->\n"
STEPS = 500
LINKS = {  # round trip [ms], its jitter [ms], loss of each direction
    "0": (0, 0, 0.0),
    "40": (40, 0, 0.0),
    "80 ± 20": (80, 20, 0.0),
    "140 ± 40": (140, 40, 0.0),
    "140 ± 40, 10 % loss": (140, 40, 0.1),
    "200 ± 40": (200, 40, 0.0),
    "300 ± 60, 10 % loss": (300, 60, 0.1),
}
WAYS: dict[str, dict[str, Any]] = {
    "newest, one action": {"executor": "newest"},
    "broker, 16": {"executor": "broker", "chunk": 16},
    "time_indexed, 16": {"executor": "time_indexed", "chunk": 16},
    "prefix, 16": {"executor": "prefix", "chunk": 16},
    "time_indexed, 24": {"executor": "time_indexed", "chunk": 24},
    "prefix, 24": {"executor": "prefix", "chunk": 24},
}
State = tuple[float, float, float, float]


def decide(state: State) -> int:
    """Return which way to push: a linear law that holds the pole without a network."""
    x, speed, angle, turn = state
    return int(10.0 * angle + 2.0 * turn + 0.1 * x + 0.3 * speed > 0.0)


def predict(state: State, action: int) -> State:
    """Return the state one step later.

    Source: A. Barto, R. Sutton, C. Anderson, IEEE Trans. SMC 13, 1983: the cart and its pole.
    """
    x, speed, angle, turn = state
    force, sine, cosine = 10.0 if action else -10.0, sin(angle), cos(angle)
    push = (force + 0.05 * turn * turn * sine) / 1.1
    turning = (9.8 * sine - cosine * push) / (0.5 * (4.0 / 3.0 - 0.1 * cosine * cosine / 1.1))
    return (
        x + 0.02 * speed,
        speed + 0.02 * (push - 0.05 * turning * cosine / 1.1),
        angle + 0.02 * turn,
        turn + 0.02 * turning,
    )


def answer(observation: Any, info: dict[str, Any], chunk: int | None) -> Any:
    """Return the policy's answer: an action, or a chunk from the simulation of its own actions."""
    state: State = tuple(map(float, observation))  # type: ignore[assignment]
    if chunk is None:
        return decide(state)
    actions = [int(each) for each in info["cloudrc"].get("prefix", ())][:chunk]
    for action in actions:
        state = predict(state, action)
    while len(actions) < chunk:
        actions.append(decide(state))
        state = predict(state, actions[-1])
    return actions


def stands(link: dict[str, Any], way: dict[str, Any], seed: int) -> bool:
    """Return whether the pole stands for the whole episode."""
    env = Networked(gymnasium.make("CartPole-v1"), link, seed, start="answer", **way)
    observation, info = env.reset(seed=seed)
    for _ in range(STEPS):
        action = answer(observation, info, way.get("chunk"))
        observation, _, fell, done, info = env.step(action)
        if fell or done:
            break
    env.close()
    return not fell


def profile(rtt: float, jitter: float, loss: float) -> dict[str, Any]:
    """Return a link with half of round trip and jitter [ms] in each direction."""
    way = {"delay_ms": rtt / 2, "jitter_ms": jitter / 2, "loss": loss}
    return {"uplink": way, "downlink": way}


def table(seeds: int, pool: Any) -> str:
    """Fly all combinations; return the table with the share of episodes and its 95 % interval."""
    lines = [f"| round trip [ms] | {' | '.join(WAYS)} |", "|---" * (len(WAYS) + 1) + "|"]
    for name, link in LINKS.items():
        cells = []
        for way in WAYS.values():
            stood = sum(pool.map(partial(stands, profile(*link), way), range(seeds)))
            low, high = exact_interval(stood, seeds)
            cells.append(f"{stood} ({low * 100:.0f}-{high * 100:.0f} %)")
        lines.append(f"| {name} | {' | '.join(cells)} |")
        print(lines[-1], flush=True)
    return "\n".join(lines) + "\n"


def main() -> None:
    """Print the table, and write it into the page if it has the page's number of seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    seeds = parser.parse_args().seeds
    with Pool() as pool:
        made = table(seeds, pool)
    text = PAGE.read_text()
    if seeds == 20 and BEGIN in text:
        before, _, rest = text.partition(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}\n{made}\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
