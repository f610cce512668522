# SPDX-License-Identifier: Apache-2.0

"""The link between environment and policy equals a simulation that is written from its rule alone.

The rule is in docs/gym.md. The simulation shares no code with cloudrc.gym: it takes delays
and losses from the link library, and has the executors as functions of all answers received so far.
"""

from functools import cache
from itertools import count
from math import ceil, exp, inf
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest

from cloudrc.gym import Networked
from cloudrc.link.library import OneWay, read_profile
from tests.conftest import nightly
from tests.gym.envs import both_ways

SEED = 1
ENV, DT = "Pendulum-v1", 0.05
"""The environment, and its time of a step [s]."""
IDLE = np.zeros(1, np.float32)
"""Action of a robot without answers."""
BYTES = {"observation_bytes": 60, "action_bytes": 40}
LINKS = {
    "constant": both_ways(50, 10),
    "uniform, loss": both_ways(40, 40, jitter_ms=15, distribution="uniform", loss=0.1),
    "lte": "lte",
}
EPISODES = 2**20


class Answer(NamedTuple):
    """What the robot has received."""

    basis: int  # tick of the observation
    tick: int  # in which it was received
    actions: list


class Setup(NamedTuple):
    """Link, executor and times of an episode [s]."""

    link: str
    executor: str
    chunk: int | None = None
    compute: float = 0.0
    wait: float | None = None  # None: 5 % of a step
    start: Any = "answer"  # or an action
    uses_prefix: bool = False
    times: tuple[float, ...] = ()  # of computing, by the tick of the observation, in turn

    def compute_ns(self, tick):
        return round((self.times[tick % len(self.times)] if self.times else self.compute) * 1e9)

    @property
    def wait_ns(self):
        return round((0.05 * DT if self.wait is None else self.wait) * 1e9)


class Episode(NamedTuple):
    """What is compared. Ages are those of single steps [s]."""

    result: float  # sum of the rewards
    observation_ages: list
    action_ages: list
    held: list
    asked: list
    means: dict


# The simulation ---------------------------------------------------------------------------------


def played(got, tick):
    """Play the newest answer from its first action, beginning when it was received."""
    basis, start, actions = max(got)
    return (actions[tick - start], basis) if tick - start < len(actions) else None


def indexed(got, tick):
    """Action i of the newest answer belongs to the tick basis + i."""
    basis, _, actions = max(got)
    return (actions[tick - basis], basis) if tick - basis < len(actions) else None


def averaged(got, tick):
    """Weighted mean of all answers with an action for the tick, and of their ticks."""
    kept = sorted(each for each in got if tick - each.basis < len(each.actions))
    weights = [exp(-0.01 * place) for place in range(len(kept))]
    if not kept:
        return None
    mean = np.average([each.actions[tick - each.basis] for each in kept], axis=0, weights=weights)
    return mean.astype(np.float32), np.average([each.basis for each in kept], weights=weights)


CHOOSE = {
    "newest": played,
    "broker": played,
    "time_indexed": indexed,
    "prefix": indexed,
    "ensemble": averaged,
}


def asks(setup, got, asked, tick):
    """Return whether the robot sends the observation of the tick."""
    if setup.executor != "broker":
        return True
    basis, start, actions = max(got, default=Answer(-1, 0, []))
    is_open = asked > basis and (tick - asked) * DT < 1.0 - 1e-9
    return tick >= start + len(actions) and not is_open


