# SPDX-License-Identifier: Apache-2.0

"""Play one episode of an environment with a policy at the other end of a link."""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import cache
from hashlib import sha256
from math import isfinite
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from numpy.typing import NDArray

from cloudrc.base import source
from cloudrc.base.errors import CloudrcError
from cloudrc.base.files import write_json
from cloudrc.base.outside.code import calling
from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import ANY, InvalidValueError
from cloudrc.flight.pod.openpi.actions import PolicyAnswerError, read_actions
from cloudrc.gym import Channel, Networked
from cloudrc.gym.answers import to_document
from cloudrc.gym.options import ANSWER
from cloudrc.gym.step import find_step
from cloudrc.gym.values import size_of
from cloudrc.studies.eval.environment import environment_code, find_module
from cloudrc.studies.eval.setup import BARE, SEED, Episode, EvalSetup, link_at
from cloudrc.studies.eval.tally import Tally, Witness
from cloudrc.studies.policy.load import LoadedPolicy, PolicyFailedError
from cloudrc.studies.policy.observation import observe

AGE_NUMBERS = {"": "_mean", "_p99": "_p99", "_of": "_of", "_max": "_max", "_peak": "_peak_mean"}
"""End of a number of ages in a row -> in the summary of a loop."""
Ask = Callable[[dict[str, Any]], Any]
"""Function that returns a policy's answer to its observation."""


def play(
    episode: Episode, setup: EvalSetup, key: str = "", keep: Path | None = None
) -> dict[str, Any]:
    """Play an episode; return its row. Raise a CloudrcError if policy or environment fail.

    With `keep`, write into this file when each answer was asked for, made and executed.
    """
    played = episode
    if episode.is_baseline:
        setup, played = replace(setup, **BARE), Episode(episode.rtt_ms, "newest", episode.seed)
    with make_env(setup, episode.seed) as env, asking(setup) as ask:
        ended, success, digest, numbers, loop = _play(played, setup, env, ask)
    numbers |= numbers_of(loop)
    if keep:
        write_json(keep, to_document(loop["timeline"]))
    return row_of(episode, setup, key, ended, success, digest, numbers, loop)


