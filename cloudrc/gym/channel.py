# SPDX-License-Identifier: Apache-2.0

"""Let several loops share one uplink, which sends few observations in a slot of time.

The channel goes on from instant to instant; times are whole nanoseconds, and slot j begins at
j slot_ms. In an instant, in this order:

1. Policies receive what arrives.
2. The observations of this instant join; a robot's newer one takes the place of its waiting one.
3. If a slot begins, the schedule chooses up to `per_slot` of those that wait. A chosen observation
   leaves the channel at the end of its slot, and then crosses the link of its robot: the draw that
   loses it has the number of its tick, so losses do not depend on the schedule.
4. Robots act whose wait for an answer ends, in the order of their numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any, cast

import gymnasium
from gymnasium.error import ResetNeeded

from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import InvalidValueError, Quantity, to_arrays
from cloudrc.gym.lane import WaitingLane
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
from cloudrc.gym.schedules import Choose, Waiting, change_of, find_schedule
from cloudrc.gym.step import find_step
from cloudrc.gym.values import checker

SLOT = Quantity("ms", gt=0.0, le=3_600_000.0)
"""Time of a slot."""
PER_SLOT = Quantity(ge=1, whole=True)
"""Number of observations that leave in a slot."""
SECONDS = Quantity("s", gt=0.0)
"""Time of an episode."""
Policy = Callable[[Any], Any]
"""Function from an observation to its answer."""


class _Robot:
    """A robot of the channel: its environment, its loop, and where it is in its tick.

    Attributes:
        due_ns: When it sends its next observation, or acts [ns].
        acts: Whether it then acts.
        is_over: Whether its episode is over.
    """

    def __init__(
        self,
        number: int,
        env: gymnasium.Env[Any, Any],
        link: Links,
        seed: int,
        dt: float,
        slot: float | None,
        options: Options,
    ) -> None:
        """Connect a robot whose step takes `dt` [s]; `slot` is that of its channel [s], if any."""
        self.number, self.env, self.dt = number, env, dt
        if options["codec"] is not None:
            raise InvalidValueError("codec: on a channel, images travel as they are; leave it out")
        spaces, chunk = (env.observation_space, env.action_space), options["chunk"]
        names = (f"robot{number}",)
        (self.loop,), self.links = connect(spaces, dt, link, seed, names, options, slot=slot)
        space, self._split = answer_space(env.action_space, chunk)
        self._check = checker(space, describe_answer(chunk))
        self.is_over = True

    def begin(self, seed: int | None) -> None:
        """Begin an episode; the policy has the first observation at once."""
        own = None if seed is None else seed + self.number
        observation, info = self.env.reset(seed=own)
        self.loop.begin(seed, observation, info)
        self.acts, self.due_ns, self.is_over = True, self.loop.acts_ns, False
        self.ended, self._return = "limit", 0.0
        self._executed, self._first = list[Any](), 0  # actions from a tick on
        self.answer: Any = None

    @property
    def waits(self) -> bool:
        """Whether an observation waits for the channel."""
        lane = self.loop.uplink
        return isinstance(lane, WaitingLane) and lane.waiting is not None

    def describe(self, now_ns: int) -> Waiting:
        """Describe the observation that waits at `now_ns` [ns]."""
        loop, lane = self.loop, cast("WaitingLane", self.loop.uplink)
        assert lane.waiting is not None, "it waits"
        (tick, message, more), seen_tick = lane.waiting, loop.seen_tick
        observation, seen = message[2], loop.seen[0]
        del self._executed[: seen_tick - self._first]
        self._first = seen_tick
        return Waiting(
            self.number,
            (now_ns - round(seen_tick * self.dt * 1e9)) * 1e-9,
            change_of(observation, seen),
            lane.wire.size + more,
            observation,
            seen,
            tuple(self._executed[: tick - seen_tick]),
        )

    def see(self) -> tuple[int, Any, dict[str, Any]]:
        """Return its number, and what its policy has and knows."""
        loop = self.loop
        info = {**loop.seen[1], "cloudrc": loop.told()}
        if self.is_over:
            info["cloudrc"]["episode"] = self.summary()
        return self.number, loop.observed(), info

    def act(self) -> None:
        """Send the policy's answer if there is one, and step the world."""
        loop, actions = self.loop, ()
        if loop.is_asked and self.answer is not None:
            answer = to_arrays(self.answer)
            self._check(answer)
            actions = self._split(answer)
        loop.is_asked, self.answer = bool(actions), None
        executed = loop.act(actions)
        self._executed.append(executed)
        self._seen, reward, terminated, truncated, self._info = self.env.step(executed)
        self._return += float(reward)
        if terminated or truncated:
            self.ended = "terminated" if terminated else "truncated"
        self.acts, self.due_ns = False, round((loop.tick + 1) * self.dt * 1e9)

    def send(self) -> None:
        """Send the observation of its next tick."""
        self.loop.send(self._seen, self._info)
        self.acts, self.due_ns = True, self.loop.acts_ns

    def ask(self, until_ns: float) -> None:
        """Let the policy begin; the episode is over with its environment or at `until_ns` [ns]."""
        if self.loop.tick:
            self.loop.ask()
        now_ns = round(self.loop.tick * self.dt * 1e9)
        self.is_over = self.ended != "limit" or now_ns >= until_ns

    def summary(self) -> dict[str, Any]:
        """Return the summary of its loop, its return, and how its episode ended."""
        return {**self.loop.summary(), "return": self._return, "ended": self.ended}