def simulate(env, setup, seed, answer):
    """Play an episode by the rule."""
    ways = links(setup.link)
    up, down = (OneWay(way, SEED, is_up) for way, is_up in zip(ways, (True, False), strict=True))
    number, late = (seed + 1) * EPISODES, ticks_late(setup)
    observations = [env.reset(seed=seed)[0]]
    executed = setup.start if isinstance(setup.start, np.ndarray) else IDLE
    at_policy, taken, free = {0: 0}, -1, 0  # arrivals [ns] of observations not yet taken
    flying, got, told_with, asked, basis = [], [], {0: []}, 0, None
    rewards, is_over, rows, loop = 0.0, False, [], []
    if isinstance(setup.start, str):
        got, at_policy, taken = [Answer(0, 0, answer(observations[0], []))], {}, 0

    def receive(until_ns, tick):
        for packet in sorted(each for each in flying if each[0] <= until_ns):
            flying.remove(packet)
            got.append(Answer(packet[1], tick, packet[2]))
            loop.append((tick - packet[1], packet[1]))

    for tick in count():
        now_ns = round(tick * DT * 1e9)
        receive(now_ns, tick)
        if tick and asks(setup, got, asked, tick):
            asked, told_with[tick] = tick, []
            if got:
                newest = max(got)
                told_with[tick] = newest.actions[tick - newest.basis :][:late]
            size = BYTES["observation_bytes"] + sum(np.asarray(n).nbytes for n in told_with[tick])
            if arrivals := up.send(number, tick, size, now_ns):
                at_policy[tick] = min(arrivals)
        question = None
        while at_policy and max(min(at_policy.values()), free) <= now_ns + setup.wait_ns:
            begin = max(min(at_policy.values()), free)
            taken = max(each for each, arrival in at_policy.items() if arrival <= begin)
            at_policy = {each: at for each, at in at_policy.items() if each > taken}
            free = begin + setup.compute_ns(taken)
            question = taken, free
        rows.append([taken, question is not None, None, None])
        if is_over:
            break
        if question:
            of, leaves_ns = question
            actions = answer(observations[of], told_with[of])
            if arrivals := down.send(number, of, BYTES["action_bytes"], leaves_ns):
                flying.append((min(arrivals), of, actions))
        receive(now_ns + setup.wait_ns, tick)
        chosen = CHOOSE[setup.executor](got, tick) if got else None
        executed, basis = chosen or (executed, basis)
        rows[-1][2:] = inf if basis is None else tick - basis, chosen is None
        observation, reward, terminated, truncated, _ = env.step(executed)
        observations.append(observation)
        rewards += reward
        is_over = terminated or truncated
    return told(setup, rewards, rows, loop)


def told(setup, rewards, rows, loop):
    """Return ages and means of a simulated episode."""
    taken, asked, old, held = zip(*rows, strict=True)
    after = [(tick - each, each) for tick, each in enumerate(taken)][1:]
    ages = [age for age, of in after if of > 0]
    acted = [age for tick, age in enumerate(old[:-1]) if age < tick]  # of an observation after 0
    crossed = [age for age, of in loop if of > 0]
    means = {"observation_age_of": len(ages), "action_age_of": len(acted)}
    for name, found in (("observation_age", ages), ("action_age", acted), ("loop_age", crossed)):
        key = name if name == "loop_age" else f"{name}_mean"
        means[key] = DT * float(np.mean(found)) if found else None
    rounded = [ceil(age - 1e-9) for age in acted]
    means["age_counts"] = [rounded.count(age) for age in range(max(rounded, default=-1) + 1)]
    return Episode(
        rewards,
        [DT * age for age, _ in after],
        [DT * age for age in old[:-1]],
        list(held[:-1]),
        list(asked[1:]),
        means,
    )


@cache
def links(name):
    """Return the two directions of a link."""
    profile = read_profile(LINKS[name])
    return profile.uplink, profile.downlink


@cache
def mean_delay(link):
    """Return the delay of both ways that the profile asks for [s]."""
    both = zip(links(link), (True, False), BYTES.values(), strict=True)
    return sum(OneWay(way, SEED, is_up).expected(DT, size).mean for way, is_up, size in both)


def ticks_late(setup):
    """Return how many actions the executor `prefix` sends with an observation."""
    if setup.executor != "prefix":
        return 0
    late = mean_delay(setup.link) + setup.compute - setup.wait_ns * 1e-9
    return max(0, ceil(late / DT))


def policy(setup):
    """Return the policy: from observation and prefix to a list of torques, which fade."""

    def swing(observation, prefix):
        torque, known = -2.0 * observation[1] - 0.5 * observation[2], prefix * setup.uses_prefix
        fading = 1.0 - 0.04 * np.arange(setup.chunk or 1)
        torques = [np.array([torque * share], np.float32) for share in fading]
        return [*known, *torques[len(known) :]][: len(torques)]

    return swing