def row_of(
    episode: Episode,
    setup: EvalSetup,
    key: str,
    ended: str,
    success: bool | None,
    digest: str,
    numbers: Mapping[str, float | None],
    loop: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the row of an episode that has been played."""
    judged = {None: "done", True: "success", False: "failure"}
    return {
        "key": key,
        "point": episode.point,
        "seed": episode.seed,
        "verdict": judged[success],
        "failures": [],
        "text": "",
        "ended": ended,
        "numbers": {k: v for k, v in numbers.items() if v is not None and isfinite(v)},
        "age_counts": loop["age_counts"],
        "link_start": loop["link_start"],
        "doubts": loop["doubts"],
        "records_sha256": digest if setup.is_repeatable else "",
        "code": source.code_hash(),
    }


def numbers_of(loop: Mapping[str, Any]) -> dict[str, float]:
    """Return what a row tells about the loop: ages [s], delays [s] and losses."""
    found = {"loop_age": loop["loop_age"]}
    for name in ("observation_age", "action_age"):
        found |= {name + end: loop[name + key] for end, key in AGE_NUMBERS.items()}
    found |= {name: loop[name] for name in ("late_share", "misses_in_10")}
    found |= {name: value for name, value in loop.items() if name.startswith("budget_")}
    for way in ("uplink", "downlink"):
        found |= {f"{name}_{way}": loop[way][name] for name in ("delay_asked", "delay_measured")}
        found[f"loss_{way}"] = loop[way]["loss_measured"]
        found |= {f"{name}_{way}": loop[way][name] for name in ("packets_sent", "packets_lost")}
    if (shown := loop["uplink"].get("shown")) is not None:  # with a codec
        found |= {"frames_shown": shown, "observation_bytes": loop["uplink"]["bytes"]}
    return found


@contextmanager
def make_env(setup: EvalSetup, seed: int) -> Iterator[gymnasium.Env[Any, Any]]:
    """Make the environment of an episode; its failure in the block is the user's."""
    words = {key: seed if value == SEED else value for key, value in setup.env_args}
    what = f"--env {setup.env}"
    with calling(what, keep=CloudrcError, slow=f"{what} is still being made"):
        name = find_module(setup)
        try:
            env = gymnasium.make(name, disable_env_checker=True, **words)
        except gymnasium.error.UnregisteredEnv as error:
            hint = "" if ":" in name else f"; if a module of your own registers it: MODULE:{name}"
            raise InvalidValueError(f"{error}{hint}") from None
    with calling(f"{what}: the episode failed", keep=CloudrcError), closing(env):
        yield env


@contextmanager
def asking(setup: EvalSetup, robot: int = 0) -> Iterator[Ask]:
    """Begin an episode of the policy of a robot; yield the function that asks it."""
    if not setup.is_remote:
        policy = _load(setup.policy, robot)
        policy.reset()
        yield policy.infer
        return
    from cloudrc.flight.pod.openpi import KEY_VARIABLE
    from cloudrc.flight.pod.openpi.client import PolicyClient

    with PolicyClient(setup.policy, key=os.environ.get(KEY_VARIABLE, "")) as client:
        yield client.infer


@cache  # it may have to load weights
def _load(policy: str, robot: int = 0) -> LoadedPolicy:
    """Load the policy of a robot: each has its own, which may have a state."""
    return LoadedPolicy(policy)


class AskedPolicy:
    """A policy that answers with chunks of one size, in the form of the action space."""

    def __init__(self, ask: Ask, setup: EvalSetup, space: spaces.Space[Any]) -> None:
        self._ask, self._setup, self._space = ask, setup, space
        self._width, self._may_switch = width_of(space), not isinstance(space, spaces.Box)
        self._count: int | None = None
        self.duration = 0.0  # of the last answer [s]
        self.size = 0  # of the last observation on the wire, without memory [bytes]

    def __call__(
        self, observation: Any, prefix: Sequence[Any] = (), delay: int = 0
    ) -> NDArray[Any]:
        """Return the chunk of actions for an observation.

        The policy finds the actions that the robot has, and how many it will have executed, beside
        its observation.
        """
        asked = observe(observation, self._setup.mapped)
        self.size = _sent_size(observation, self._setup)
        if prefix:
            asked["prefix"] = np.array(prefix).reshape(len(prefix), -1)
            asked["delay"] = delay
        start = time.perf_counter()
        answer = self._ask(asked)
        self.duration = time.perf_counter() - start
        try:
            actions = read_actions(answer, self._width, may_switch=self._may_switch)
            if self._count not in (None, len(actions)):
                raise PolicyAnswerError(f"a chunk of {len(actions)} actions after {self._count}")
            self._count = len(actions)
            return as_actions(actions, self._space)
        except PolicyAnswerError as error:
            raise PolicyFailedError(f"policy '{self._setup.policy}': {error}") from None


def width_of(space: spaces.Space[Any]) -> int:
    """Return the number of values of an action; raise an InvalidValueError if it has none."""
    if isinstance(space, spaces.Box | spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return int(np.prod(space.shape or ()))
    raise InvalidValueError(
        f"its actions are {type(space).__name__}, which no policy's chunk has; use an environment "
        "whose actions are numbers"
    )


def as_actions(actions: NDArray[Any], space: spaces.Space[Any]) -> NDArray[Any]:
    """Return a chunk, shape (H, A), as the space's actions have it.

    Raise a PolicyAnswerError if the space's type cannot hold a value, as .5 among integers, or for
    a choice that the space has not. A value outside of a `Box` is the environment's to judge: many
    clip it.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        held = actions.astype(space.dtype)
    holds = np.isfinite(held) if held.dtype.kind == "f" else held == actions
    if not holds.all():
        value = actions[~holds][0]
        raise PolicyAnswerError(
            f"the action {value:g} does not fit the type {held.dtype} of {space}"
        )
    shaped: NDArray[Any] = held.reshape(len(held), *(space.shape or ()))
    for action in shaped:
        if not (isinstance(space, spaces.Box) or space.contains(action)):
            raise PolicyAnswerError(f"the action {action} is none of {space}")
    return shaped


def _play(
    episode: Episode, setup: EvalSetup, env: gymnasium.Env[Any, Any], ask: Ask
) -> tuple[str, bool | None, str, dict[str, float | None], dict[str, Any]]:
    """Play an episode; return how it ended, its success, hash and numbers, and what the loop was.

    It ends "terminated" or "truncated" by the environment, or by its "limit". The success is None
    if the environment does not tell.
    """
    witness, policy = Witness(env), AskedPolicy(ask, setup, env.action_space)
    observation, _ = Networked(witness, **beginning(setup, env)).reset(seed=episode.seed)
    chunk = policy(observation)  # the first answer, whose size the link has to know
    world, doubts = _connect(witness, episode, setup, policy, len(chunk))
    witness.digest = sha256()
    observation, info = world.reset(seed=episode.seed)
    if times := setup.times:
        world.compute = lambda tick: times[(episode.seed + tick) % len(times)]
    if setup.is_measured:
        world.compute = lambda tick: policy.duration
    tally, ended = Tally(witness, setup), "limit"
    while tally.steps < setup.max_steps and ended == "limit":
        about = info["cloudrc"]
        if about["asked"] and tally.steps:
            chunk = policy(observation, about.get("prefix", ()), about.get("delay", 0))
        observation, _, terminated, truncated, info = world.step(chunk)
        tally.count(info["cloudrc"], world.dt)
        if terminated or truncated:
            ended = "terminated" if terminated else "truncated"
    success, numbers = tally.numbers()
    loop = {**world.summary(), "doubts": doubts, "timeline": world.timeline()}
    return ended, success, witness.digest.hexdigest(), numbers, loop


def _connect(
    env: gymnasium.Env[Any, Any],
    episode: Episode,
    setup: EvalSetup,
    policy: AskedPolicy,
    count: int,
) -> tuple[Networked, list[str]]:
    """Put the link between environment and policy, which has answered with `count` actions.

    Also return what `Networked` warns of.
    """
    with hearing() as doubts:
        given = options_of(env, episode, setup, policy, count)
        world = Networked(env, link_at(setup.link, episode.rtt_ms), episode.seed, **given)
    return world, doubts


def options_of(
    env: gymnasium.Env[Any, Any],
    episode: Episode,
    setup: EvalSetup,
    policy: AskedPolicy,
    count: int,
) -> dict[str, Any]:
    """Return the options of the loop of a policy, which has answered with `count` actions."""
    sent = setup.sent_bytes if setup.codec else setup.observation_bytes
    if sent is None and not setup.codec:
        sent = policy.size
    return {
        "compute": policy.duration if setup.is_measured else setup.compute_times,
        "answer_within": setup.answer_within,
        "deadline": setup.deadline,
        "chunk": count,
        "executor": episode.chosen,
        "observation_bytes": sent,
        "delivery": setup.delivery,
        "packet_bytes": setup.packet_bytes,
        **beginning(setup, env),
    }


def beginning(setup: EvalSetup, env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Return the arguments of `Networked` that the first observation depends on."""
    start, space = setup.start, env.action_space
    if start not in (None, ANSWER):
        with naming("--start", "'answer', 'none', or an action"):
            row = ANY.row(start if isinstance(start, list) else [start], width_of(space))
            try:
                start = as_actions(np.array([row]), space)[0]
            except PolicyAnswerError as error:
                raise InvalidValueError(str(error)) from None
    dt = setup.step.seconds if setup.step else setup.dt
    given = {"dt": dt, "start": start, "hold": setup.hold, "codec": setup.codec}
    return {**given, **setup.memory}


@contextmanager
def hearing() -> Iterator[list[str]]:
    """Yield a list that has what was warned of, once the block is over."""
    found = list[str]()
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        yield found
    found += dict.fromkeys(str(each.message) for each in seen)


def check_environment(setup: EvalSetup, episodes: list[Episode]) -> tuple[EvalSetup, list[str]]:
    """Return the setup with what is known about the environment; check policy and executors.

    Also return what makes episodes pointless, as far as it is known without an answer. The call
    comes before a folder is made. A server is not asked.
    """
    with make_env(setup, 1) as env:
        with naming(f"--env {setup.env}"):
            width_of(env.action_space)
            step = find_step(env, setup.dt)
        setup = replace(setup, step=step, env_code=environment_code(env, setup))
        given = beginning(setup, env)
        for episode in {each.point["executor"]: each for each in episodes}.values():
            wait = setup.answer_within
            Networked(env, chunk=1, executor=episode.chosen, answer_within=wait, **given)
        digest, size = _first_observation(env, setup)
        if setup.observation_bytes is not None:
            size = setup.observation_bytes
        setup = replace(setup, sent_bytes=size)
        given |= {"delivery": setup.delivery, "packet_bytes": setup.packet_bytes}
        given |= {"compute": 0.0 if setup.is_measured else setup.compute_times}
        limited = TimeLimit(env, setup.max_steps)
        if setup.channel:
            with naming("--channel"):
                Channel([env], chunk=1, **setup.channel._asdict(), **beginning(setup, env))
        with hearing() as doubts:
            for rtt in sorted({each.rtt_ms for each in episodes}, key=str):
                Networked(limited, link_at(setup.link, rtt), observation_bytes=size, **given)
    if not setup.is_remote:
        _load(setup.policy)
    with make_env(setup, 1) as env:
        follows_seed = _first_observation(env, setup)[0] == digest
    return replace(setup, follows_seed=follows_seed), doubts


def _first_observation(env: gymnasium.Env[Any, Any], setup: EvalSetup) -> tuple[str, int]:
    """Return hash and size [bytes] of the observation with which the seed 1 begins."""
    witness = Witness(env)
    first = Networked(witness, **beginning(setup, env))
    observation, _ = first.reset(seed=1)
    size = first.observation_bytes if setup.codec else _sent_size(observation, setup)
    return witness.digest.hexdigest(), size


def _sent_size(observation: Any, setup: EvalSetup) -> int:
    """Return the size of an observation on the wire [bytes]: without memory, which is not sent."""
    sent = observation
    if any(setup.memory.values()):
        sent = {key: () for key in observation} | {"observation": observation["observation"]}
    return size_of(observe(sent, setup.mapped))
