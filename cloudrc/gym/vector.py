# SPDX-License-Identifier: Apache-2.0

"""Put a link between each robot of a vector environment and its policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Unpack

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate

from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import to_arrays
from cloudrc.gym.links import Links
from cloudrc.gym.options import (
    Options,
    answer_space,
    check_kind,
    connect,
    describe_answer,
    read_options,
    warn_of,
)
from cloudrc.gym.step import find_step
from cloudrc.gym.values import checker

if TYPE_CHECKING:
    _Wrapper = VectorWrapper[Any, Any, Any, Any, Any]
else:
    _Wrapper = VectorWrapper  # of which gymnasium 1.2 knows no types


class NetworkedVector(_Wrapper):
    """A vector environment in which each robot has a link of its own.

    It is to a vector environment what `Networked` is to an environment. Robot n has the stream
    `STREAM/n`, so that the robots share no random numbers. Each way of automatic reset is
    understood; a new episode of one robot begins with an idle link.
    """

    @naming("NetworkedVector")
    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        link: Links = "ideal",
        seed: int = 0,
        *,
        dt: float | None = None,
        stream: str = "",
        **options: Unpack[Options],
    ) -> None:
        """Wrap a vector environment; the arguments are those of `Networked`.

        `dt` is the time of a step [s].
        """
        options = read_options("NetworkedVector", options)
        check_kind(env, VectorEnv, "vector environment")
        super().__init__(env)
        space, chunk = env.single_action_space, options["chunk"]
        names = [f"{stream}/{robot}" for robot in range(env.num_envs)]
        both = env.single_observation_space, space
        self.step_time = find_step(env, dt)
        self._loops, links = connect(both, self.step_time.seconds, link, seed, names, options)
        self.single_action_space, self._split = answer_space(space, chunk)
        self.action_space = batch_space(self.single_action_space, env.num_envs)
        words = f"for each of {env.num_envs} robots {describe_answer(chunk)}"
        self._check = checker(self.action_space, words)
        seen = self._loops[0].memory.space
        if seen is not both[0]:  # it has memory
            self.single_observation_space = seen
            self.observation_space = batch_space(seen, env.num_envs)
        self._mode = AutoresetMode(env.metadata["autoreset_mode"])
        self._ended = np.zeros(env.num_envs, dtype=bool)
        warn_of(env, self._loops[0], links, self.step_time, chunk)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Any = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode of each robot, or of those in `options["reset_mask"]`."""
        mask = (options or {}).get("reset_mask")
        chosen = np.ones(self.num_envs, dtype=bool) if mask is None else mask.copy()
        seeds: Any = seed
        observations, infos = self.env.reset(seed=seeds, options=options)
        if seed is None:
            seeds = [None] * self.num_envs
        elif isinstance(seed, int | np.integer):
            seeds = [seed + n for n in range(self.num_envs)]
        parts = iterate(self.env.observation_space, observations)
        for n, observation in enumerate(parts):
            if chosen[n]:
                self._loops[n].begin(seeds[n], observation, _part(infos, n))
        self._ended &= ~chosen
        return self._seen([{}] * self.num_envs)

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        """Send each policy's answer, and step the world with what the robots execute."""
        actions = to_arrays(actions)
        self._check(actions)
        space = self.env.single_action_space
        answers = iterate(self.action_space, actions)
        executed = [
            loop.act(self._split(answer)) for loop, answer in zip(self._loops, answers, strict=True)
        ]
        batch = _batch(space, executed)
        observations, rewards, terminated, truncated, infos = self.env.step(batch)
        ends = np.logical_or(terminated, truncated)
        finals = [
            self._observe(n, observation, _part(infos, n), bool(ends[n]))
            for n, observation in enumerate(iterate(self.env.observation_space, observations))
        ]
        self._ended = ends
        seen, told = self._seen(finals)
        return seen, rewards, terminated, truncated, told

    def _observe(
        self, n: int, observation: Any, info: dict[str, Any], has_ended: bool
    ) -> dict[str, Any]:
        """Move robot n to its next tick; return what is told at once about an ended episode."""
        loop = self._loops[n]
        if self._mode is AutoresetMode.NEXT_STEP and self._ended[n]:
            loop.begin(None, observation, info)
            return {}
        if not (has_ended and self._mode is AutoresetMode.SAME_STEP):
            loop.observe(observation, info)
            return {"cloudrc": {"episode": loop.summary()}} if has_ended else {}
        last = info.pop("final_obs", observation), info.pop("final_info", {})
        loop.observe(*last)
        seen, about = loop.observed(), loop.seen[1]
        told = {**loop.told(), "episode": loop.summary()}
        loop.begin(None, observation, info)
        return {"final_obs": seen, "final_info": {**about, "cloudrc": told}}

    def _seen(self, finals: Sequence[dict[str, Any]]) -> tuple[Any, dict[str, Any]]:
        """Return the newest observations and infos that the policies have."""
        seen, infos = list[Any](), dict[str, Any]()
        for n, loop in enumerate(self._loops):
            seen.append(loop.observed())
            told = loop.told() | finals[n].get("cloudrc", {})
            self._add_info(infos, {**loop.seen[1], **finals[n], "cloudrc": told}, n)
        return _batch(self.single_observation_space, seen), infos


def _batch(space: Any, values: Sequence[Any]) -> Any:
    """Return the values of all robots, each of `space`, as the vector environment has them."""
    made: Any = create_empty_array(space, len(values))
    return concatenate(space, values, made)


def _part(infos: Mapping[str, Any], n: int) -> dict[str, Any]:
    """Return the info of robot n from the infos of all."""
    found = {}
    for key, value in infos.items():
        mask = infos.get(f"_{key}")
        if key.startswith("_") or (mask is not None and not mask[n]):
            continue
        found[key] = _part(value, n) if isinstance(value, Mapping) else value[n]
    return found