# Measured ---------------------------------------------------------------------------------------


def make(steps):
    """Return the environment without a link."""
    return gymnasium.make(ENV, max_episode_steps=steps)


def networked(setup, steps):
    """Return the environment behind the link."""
    env = Networked(
        make(steps),
        LINKS[setup.link],
        SEED,
        compute=setup.compute,
        chunk=setup.chunk,
        executor=setup.executor,
        start=setup.start,
        **({} if setup.wait is None else {"answer_within": setup.wait}),
        **BYTES,
    )
    if setup.times:
        env.compute = lambda tick: setup.times[tick % len(setup.times)]
    return env


def measure(env, setup, seed, answer):
    """Play an episode with cloudrc. The action without a question is not used."""

    def packed(actions):
        return actions[0] if setup.chunk is None else np.stack(actions)

    idle, rows = packed([IDLE] * (setup.chunk or 1)), []
    observation, info = env.reset(seed=seed)
    is_over, rewards, asked = False, 0.0, info["cloudrc"]["asked"]
    while not is_over:
        known = list(info["cloudrc"].get("prefix", []))
        given = packed(answer(observation, known)) if asked else idle
        observation, reward, terminated, truncated, info = env.step(given)
        rewards += reward
        is_over, found = terminated or truncated, info["cloudrc"]
        asked = found["asked"]
        rows.append((found["observation_age"], found["action_age"], found["held"], asked))
    return Episode(rewards, *map(list, zip(*rows, strict=True)), info["cloudrc"]["episode"])


def assert_equal(found, expected):
    """Compare an episode with the simulated one."""
    for name in ("asked", "held"):
        assert getattr(found, name) == getattr(expected, name), name
    for name in ("observation_ages", "action_ages"):
        pair = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(*pair, rtol=0, atol=1e-9, err_msg=name)
    for name, value in expected.means.items():
        if value is not None:
            assert found.means[name] == pytest.approx(value, abs=1e-9), name
    assert found.result == expected.result


EXECUTORS = (
    *(("newest", None, False), ("newest", 8, False), ("time_indexed", 16, False)),
    *(("prefix", 16, False), ("prefix", 16, True), ("broker", 8, False), ("ensemble", 16, False)),
)
"""Name, size of a chunk (None: one action), and whether the policy uses the prefix."""
LATE = [
    Setup(link, *executor, 0.04, wait, start, uses)
    for link, wait, start in (
        *(("constant", None, "answer"), ("constant", 0.0, None), ("lte", None, "answer")),
        *(("uniform, loss", None, "answer"), ("uniform, loss", 0.012, IDLE + 1.0)),
    )
    for *executor, uses in EXECUTORS
]
"""With the link `constant`, observations and answers arrive exactly at a step."""
OTHER_TIMES = [
    Setup(link, *executor, compute, uses_prefix=uses)
    for link in LINKS
    for *executor, uses in EXECUTORS
    for compute in (0.0, 0.08)
]


def compare(setup, seeds, steps):
    """Compare episodes of cloudrc with those of the simulation."""
    env, answer = networked(setup, steps), policy(setup)
    for seed in seeds:
        expected = simulate(make(steps), setup, seed, answer)
        assert_equal(measure(env, setup, seed, answer), expected)


@pytest.mark.parametrize("setup", [*LATE, *nightly(*OTHER_TIMES)])
def test_every_episode_equals_the_simulation(setup):
    compare(setup, range(2), 60)


# The rule of step() -----------------------------------------------------------------------------


@pytest.mark.parametrize("link", ["uniform, loss", "lte"])
@pytest.mark.parametrize("times", [(0.02, 0.15), (0.0, 0.06, 0.03, 0.2)])
def test_each_answer_takes_its_own_time(link, times):
    """The time of the last answer once decided which observation the policy took next."""
    compare(Setup(link, "newest", times=times), range(5), 100)
