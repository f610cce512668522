"""Carry observations and actions of one robot over a link, in the ticks of its environment.

The world never waits: a tick is a step of the environment, and what is late is late. A tick of time
t goes like this: the policy answers to the newest observation that it has, and the answer leaves at
t plus the compute time; the robot takes the answers that have arrived, and executes an action; the
world moves to the next tick, whose observation leaves at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from heapq import heappop, heappush
from math import ceil, inf, nan
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded

from cloudrc.gym.executors import Chunk, Executor
from cloudrc.gym.values import copied
from cloudrc.link.draws import stream_key
from cloudrc.link.library import LinkProfile, OneWay
from cloudrc.link.profile import DirectionProfile

SLACK_NS = 1_000
"""How much later than its tick a packet may arrive [ns]: ticks and delays are rounded."""
EPISODES = 1 << 20
"""Number of episodes that belong to a seed of the environment."""
_COMPUTE = 129  # kind of the random numbers of the compute time


@dataclass(frozen=True)
class Settings:
    """How a robot and its policy are connected."""

    link: LinkProfile
    seed: int  # of the link
    dt: float  # time of a tick [s]
    compute: tuple[float, float]  # mean and standard deviation of the time for an answer [s]
    repeats: bool  # whether the robot repeats its last action if it has none, or executes `start`
    start: Any  # action before the first answer
    waits: bool  # whether the robot starts only when it has the first answer
    observation_bytes: int
    action_bytes: int


@lru_cache(maxsize=64)
def expected(profile: DirectionProfile, period: float, size: int) -> tuple[float, float]:
    """Return the mean delay [s] and the loss of packets of `size` bytes, one per `period` [s]."""
    asked = OneWay(profile, 0, uplink=True).expected(period, size)
    return asked.mean, asked.loss


class Lane:
    """The packets of one direction, in flight and counted."""

    def __init__(self, way: OneWay, size: int) -> None:
        """Send packets of `size` bytes."""
        self._way, self._size = way, size
        self.begin(0)

    def begin(self, episode: int) -> None:
        """Begin an episode without packets."""
        self._episode = episode
        self._flying: list[tuple[int, int, Any]] = []  # arrival [ns], number, message
        self.sent = self.lost = self._delays_ns = 0

    def send(self, number: int, now_ns: int, message: Any) -> None:
        """Send a message at `now_ns` [ns], or lose it."""
        self.sent += 1
        arrivals = self._way.send(self._episode, number, self._size, now_ns)
        if not arrivals:
            self.lost += 1
            return
        arrival_ns = arrivals[0] if len(arrivals) == 1 else min(arrivals)
        self._delays_ns += arrival_ns - now_ns
        heappush(self._flying, (arrival_ns, number, message))

    def next(self, now_ns: int) -> Any:
        """Take the next message that has arrived at `now_ns` [ns]; None if there is none."""
        if self._flying and self._flying[0][0] <= now_ns + SLACK_NS:
            return heappop(self._flying)[2]
        return None

    def summary(self, period: float) -> dict[str, float]:
        """Return delay [s] and loss: asked by the profile, and measured in this episode.

        One packet per `period` [s] is asked for.
        """
        arrived = self.sent - self.lost
        delay, loss = expected(self._way.profile, period, self._size)
        return {
            "delay_asked": delay,
            "delay_measured": self._delays_ns * 1e-9 / arrived if arrived else nan,
            "loss_asked": loss,
            "loss_measured": self.lost / self.sent if self.sent else nan,
            "sent": self.sent,
        }


class RemoteLoop:
    """One robot, one policy and the link between them.

    Attributes:
        seen: The newest observation that the policy has, and the environment's info about it.
        compute: Time for the next answers [s], in place of that of the settings; None: the latter.
    """

    def __init__(self, settings: Settings, executor: Executor, stream: str = "") -> None:
        """Connect; `stream` is the name of the robot. Call `begin` for each episode."""
        self._settings, self._executor = settings, executor
        link, seed = settings.link, settings.seed
        self._tick = -1  # before the first episode
        self._up = Lane(OneWay(link.uplink, seed, True, stream=stream), settings.observation_bytes)
        self._down = Lane(OneWay(link.downlink, seed, False, stream=stream), settings.action_bytes)
        self._stream, self._episode = stream, -1
        self._compute_ns = round(settings.compute[0] * 1e9)
        self._late: int | None = None
        self.compute: float | None = None
        self.seen: list[Any] = [None, {}]

    def begin(self, seed: int | None, observation: Any, info: Mapping[str, Any]) -> None:
        """Begin an episode: the policy has the first observation at once.

        With a `seed`, that of the environment, the episode meets the network of this seed, else
        that of the next episode.
        """
        self._episode = self._episode + 1 if seed is None else (int(seed) + 1) * EPISODES
        self._up.begin(self._episode)
        self._down.begin(self._episode)
        self._tick = self._now_ns = 0
        self._free_ns = 0  # when the policy has computed its last answer
        self._answered = -1  # newest observation to which the policy has answered
        self._seen_tick = 0
        self.seen = [copied(observation), info]
        self._last, self._age = self._settings.start, inf
        self._is_held = False
        self._held = self._skipped = self._acted = 0
        self._observation_ages, self._action_ages = 0, 0.0  # sums, in ticks and in [s]
        self._executor.basis = -1
        self._executor.begin(self._ticks_late(), round(self._settings.dt * 1e9))

    def _ticks_late(self) -> int:
        if self._late is None:
            settings, link = self._settings, self._settings.link
            up, _ = expected(link.uplink, settings.dt, settings.observation_bytes)
            down, _ = expected(link.downlink, settings.dt, settings.action_bytes)
            lates = up, down + settings.compute[0]
            self._late = sum(ceil(np.nan_to_num(each) / settings.dt - 1e-6) for each in lates)
        return self._late

    def act(self, actions: tuple[Any, ...]) -> Any:
        """Take the policy's answer in this tick; return the action that the robot executes."""
        tick, executor = self._tick, self._executor
        if tick < 0:
            raise ResetNeeded("call reset() before step()")
        now_ns = self._now_ns
        if now_ns + SLACK_NS < self._free_ns:
            self._skipped += 1
        elif executor.repeats or self._seen_tick > self._answered:
            self._answered = self._seen_tick
            self._free_ns = now_ns + self._time_to_compute(tick)
            chunk = Chunk(tick, self._seen_tick, actions)
            executor.sent(chunk)
            if tick or not self._settings.waits:
                self._down.send(tick, self._free_ns, chunk)
            else:  # the episode begins when this answer has arrived
                self._free_ns = 0
                executor.receive(chunk, 0)
        while (arrived := self._down.next(now_ns)) is not None:
            executor.receive(arrived, tick)
        action = executor.action(tick)
        self._is_held = action is None
        if action is not None:
            self._last = action
            self._age = (tick - executor.basis) * self._settings.dt
        else:
            self._held += 1
            if not self._settings.repeats:
                self._last, self._age = self._settings.start, inf
            elif self._age < inf:
                self._age = (tick - executor.basis) * self._settings.dt
        if self._age < inf:
            self._acted += 1
            self._action_ages += self._age
        return self._last

    def observe(self, observation: Any, info: Mapping[str, Any]) -> None:
        """Move to the next tick, in which the world gives an observation and its info."""
        self._tick = tick = self._tick + 1
        self._now_ns = now_ns = round(tick * self._settings.dt * 1e9)
        if self._executor.asks(tick):
            self._up.send(tick, now_ns, (tick, copied(observation), dict(info)))
        while (message := self._up.next(now_ns)) is not None:
            if message[0] > self._seen_tick:
                self._seen_tick, *self.seen = message
        self._observation_ages += tick - self._seen_tick

    def _time_to_compute(self, tick: int) -> int:
        """Return how long the policy computes the answer of a tick [ns]."""
        if self.compute is not None:
            return round(self.compute * 1e9)
        mean, deviation = self._settings.compute
        if not deviation:
            return self._compute_ns
        key = stream_key(self._settings.seed, False, self._episode, _COMPUTE, self._stream)
        bits = np.random.Philox(key=np.array(key, dtype=np.uint64), counter=[0, 0, 0, tick])
        shape = (mean / deviation) ** 2
        return round(np.random.Generator(bits).gamma(shape, mean / shape) * 1e9)

    def told(self) -> dict[str, Any]:
        """Return what the policy may know about the loop, as `info["cloudrc"]`."""
        found: dict[str, Any] = {
            "observation_age": (self._tick - self._seen_tick) * self._settings.dt,
            "action_age": self._age,
            "held": self._is_held,
            "busy": self._now_ns + SLACK_NS < self._free_ns,
            "lost_uplink": self._up.lost,
            "lost_downlink": self._down.lost,
        }
        if prefix := self._executor.prefix(self._seen_tick):
            found["prefix"] = prefix
        return found

    def summary(self) -> dict[str, Any]:
        """Return what the loop was like in this episode: asked and measured."""
        ticks, dt = self._tick, self._settings.dt
        return {
            "ticks": ticks,
            "observation_age_mean": self._observation_ages * dt / ticks if ticks else nan,
            "action_age_mean": self._action_ages / self._acted if self._acted else nan,
            "held_share": self._held / ticks if ticks else nan,
            "skipped": self._skipped,
            "uplink": self._up.summary(dt),
            "downlink": self._down.summary(dt),
        }
