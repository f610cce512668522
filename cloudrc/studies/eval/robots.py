# SPDX-License-Identifier: Apache-2.0

"""Play one episode of several robots that share a channel, each with its policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from hashlib import sha256
from itertools import zip_longest
from math import isfinite
from pathlib import Path
from statistics import fmean
from typing import Any

from cloudrc.base.files import write_json
from cloudrc.gym import Channel, Networked
from cloudrc.gym.answers import to_document
from cloudrc.studies.eval.episode import (
    AskedPolicy,
    asking,
    beginning,
    hearing,
    make_env,
    numbers_of,
    options_of,
    row_of,
)
from cloudrc.studies.eval.evidence import LARGEST, WEIGHTS
from cloudrc.studies.eval.setup import BARE, Episode, EvalSetup, SharedChannel, link_at
from cloudrc.studies.eval.tally import Tally, Witness

ALONE = SharedChannel(schedule=None)
"""Each robot has an uplink of its own."""
ENDS = ("terminated", "truncated", "limit")
"""How an episode of several robots has ended: as the first of these."""
MOST = tuple(name for name, _, _ in LARGEST)
"""Numbers of which the largest robot's counts."""


class _Robot:
    """A robot, its policy, and what its episode is like.

    Attributes:
        first: The answer of its policy to the first observation.
    """

    def __init__(self, witness: Witness, policy: AskedPolicy, setup: EvalSetup, seed: int) -> None:
        """Ask the policy for the first answer, whose size the link has to know."""
        self.witness, self.policy = witness, policy
        world = Networked(witness, **beginning(setup, witness))
        self.first = policy(world.reset(seed=seed)[0])
        witness.digest = sha256()
        self.tally: Tally | None = None

    def answer(self, observation: Any, about: Mapping[str, Any]) -> Any:
        """Return the policy's answer to an observation."""
        if self.tally is None or not self.tally.steps:
            return self.first
        return self.policy(observation, about.get("prefix", ()), about.get("delay", 0))

    def time_of(self, times: Sequence[float], seed: int, tick: int) -> float:
        """Return the time for the answer to the observation of a tick [s]."""
        return times[(seed + tick) % len(times)] if times else self.policy.duration


def play(
    episode: Episode, setup: EvalSetup, key: str = "", keep: Path | None = None
) -> dict[str, Any]:
    """Play an episode of several robots; return its row.

    Numbers are means over the robots, of steps where they are of steps; the largest of the largest
    ages; packets are those of all. A success is one of all robots. Robot n gets the seed
    (s - 1) N + n + 1 in the episode with the seed s, so that no two episodes share an environment.
    With `keep`, each robot has a file of its own: this name with -robot0 and so on. Raise a
    CloudrcError if policy or environment fail.
    """
    played = episode
    if episode.is_baseline:
        setup, played = replace(setup, **BARE, channel=ALONE), replace(episode, executor="newest")
    seed, count = (episode.seed - 1) * setup.robots + 1, range(setup.robots)
    with ExitStack() as stack:
        robots = list[_Robot]()
        for n in count:
            witness = Witness(stack.enter_context(make_env(setup, seed + n)))
            ask = stack.enter_context(asking(setup, n))
            policy = AskedPolicy(ask, setup, witness.action_space)
            robots.append(_Robot(witness, policy, setup, seed + n))
        channel, doubts = _connect(robots, played, setup)
        _play(channel, robots, setup, seed)
    if keep:
        for n, each in enumerate(channel.loops):
            write_json(keep.with_stem(f"{keep.stem}-robot{n}"), to_document(each.timeline()))
    told = channel.summaries()
    found = [each.tally.numbers() for each in robots if each.tally]
    every = [
        {k: v for k, v in (numbers | numbers_of(loop)).items() if v is not None and isfinite(v)}
        for (_, numbers), loop in zip(found, told, strict=True)
    ]
    successes = [success for success, _ in found]
    ended = next(end for end in ENDS if end in [loop["ended"] for loop in told])
    digest = sha256("".join(each.witness.digest.hexdigest() for each in robots).encode())
    ages = (loop["age_counts"] for loop in told)
    loop = {**told[0], "doubts": doubts, "age_counts": [*map(sum, zip_longest(*ages, fillvalue=0))]}
    success = None if None in successes else all(successes)
    row = row_of(episode, setup, key, ended, success, digest.hexdigest(), _merge(every), loop)
    return {**row, "robots": every}


def _connect(
    robots: Sequence[_Robot], episode: Episode, setup: EvalSetup
) -> tuple[Channel, list[str]]:
    """Connect the robots with their channel; also return what it warns of."""
    first, channel = robots[0], setup.channel or ALONE
    given = options_of(first.witness, episode, setup, first.policy, len(first.first))
    envs, link = [each.witness for each in robots], link_at(setup.link, episode.rtt_ms)
    with hearing() as doubts:
        made = Channel(envs, link, seed=episode.seed, **channel._asdict(), **given)
    return made, doubts


def _play(channel: Channel, robots: Sequence[_Robot], setup: EvalSetup, seed: int) -> None:
    """Play an episode, and count the steps of each robot."""
    dt = setup.step.seconds if setup.step else channel.dt[0]
    if setup.times or setup.is_measured:
        for n, loop in enumerate(channel.loops):
            loop.compute = partial(robots[n].time_of, setup.times, seed + n)
    for n, observation, info in channel.play(seed, setup.max_steps * dt):
        robot, about = robots[n], info["cloudrc"]
        if robot.tally is None:
            robot.tally = Tally(robot.witness, setup)
        else:
            robot.tally.count(about, dt)
        if about["asked"] and "episode" not in about:
            channel.answer(n, robot.answer(observation, about))


def _merge(every: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the numbers of an episode from those of its robots."""
    merged = dict[str, float]()
    for name in dict.fromkeys(key for each in every for key in each):
        known = [each for each in every if name in each]
        values = [each[name] for each in known]
        weight = WEIGHTS.get(name)
        weights = [each[weight] for each in known] if weight else None
        if name in MOST:
            merged[name] = max(values)
        elif name == "success":
            merged[name] = min(values)
        elif name.endswith("_of") or name.startswith("packets_"):
            merged[name] = sum(values)
        elif weights is None or any(weights):
            merged[name] = fmean(values, weights)
    return merged
