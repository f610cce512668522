# SPDX-License-Identifier: Apache-2.0

"""Carry observations and actions of one robot over a link, in the ticks of its environment.

The world never waits: a tick is a step of the environment, and what is late is late. The policy is
a server: it answers when an observation arrives. Times are whole nanoseconds; tick k is at
t = round(k dt), and W is how long the robot waits in a tick for an answer:

1. The robot receives the answers that have arrived by t.
2. If its executor asks, the observation of tick k leaves at t.
   A message is a packet, or several that leave together; a stream repairs what is lost.
3. Policy, up to t + W: it begins when an observation has arrived and its last answer is computed.
   It takes the newest observation that has arrived by then, and drops older ones. The answer leaves
   after the compute time, as the packet whose number is the tick of the observation: so delay
   and loss of a packet depend neither on the compute time nor on the executor.
   If it answers in every tick, it begins at t at the earliest, with the newest observation that has
   arrived by t + W, and the packet's number is that of the tick.
4. The robot receives the answers that have arrived by t + W, and executes an action.

So the age of the loop is dt max(0, ceil((up + compute + down - W) / dt)). One call of `step` has
one answer: of the questions that begin in one tick, the newest counts.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import ceil, inf, nan
from typing import TYPE_CHECKING, Any
from weakref import WeakValueDictionary

import numpy as np
from gymnasium.error import ResetNeeded

from cloudrc.base.outside.values import Quantity
from cloudrc.gym.ages import describe_ages
from cloudrc.gym.answers import Answers, Instants
from cloudrc.gym.asked import AskedOfWire, Met, expected
from cloudrc.gym.doubts import doubts
from cloudrc.gym.executors import Chunk, Committed, Executor
from cloudrc.gym.lane import Lane, Wire
from cloudrc.gym.links import Choose, Chosen
from cloudrc.gym.memory import Remembering
from cloudrc.gym.values import copied, size_of
from cloudrc.link.draws import stream_key
from cloudrc.link.library import LinkProfile
from cloudrc.link.profile import DirectionProfile
from cloudrc.results.metrics.age import most_missed

if TYPE_CHECKING:
    from cloudrc.gym.codec import ObservationCodec

EPISODES = 1 << 20
"""Number of episodes that belong to a seed of the environment."""
AGES = 100
"""Ages of actions that are counted apart [ticks]."""
ACKNOWLEDGED = 100
"""How many answers that reached the robot the policy is told of: the newest."""
FIRST = -1
"""Size of an observation that is that of the first of each episode."""
NO_LINK = LinkProfile(DirectionProfile(), DirectionProfile())
"""Link before the first episode."""
_NEWEST: WeakValueDictionary[tuple[int, str], RemoteLoop] = WeakValueDictionary()
# seed and stream -> the robot that has begun an episode last
_TOLD = set[tuple[int, str]]()  # seeds and streams of which a warning told
_COMPUTE = 129  # kind of the random numbers of the compute time


@dataclass(frozen=True)
class Settings:
    """How a robot and its policy are connected."""

    seed: int  # of the link
    dt: float  # time of a tick [s]
    answer_within: float  # how long the robot waits in a tick for an answer [s]
    deadline: float | None  # age of an action above which a step is late [s]
    compute: tuple[float, float]  # mean and standard deviation of the time for an answer [s]
    repeats: bool  # whether the robot repeats its last action if it has none, or executes `start`
    start: Any  # action before the first answer
    waits: bool  # whether the robot starts only when it has the first answer
    observation_bytes: int  # of a usual one, or FIRST
    action_bytes: int
    delivery: str  # one of DELIVERIES
    packet_bytes: int  # most bytes of a packet
    answers_each_tick: bool = False  # whether the policy answers also without a new observation
    acknowledges: bool = False  # whether the policy learns which answers reached the robot
    slot: float = 0.0  # for how long a shared channel sends an observation [s]

    def wires(self, link: LinkProfile) -> tuple[Wire, Wire]:
        """Return the wire of observations and that of answers, over a link."""
        up, down = (
            Wire(link, is_up, size, self.delivery, self.packet_bytes)
            for is_up, size in ((True, self.observation_bytes), (False, self.action_bytes))
        )
        return up, down


class RemoteLoop:
    """One robot, one policy and the link between them.

    Attributes:
        seen: The newest observation that the policy has taken, and the environment's info about it.
        is_asked: Whether this observation is new, so that the policy's next answer is sent.
        compute: Function that returns how long the policy computes the answer to the observation
            of a tick [s]; at first, it is that of the settings.
        start: What the robot executes without any answer.
        memory: What the policy remembers beside this observation.
        answers: When each answer of the episode was asked for, made and executed.
        judge_link: Function that warns of a link that nobody knew before, and says whether it did.
        follows_first: Whether the first observation of an episode says what their usual size is.
    """

    def __init__(
        self,
        settings: Settings,
        choose: Choose,
        executor: Executor,
        memory: Remembering,
        stream: str = "",
        *,
        judge: Callable[[Any], None] | None = None,
        lane: type[Lane] = Lane,
        codec: ObservationCodec | None = None,
    ) -> None:
        """Connect; `stream` is the name of the robot. Call `begin` for each episode.

        `choose` returns the link of an episode. `lane` is the class of the uplink. `codec` encodes
        the images of observations; None: they travel as they are.
        `judge` raises an exception for a value of the executor that is no action.
        """
        self._settings, self._executor, self._judge = settings, executor, judge
        self._lane, self._codec = lane, codec
        self.follows_first = settings.observation_bytes == FIRST
        self.start, self.memory = settings.start, memory
        self._tick = -1  # before the first episode
        self.judge_link: Callable[[LinkProfile], bool] | None = None
        self._choose, self._chosen = choose, Chosen("", NO_LINK)
        self._stream, self._episode = stream, -1
        self._connect()
        self._within_ns = round(settings.answer_within * 1e9)
        self.compute: Callable[[int], float] = self._draw_time
        self._asks_always = type(executor).asks is Executor.asks
        self.seen: list[Any] = [None, {}]
        self.is_asked = False

    def _connect(self) -> None:
        """Open both directions of the link that is chosen."""
        link, seed, stream = self._chosen.profile, self._settings.seed, self._stream
        start = partial(link.start_ns, seed, stream=stream)
        up, down = self._settings.wires(link)
        self._up = self._lane(up, seed, stream, start)
        self._down = Lane(down, seed, stream, start)
        self._late: int | None = None  # expected age of the loop [ticks]
        self._asked: tuple[AskedOfWire, AskedOfWire] | None = None

    def begin(self, seed: int | None, observation: Any, info: Mapping[str, Any]) -> None:
        """Begin an episode: the policy has the first observation at once.

        With a `seed`, that of the environment, the episode meets the network of this seed, else
        that of the next episode.
        """
        self._episode = self._episode + 1 if seed is None else (int(seed) + 1) * EPISODES
        chosen = self._choose(self._episode if seed is None else seed, self._episode, self._stream)
        is_other, seen = chosen is not self._chosen, copied(observation)
        if self._codec is not None:
            seen, size = self._codec.begin(seen)
            is_other |= self._use_size(size)
        if is_other:
            self._chosen = chosen
            self._connect()
            if self.judge_link and self.judge_link(chosen.profile):
                self.judge_link = None  # once
        self._up.begin(self._episode)
        self._down.begin(self._episode)
        self._tick = self._now_ns = self._seen_tick = self._number = 0
        _NEWEST[self._settings.seed, self._stream] = self
        self.seen, self._committed = [seen, info], Committed()
        self.is_asked = True
        self._taken_ns = 0  # when its newest observation arrived
        self._begin_ns = self._free_ns = 0  # when the policy began its last answer, and has it
        self._sources = [0]  # if it answers in each tick: the tick of the observation behind each
        self._reached = deque[tuple[int, int]]()  # arrival [ns] and number of answers at the robot
        self._acknowledged = deque[int](maxlen=ACKNOWLEDGED)
        self._held = 0
        self._last, self._basis = self.start, -1.0
        self._is_held = False
        self._observation_ages = list[int]()  # [ticks], as the others
        self._action_ages, self._loop_ages = list[float](), list[int]()
        self._fresh_ages = list[float]()  # of new actions since the first of _action_ages, else NaN
        self._executor.basis = -1
        self.answers = Answers()
        self.answers.observed[0] = self.answers.arrived[0] = 0
        self.answers.begun[0] = 0, 0
        self.memory.begin()
        if self._late is None:
            self._late = self._ticks_late((self._up.wire, self._down.wire))
        self._executor.begin(self._late, round(self._settings.dt * 1e9))

    def _use_size(self, size: int) -> bool:
        """Take the size [bytes] of the first observation as the usual one; say whether it changes.

        It is rounded up, by 6 % at most: what is expected of each other size takes time to compute.
        """
        unit = 1 << max(0, size.bit_length() - 5)
        size = -(-size // unit) * unit
        if not self.follows_first or size == self._settings.observation_bytes:
            return False
        self._settings = replace(self._settings, observation_bytes=size)
        return True

    def _meet_twin(self) -> None:
        """Say once if another robot is in the same episode of the same network, which draws."""
        link, network = self._chosen.profile, (self._settings.seed, self._stream)
        twin = _NEWEST.get(network, self)
        if twin is self or twin._episode != self._episode or network in _TOLD:
            return
        ways = [replace(way, delay_ms=0.0) for way in (link.uplink, link.downlink)]
        if twin._chosen.profile == link and ways != [DirectionProfile()] * 2:
            _TOLD.add(network)
            seed, stream = network
            warnings.warn(
                f"two robots with seed={seed} and stream={stream!r} meet one network: their ages "
                "are equal; give each robot a stream= of its own",
                stacklevel=4,
            )

    def _ticks_late(self, wires: tuple[Wire, Wire]) -> int:
        """Return the expected age of the loop [ticks]."""
        settings, dt = self._settings, self._settings.dt
        # Of a queue that fills, the first message tells the least age.
        (up, _), (down, _) = (expected(wire, dt, int(wire.exceeds_rate(dt))) for wire in wires)
        late = float(np.nan_to_num(up + down)) + settings.compute[0] - settings.answer_within
        late += settings.slot
        return max(0, ceil(late / dt - 1e-6))

    def doubts(self, link: LinkProfile, count: int, longest: float) -> Iterator[str]:
        """Say what makes episodes of at most `longest` [ticks] over a link pointless.

        `count` is the number of actions in an answer.
        """
        settings, wires = self._settings, self._settings.wires(link)
        dt, compute, late = settings.dt, settings.compute[0], self._ticks_late(wires)
        yield from doubts(wires, dt, asks_always=self._asks_always)
        if self._asks_always and any(wire.exceeds_rate(dt) for wire in wires):
            return  # the delay grows from message to message, so its mean says nothing
        if late < longest:
            if text := self._executor.doubt(count, late):
                yield text
            return
        takes = compute if compute >= longest * dt else late * dt
        yield (
            f"no step gets an answer: an answer takes {takes:.3g} s, an episode "
            f"{longest * dt:.3g} s; times are in s"
        )

    def act(self, actions: tuple[Any, ...]) -> Any:
        """Take the policy's answer, if it is asked; return the action that the robot executes."""
        tick, executor = self._tick, self._executor
        if tick <= 0:
            if tick < 0:
                raise ResetNeeded("call reset() before step()")
            self._meet_twin()
        if self.is_asked:
            self.memory.add(actions[0])
            self._answer(actions)
            self.is_asked = False
        self._receive(self._now_ns + self._within_ns)
        action = executor.action(tick)
        self._is_held = action is None
        if action is not None:
            if self._judge is not None:
                self._judge(action)
                Quantity(ge=0, le=tick).of(executor.basis, "basis")
            self._last, self._basis = action, executor.basis
            self.answers.execute(executor.basis, self._now_ns)
            if self._settings.answers_each_tick:
                self._basis = self._sources[round(executor.basis)]
        else:
            self._held += 1
            if not self._settings.repeats:
                self._last, self._basis = self.start, -1.0
        if self._basis > 0:
            self._action_ages.append(tick - self._basis)
        if self._action_ages:
            self._fresh_ages.append(nan if self._is_held else tick - self._basis)
        return self._last

    def _answer(self, actions: tuple[Any, ...]) -> None:
        """Send the answer to the newest observation that the policy has taken."""
        chunk = Chunk(self._number, actions)
        if self._settings.waits and not self._tick:
            self._executor.receive(chunk, 0)  # the episode begins when this answer has arrived
            self.answers.left[0] = self.answers.received[0] = 0
            self._reached.append((0, 0))
            return
        self._free_ns = free_ns = self._begin_ns + self._time_to_compute()  # known only now
        self.answers.left[self._number] = free_ns
        self._down.send(self._number, free_ns, chunk)

    def _receive(self, limit_ns: int) -> None:
        """Give the executor the answers that have arrived by `limit_ns` [ns]."""
        if self._down.is_stream:
            self._down.run(limit_ns)
        queue, settings, tick = self._down.queue, self._settings, self._tick
        while queue.next_ns <= limit_ns:
            at_ns, _, chunk = queue.pop()
            basis = chunk.basis
            self.answers.received[basis] = at_ns
            if settings.acknowledges:
                self._reached.append((at_ns, basis))
            if settings.answers_each_tick:
                basis = self._sources[basis]
            if basis:
                self._loop_ages.append(tick - basis)
            self._executor.receive(chunk, tick)

    def observe(self, observation: Any, info: Mapping[str, Any]) -> None:
        """Move to the next tick, in which the world gives an observation and its info."""
        self.send(observation, info)
        self.ask()

    def send(self, observation: Any, info: Mapping[str, Any]) -> None:
        """Move to the next tick: the robot receives, and sends what the world gives.

        Call `ask` before the robot acts; until then, `take` may be called.
        """
        self._tick = tick = self._tick + 1
        self._now_ns = now_ns = round(tick * self._settings.dt * 1e9)
        self._receive(now_ns)
        if self._asks_always or self._executor.asks(tick, observation):
            committed = self._executor.committed(tick)
            more = size_of(committed.actions) if committed.actions else 0
            if self._codec is None:
                sent = copied(observation)
            else:
                sent = self._codec.encode(observation)
                more += sent.size - self._settings.observation_bytes
            message = (tick, committed, sent, dict(info))
            self._up.send(tick, now_ns, message, more)
            self.answers.observed[tick] = now_ns

    def ask(self) -> None:
        """Let the policy take what arrives in this tick before the robot acts, and begin."""
        limit_ns = self._now_ns + self._within_ns
        self.take(limit_ns)
        if self._settings.answers_each_tick:
            self._sources.append(self._seen_tick)
            begin_ns = max(self._now_ns, self._free_ns, self._taken_ns)
            self.is_asked = begin_ns <= limit_ns  # else it still computes
            if self.is_asked:
                self._begin(self._tick, begin_ns)
        if self._seen_tick:
            self._observation_ages.append(self._tick - self._seen_tick)

    def take(self, limit_ns: int) -> None:
        """Let the policy begin with the observations that have arrived by `limit_ns` [ns].

        A policy that answers in each tick only keeps the newest one.
        """
        if self._up.is_stream:
            self._up.run(limit_ns)
        queue, begins = self._up.queue, not self._settings.answers_each_tick
        while (begin_ns := queue.next_ns) <= limit_ns:
            if begins and self._free_ns > begin_ns:
                begin_ns = self._free_ns
                if begin_ns > limit_ns:
                    return
            before = self._seen_tick
            while queue.next_ns <= begin_ns:
                self._taken_ns, _, message = queue.pop()
                tick = message[0]
                self.answers.arrived[tick] = self._taken_ns
                if tick > self._seen_tick:
                    each = (message,) if self._codec is None else self._codec.receive(message)
                    for message in each:
                        self._seen_tick, self._committed, *self.seen = message
            if begins and self._seen_tick > before:
                self.is_asked = True
                self._begin(self._seen_tick, begin_ns)

    def _begin(self, number: int, begin_ns: int) -> None:
        """Let the policy begin the answer with a number at a time [ns]."""
        self._number, self._begin_ns = number, begin_ns
        self._free_ns = begin_ns + self._time_to_compute()
        self.answers.begun[number] = self._seen_tick, begin_ns

    def _time_to_compute(self) -> int:
        """Return how long the policy computes its newest answer [ns]."""
        return round(self.compute(self._number) * 1e9)

    def _draw_time(self, tick: int) -> float:
        mean, deviation = self._settings.compute
        if not deviation:
            return mean
        key = stream_key(self._settings.seed, False, self._episode, _COMPUTE, self._stream)
        counter = [0, 0, 0, tick]
        bits = np.random.Philox(key=np.array(key, dtype=np.uint64), counter=counter)
        shape = (mean / deviation) ** 2
        return np.random.Generator(bits).gamma(shape, mean / shape)

    def observed(self) -> Any:
        """Return a copy of the newest observation that the policy has taken, with its memory."""
        observation = copied(self.seen[0])
        if not self.memory.adds:
            return observation
        age = (self._tick - self._seen_tick) * self._settings.dt
        return self.memory.beside(observation, age=age, step=self._seen_tick)

    def told(self) -> dict[str, Any]:
        """Return what the policy may know about the loop, as `info["cloudrc"]`."""
        dt, tick, basis = self._settings.dt, self._tick, self._basis
        found: dict[str, Any] = {
            "asked": self.is_asked,
            "observation_age": (tick - self._seen_tick) * dt,
            "action_age": (tick - 1 - basis) * dt if basis >= 0 else inf,
            "held": self._is_held,
            "lost_uplink": self._up.queue.lost,
            "lost_downlink": self._down.queue.lost,
        }
        if self._committed.actions:
            found["prefix"], found["delay"] = self._committed
        if self._settings.acknowledges:
            found["acknowledged"] = self._acknowledge()
        return found

    def timeline(self) -> dict[str, Instants]:
        """Return when each answer of this episode was asked for, made and executed [ns]."""
        if self._tick < 0:
            raise ResetNeeded("call reset() before timeline()")
        return self.answers.table()

    def _acknowledge(self) -> tuple[int, ...]:
        """Return the ticks of the newest answers of which the policy knows that they arrived."""
        known_ns = self._now_ns - round(self._up.wire.profile.delay_ms * 1e6)
        while self._reached and self._reached[0][0] <= known_ns:
            self._acknowledged.append(self._reached.popleft()[1])
        return tuple(self._acknowledged)

    @property
    def uplink(self) -> Lane:
        """The messages from the robot."""
        return self._up

    @property
    def tick(self) -> int:
        """Number of the present tick."""
        return self._tick

    @property
    def seen_tick(self) -> int:
        """Tick of the newest observation that the policy has taken."""
        return self._seen_tick

    @property
    def acts_ns(self) -> int:
        """When the robot acts in the present tick [ns]."""
        return self._now_ns + self._within_ns

    def summary(self) -> dict[str, Any]:
        """Return what the loop was like in this episode: asked and measured.

        `late_share` is the share of steps whose action is older than the deadline. `age_counts` has
        the steps by the action's age in ticks, rounded up; the last possible, all older ones.
        """
        ticks, dt = self._tick, self._settings.dt
        if ticks < 0:
            raise ResetNeeded("call reset() before summary()")
        deadline = self._settings.deadline
        actions = np.array(self._action_ages) * dt
        late = nan
        if deadline is not None and len(actions):
            late = float(np.mean(actions > deadline + 1e-9))
        is_new = np.array(self._fresh_ages) * dt <= (inf if deadline is None else deadline) + 1e-9
        rounded = np.ceil(np.array(self._action_ages) - 1e-9).clip(max=AGES - 1)
        link, sent = self._chosen.profile, {}
        if self._codec is not None:
            sent = self._codec.told(self._up.wire)
        start_ns = link.start_ns(self._settings.seed, self._episode, self._stream)
        met = Met(start_ns, round(ticks * dt * 1e9))
        if self._asked is None:
            self._asked = AskedOfWire(self._up.wire, dt), AskedOfWire(self._down.wire, dt)
        uplink, downlink = self._asked
        return {
            "ticks": ticks,
            "link": self._chosen.name,
            "link_start": start_ns / 1e9,
            "loop_age": sum(ages) / len(ages) * dt if (ages := self._loop_ages) else nan,
            **describe_ages("observation_age", np.array(self._observation_ages) * dt, dt),
            **describe_ages("action_age", actions, dt),
            "age_counts": np.bincount(rounded.astype(int)).tolist(),
            "late_share": late,
            "misses_in_10": most_missed(~is_new) if len(is_new) else nan,
            "held_share": self._held / ticks if ticks else nan,
            **self.answers.means(),
            "uplink": {**self._up.summary(uplink.of(met)), **sent},
            "downlink": self._down.summary(downlink.of(met)),
        }
