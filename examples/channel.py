# SPDX-License-Identifier: Apache-2.0

"""Several loops share one channel: ages and costs that are known exactly, beside what is measured.

    python examples/channel.py          # the table of docs/channel.md: minutes
    python examples/channel.py .1       # with a tenth of the steps

A slot is a step, and one observation leaves in it. So the newest is at least one step old.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial
from math import ceil, nan, sqrt
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

from cloudrc.gym import Channel, Waiting

Floats = NDArray[np.float64]
DT = 0.01  # time of a step [s]
RUNS = 20
PLANTS = (1.1, 1.4)  # a of two plants that share a channel


class Row(NamedTuple):
    """A result: its exact value, NaN if unknown, and how it is measured."""

    name: str
    schedule: str
    exact: float
    measure: Callable[[int, int], Floats]  # takes steps and runs; returns a value per run
    steps: int

    def at(self, scale: float = 1.0, runs: int = RUNS) -> tuple[float, float]:
        """Return the mean of the runs and its standard error."""
        found = self.measure(ceil(self.steps * scale), runs)
        return float(found.mean()), float(found.std(ddof=1)) / sqrt(runs)


def plants(factors: Sequence[float]) -> list[gymnasium.Env[Any, Any]]:
    """Make plants x+ = a x + u + w, with w ~ N(0, 1)."""
    return [gymnasium.make("cloudrc/Linear-v0", A=a).unwrapped for a in factors]


# The age of information of N robots behind one channel that loses observations with the chance p.
# I. Kadota et al., "Scheduling policies for minimizing age of information in broadcast wireless
# networks", IEEE/ACM Trans. Netw. 26(6), 2018.


def exact_age(count: int, loss: float, schedule: str) -> float:
    """Mean age of the observation that a policy has [steps]."""
    share = 1.0 - loss
    if schedule == "largest_age":
        return (count + 1) / (2.0 * share)
    return count / share - (count - 1) / 2.0


def age(count: int, loss: float, schedule: str, steps: int, runs: int) -> Floats:
    """Measure it."""
    link, found = {"uplink": {"loss": loss}}, np.zeros(runs)
    channel = Channel(plants([0.0] * count), link, schedule=schedule)
    warm_up = 5 * count
    for seed in range(runs):
        yields = 0
        for _, _, info in channel.play(seed, (warm_up + steps) * DT):
            yields += 1
            if yields > warm_up * count:
                found[seed] += info["cloudrc"]["observation_age"] / DT
        found[seed] /= yields - warm_up * count
    return found


# Costs. A dead-beat loop brings the state that it has seen to 0, one slot later, and then waits:
# u = -a (a x_seen + u_before) in the step in which an observation arrives, else 0.


class DeadBeat:
    """The policy of such a loop."""

    def __init__(self, a: float) -> None:
        self._a, self._sent = a, 0.0
        self._when = -1  # tick of the last input

    def __call__(self, seen: Floats, tick: int) -> list[float]:
        """Return the input for the tick in which the observation before it has arrived."""
        x = float(seen[0])
        if tick:
            x = self._a * x + self._sent * (self._when == tick - 1)
        self._when, self._sent = tick, -self._a * x
        return [self._sent]


def dead_beat(factors: Sequence[float], schedule: Any, steps: int, runs: int) -> Floats:
    """Mean of the sum of x^2 of dead-beat loops."""
    channel, found = Channel(plants(factors), schedule=schedule, hold="start"), np.zeros(runs)
    for seed in range(runs):
        policies, ticks = [DeadBeat(a) for a in factors], [0] * len(factors)
        for robot, seen, info in channel.play(seed, steps * DT):
            if info["cloudrc"]["asked"]:
                channel.answer(robot, policies[robot](seen, ticks[robot]))
            ticks[robot] += 1
        found[seed] = cost(channel)
    return found


def held(gains: Sequence[float], schedule: str, steps: int, runs: int) -> Floats:
    """Mean of the sum of x^2 of loops that hold u = -gain x_seen."""
    channel, found = Channel(plants(PLANTS), schedule=schedule), np.zeros(runs)
    policies = [lambda seen, gain=gain: -gain * seen for gain in gains]
    for seed in range(runs):
        channel.run(policies, steps * DT, seed)
        found[seed] = cost(channel)
    return found


def cost(channel: Channel) -> float:
    """Return the mean cost of a step, summed over the robots."""
    return -sum(each["return"] / each["ticks"] for each in channel.summaries())


def with_period(a: float, period: int) -> float:
    """Mean of x^2 of a dead-beat loop with an observation per `period` steps, one slot late."""
    return sum((a ** (2 * j) - 1.0) / (a * a - 1.0) for j in range(2, period + 2)) / period


def choose(waiting: Sequence[Waiting]) -> int:
    """Let the observation leave that is farthest from what a model of its plant predicts."""

    def error(each: Waiting) -> float:
        state = each.seen
        for action in each.actions:
            state = PLANTS[each.robot] * state + action
        return abs(float((each.observation - state)[0]))

    errors = [error(each) for each in waiting]
    return errors.index(max(errors))


def rows() -> list[Row]:
    """Return all results."""
    found = [
        Row(
            f"age [steps], N = {count}, p = {loss:g}",
            schedule,
            exact_age(count, loss, schedule),
            partial(age, count, loss, schedule),
            steps,
        )
        for count, loss, steps in ((5, 0.2, 600), (20, 0.1, 300))
        for schedule in ("round_robin", "largest_age")
    ]
    three, both = [1.2] * 3, sum(with_period(a, 2) for a in PLANTS)
    name = "sum of x², 3 dead-beat loops, a = 1.2"
    three_equal = partial(dead_beat, three, "round_robin")
    found.append(Row(name, "round_robin", 3.0 * with_period(1.2, 3), three_equal, 1_000))
    for schedule, exact, own in (
        ("round_robin", both, "round_robin"),
        ("largest_error", nan, "largest_error"),
        ("error of a model", nan, choose),
    ):
        name = "sum of x², 2 dead-beat loops, a = 1.1, 1.4"
        found.append(Row(name, schedule, exact, partial(dead_beat, PLANTS, own), 10_000))
    for schedule in ("round_robin", "largest_error"):
        name = "sum of x², 2 loops that hold u = -.4 x, -.6 x"
        found.append(Row(name, schedule, nan, partial(held, (0.4, 0.6), schedule), 10_000))
    return found


def main(scale: float = 1.0) -> None:
    """Print the table."""
    print("| result | schedule | exact | measured, 95 % |\n|---|---|---|---|")
    for row in rows():
        mean, error = row.at(scale)
        digits = 3 if error < 0.02 else 2
        exact = "" if np.isnan(row.exact) else f"{row.exact:.3f}"
        value = f"{mean:.{digits}f} ± {1.96 * error:.{digits}f}"
        print(f"| {row.name} | {row.schedule} | {exact} | {value} |", flush=True)


if __name__ == "__main__":
    main(*map(float, sys.argv[1:2]))
