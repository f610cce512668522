# SPDX-License-Identifier: Apache-2.0

"""Put a link between an environment and its policy: a wrapper for any gymnasium environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from numpy.typing import NDArray

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


class Networked(gymnasium.Wrapper[Any, Any, Any, Any], RecordConstructorArgs):
    """An environment whose policy is at the other end of a link, in virtual time.

    The world never waits: one step of the environment takes `dt`, and observations and actions that
    are late are late. The policy answers when an observation arrives, once to each. Rewards and the
    end of an episode are those of the world, told at once. Nothing else leaks: the observation, and
    the environment's info with it, are the newest that the policy has taken. Delay and loss of a
    packet depend on seed, stream, direction, episode and tick alone, so that another policy meets
    the same network.

    `info["cloudrc"]` tells whether the observation is new, so that the next action is its answer
    (`asked`; any other action is ignored), the ages of the observation and of the executed action
    [s], whether the robot had no action (`held`), and what was lost. At the end of an episode it
    has a summary, `episode`, with delays and losses: asked by the profile, and measured.

    Attributes:
        step_time: The time of a step, and who tells it; `dt` is this time alone [s].
        world_info: The environment's own info of the last step, without any delay: for whoever
            judges the episode, not for the policy.
    """

    @naming("Networked")
    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        link: Links = "ideal",
        seed: int = 0,
        *,
        dt: float | None = None,
        stream: str = "",
        **options: Unpack[Options],
    ) -> None:
        """Wrap an environment.

        Args:
            env: The environment.
            link: Link profile: its name, path or keys; a list of these, or a function (gym.md).
            seed: Seed of the network, whose episode `reset(seed=...)` selects.
            compute: Time for an answer [s]; or mean and deviation of a gamma distribution.
            answer_within: Time for which the robot waits in a step for an answer [s]; None: 5 %.
            deadline: Age of an action [s] above which the summary counts a step as late.
            chunk: Number of actions in an answer, from the observation's tick on; None: only one.
            executor: How the robot executes answers: name of a plug-in, or path of a file.
            hold: Without an action it executes the last one, "repeat", or `start`, "start".
            start: Action before the first answer; None: 0, or nearest to it; "answer": it waits.
            observation_bytes, action_bytes: Sizes on the wire [bytes]; None: those of the arrays.
            delivery: "datagrams": a lost packet loses its message; "stream": it makes it late.
            packet_bytes: Most bytes of a packet of a message.
            codec: How images of the observation travel: "jpeg:70", "h264:800"; None: as they are.
            dt: Time of a step [s]; None: that of the environment.
            stream: Name of the robot, which with the seed selects its random numbers.
            observe_age: Whether the policy also observes the age of its observation [s].
            observe_actions: How many of its last actions it also observes; of chunks, the first.
            observe_step: Whether it also observes its step; see `Remembering` for all three.
            answers: "arrival": the policy answers what arrives; "step": it answers in each step.
            acknowledge: "ideal": the policy learns which answers reached the robot; or None.

        Raises:
            cloudrc.CloudrcError: If a value cannot be used; the text says what to change.
        """
        options = read_options("Networked", options)
        RecordConstructorArgs.__init__(self, link=link, seed=seed, dt=dt, stream=stream, **options)
        check_kind(env, gymnasium.Env, "environment")
        gymnasium.Wrapper.__init__(self, env)
        self.step_time, chunk = find_step(env, dt), options["chunk"]
        self.dt = self.step_time.seconds
        spaces, self.world_info = (env.observation_space, env.action_space), dict[str, Any]()
        (self._loop,), links = connect(spaces, self.dt, link, seed, (stream,), options)
        self.action_space, self._split = answer_space(env.action_space, chunk)
        self._check = checker(self.action_space, describe_answer(chunk))
        self.observation_space = self._loop.memory.space
        warn_of(env, self._loop, links, self.step_time, chunk)

    @property
    def observation_bytes(self) -> int:
        """Usual size of an observation on the wire [bytes]; with a codec, known after `reset`."""
        return self._loop.uplink.wire.size

    @property
    def compute(self) -> Callable[[int], float]:
        """Function that returns the time for the answer to the observation of a tick [s].

        Whoever measures this time sets another one; at first, it is as the argument says.
        """
        return self._loop.compute

    @compute.setter
    def compute(self, time: Callable[[int], float]) -> None:
        self._loop.compute = time

    def summary(self) -> dict[str, Any]:
        """Return what `info["cloudrc"]["episode"]` has, also before the end of an episode.

        Raise gymnasium's ResetNeeded before the first `reset`.
        """
        return self._loop.summary()

    def timeline(self) -> dict[str, NDArray[np.int64]]:
        """Return the instants of each answer of the last episode [ns], each of shape (n,).

        They are those of `cloudrc.gym.answers.CUTS`, beside the `tick` of the observation; -1
        stands for what never happened: lost, dropped for a newer one, or still under way. What is
        between two of them is a stage of the age. Raise gymnasium's ResetNeeded before the first
        `reset`.
        """
        return self._loop.timeline()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; the policy has the first observation at once."""
        observation, self.world_info = self.env.reset(seed=seed, options=options)
        self._loop.begin(seed, observation, self.world_info)
        return self._seen()

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Send the policy's answer, and step the world with what the robot executes."""
        if type(action) is not np.ndarray:
            action = to_arrays(action)
        self._check(action)
        loop = self._loop
        # No other action is sent, so no other is copied.
        executed = loop.act(self._split(action) if loop.is_asked else ())
        observation, reward, terminated, truncated, self.world_info = self.env.step(executed)
        loop.observe(observation, self.world_info)
        seen, info = self._seen()
        if terminated or truncated:
            info["cloudrc"]["episode"] = loop.summary()
        return seen, reward, terminated, truncated, info

    def _seen(self) -> tuple[Any, dict[str, Any]]:
        loop = self._loop
        return loop.observed(), {**loop.seen[1], "cloudrc": loop.told()}