class Channel:
    """Several environments, each with its policy behind a link, whose uplinks share one channel.

    In each slot the schedule chooses whose observation is sent; all others wait, and a newer
    observation takes the place of the robot's waiting one. Answers do not use the channel. All else
    is as `Networked` tells. Robot n has the stream `robotN`, and the environment of robot n gets
    the seed of the episode plus n. A robot whose episode ends leaves the channel.

    Attributes:
        envs: The environments.
        dt: The time of a step of each [s].
        loops: The loop of each robot.
    """

    @naming("Channel")
    def __init__(
        self,
        envs: Sequence[gymnasium.Env[Any, Any]],
        link: Links = "ideal",
        *,
        slot_ms: float | None = None,
        per_slot: int = 1,
        schedule: str | Path | Choose | None = "round_robin",
        seed: int = 0,
        **options: Any,
    ) -> None:
        """Connect environments of any kind with the channel.

        Args:
            envs: The environments; robot n has environment n.
            link: Link profile, as `Networked` takes it; or a list with that of each robot.
            slot_ms: Time of a slot [ms]; None: the time of a step, if all have the same.
            per_slot: How many observations leave in a slot.
            schedule: "round_robin", "random", "largest_age", "largest_error"; or the path of a file
                with `choose(waiting)`, or such a function. None: no channel is shared; each
                observation leaves at once.
            seed: Seed of the network, whose episode `play(seed)` selects.
            options: Options of `Networked`, also `dt`; a list has that of each robot.

        Raises:
            cloudrc.CloudrcError: If a value cannot be used; the text says what to change.
        """
        self.envs = [*envs]
        if not self.envs:
            raise InvalidValueError("there is no environment; give at least one")
        for env in self.envs:
            check_kind(env, gymnasium.Env, "environment")
        each = [self._options_of(n, options) for n in range(len(self.envs))]
        steps = [
            find_step(env, own.pop("dt", None)) for env, own in zip(self.envs, each, strict=True)
        ]
        self._per_slot = PER_SLOT.of(per_slot, "per_slot")
        self._schedule = None if schedule is None else find_schedule(schedule)
        self._slot_ns = self._read_slot(slot_ms, {step.seconds for step in steps})
        self._seed, self._episode = seed, -1
        self._asked: _Robot | None = None
        slot = self._slot_ns * 1e-9 if self._schedule else None
        self._robots = list[_Robot]()
        for n, (env, step) in enumerate(zip(self.envs, steps, strict=True)):
            own = read_options("Channel", cast("Options", each[n]))
            robot = _Robot(n, env, self._one(n, "link", link), seed, step.seconds, slot, own)
            self._robots.append(robot)
            warn_of(env, robot.loop, robot.links, step, own["chunk"])
        self.dt = [step.seconds for step in steps]
        self.loops = [robot.loop for robot in self._robots]

    def _options_of(self, n: int, options: Mapping[str, Any]) -> dict[str, Any]:
        return {name: self._one(n, name, value) for name, value in options.items()}

    def _one(self, n: int, name: str, value: Any) -> Any:
        """Return what of an argument is that of robot n: a list has one for each."""
        if not isinstance(value, list):
            return value
        if len(value) != len(self.envs):
            count = f"{len(value)} in the list, and {len(self.envs)} environments"
            raise InvalidValueError(f"{name}: {count}; give one for each, or one for all")
        return value[n]

    def _read_slot(self, slot_ms: float | None, steps: set[float]) -> float:
        """Return the time of a slot [ns]; `steps` are the times of the robots' steps [s]."""
        if slot_ms is not None:
            return float(SLOT.of(slot_ms, "slot_ms")) * 1e6
        if len(steps) > 1 and self._schedule:
            texts = ", ".join(f"{1e3 * step:g}" for step in sorted(steps))
            raise InvalidValueError(
                f"the environments have steps of {texts} ms; give slot_ms=, the time of a slot"
            )
        return min(steps) * 1e9

    def run(
        self, policies: Policy | Sequence[Policy], seconds: float, seed: int | None = None
    ) -> list[dict[str, Any]]:
        """Play an episode of at most `seconds` [s]; return the summary of each robot.

        `policies` is a function from an observation to its answer, or one for each robot; it is
        called when a new observation has arrived, as the option `answers` says. A summary is that
        of `Networked` with the robot's `return` and how it `ended`: "terminated", "truncated", or
        at the "limit" of time.
        """
        each = [*policies] if isinstance(policies, Sequence) else [policies] * len(self._robots)
        with naming("policies"):
            if len(each) != len(self._robots):
                raise InvalidValueError(
                    f"there are {len(each)}, and {len(self._robots)} robots; give one for each"
                )
        for robot, observation, info in self.play(seed, seconds):
            about = info["cloudrc"]
            if about["asked"] and "episode" not in about:
                self.answer(robot, each[robot](observation))
        return self.summaries()

    def play(
        self, seed: int | None = None, seconds: float | None = None
    ) -> Iterator[tuple[int, Any, dict[str, Any]]]:
        """Begin an episode; yield robot, its policy's observation and its info, step by step.

        The order is that of time, then of robots. Give `answer` in the block if
        `info["cloudrc"]["asked"]`; else, or without an answer, nothing is sent. After a robot's
        last step, its `info["cloudrc"]` has the summary, `episode`. Without `seconds` [s], an
        episode lasts until all environments have ended.
        """
        with naming("seconds"):
            until_ns = inf if seconds is None else SECONDS.of(seconds) * 1e9
        self._begin(seed)
        robots, slot = self._robots, 0
        while robots := [robot for robot in robots if not robot.is_over]:
            now_ns = min(robot.due_ns for robot in robots)
            if any(robot.waits for robot in robots):
                now_ns = min(now_ns, round(slot * self._slot_ns))
            acting = [robot for robot in robots if robot.due_ns == now_ns and robot.acts]
            for robot in robots:
                if robot.due_ns == now_ns and not robot.acts:
                    robot.send()
                    if robot.due_ns == now_ns:  # it does not wait for an answer
                        acting.append(robot)
            slot = max(slot, int(now_ns / self._slot_ns))
            while round(slot * self._slot_ns) < now_ns:
                slot += 1
            if round(slot * self._slot_ns) == now_ns:
                slot += 1
                self._serve(robots, now_ns, round(slot * self._slot_ns))
            for robot in sorted(acting, key=lambda each: each.number):
                robot.ask(until_ns)
                self._asked = robot
                yield robot.see()
                if not robot.is_over:
                    robot.act()
        self._asked = None

    def _begin(self, seed: int | None) -> None:
        self._episode = self._episode + 1 if seed is None else seed
        for robot in self._robots:
            robot.begin(seed)
        if self._schedule:
            self._schedule.begin(self._seed, self._episode)

    def _serve(self, robots: Sequence[_Robot], now_ns: int, end_ns: int) -> None:
        """Send what the schedule chooses in the slot from `now_ns` to `end_ns` [ns]."""
        waiting = [robot for robot in robots if robot.waits]
        if not waiting or not self._schedule:
            return
        for robot in waiting:
            robot.loop.take(now_ns)
        described = [robot.describe(now_ns) for robot in waiting]
        for _ in range(min(self._per_slot, len(waiting))):
            place = self._schedule.choose(described)
            cast("WaitingLane", waiting.pop(place).loop.uplink).leave(end_ns)
            del described[place]

    def answer(self, robot: int, action: Any) -> None:
        """Give the answer of the policy of the robot that `play` has yielded last."""
        if self._asked is None or robot != self._asked.number:
            with naming("answer"):
                raise InvalidValueError(f"play() has not asked the policy of robot {robot} last")
        self._asked.answer = action

    def summaries(self) -> list[dict[str, Any]]:
        """Return the summary of each robot, also before the end of an episode."""
        if self._episode < 0 and all(robot.is_over for robot in self._robots):
            raise ResetNeeded("call play() or run() before summaries()")
        return [robot.summary() for robot in self._robots]

    def close(self) -> None:
        """Close the environments."""
        for env in self.envs:
            env.close()
