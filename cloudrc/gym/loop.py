"""Carry observations and actions of one robot over a link, in the ticks of its environment.

The world never waits: a tick is a step of the environment, and what is late is late. The policy is
a server: it answers when an observation arrives. Times are whole nanoseconds; tick k is at
t = round(k dt), and W is how long the robot waits in a tick for an answer:

1. The robot receives the answers that have arrived by t.
2. If its executor asks, the observation of tick k leaves at t.
   A message is a packet, or several that leave together; a stream repairs what is lost.
3. Policy, up to t + W: it begins when an observation has arrived and its last answer is computed.
   It takes the newest observation that has arrived by then, and drops older ones. The answer leaves
   after the compute time, as the packet whose number is the tick of the observation: so the fate of
   a packet depends neither on the compute time nor on the executor.
4. The robot receives the answers that have arrived by t + W, and executes an action.

So the age of the loop is dt max(0, ceil((up + compute + down - W) / dt)). One call of `step` has
one answer: of the questions that begin in one tick, the newest counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, inf, isnan, nan
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import ResetNeeded

from cloudrc.gym.executors import Chunk, Committed, Executor
from cloudrc.gym.values import copied, size_of
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.carry.tcp.stream import MessageStream, run_due
from cloudrc.link.draws import Floats, stream_key
from cloudrc.link.library import Cut, LinkProfile, OneWay
from cloudrc.link.model import HEADER_BYTES
from cloudrc.link.profile import DirectionProfile, Timeline, summary, whole_share
from cloudrc.link.queue import PacketQueue
from cloudrc.metrics.age import most_missed
from cloudrc.outside.values import Quantity

EPISODES = 1 << 20
"""Number of episodes that belong to a seed of the environment."""
DATAGRAMS, STREAM = "datagrams", "stream"
DELIVERIES = (DATAGRAMS, STREAM)
"""How messages arrive: whole if no packet is lost; or all, in order, and some of them late."""
AGES = 100
"""Ages of actions that are counted apart [ticks]."""
PACKETS = 50_000
"""Packets of a simulation of what a profile asks for."""
MESSAGES_MIN = 200
"""Fewest messages of it."""
SETTLED_NS = 100_000_000_000
"""Time after which what is still repaired counts as lost there [ns]."""
_COMPUTE = 129  # kind of the random numbers of the compute time


@dataclass(frozen=True)
class Settings:
    """How a robot and its policy are connected."""

    link: LinkProfile
    seed: int  # of the link
    dt: float  # time of a tick [s]
    answer_within: float  # how long the robot waits in a tick for an answer [s]
    deadline: float | None  # age of an action above which a step is late [s]
    compute: tuple[float, float]  # mean and standard deviation of the time for an answer [s]
    repeats: bool  # whether the robot repeats its last action if it has none, or executes `start`
    start: Any  # action before the first answer
    waits: bool  # whether the robot starts only when it has the first answer
    observation_bytes: int
    action_bytes: int
    delivery: str  # one of DELIVERIES
    packet_bytes: int  # most bytes of a packet

    @property
    def wires(self) -> tuple[Wire, Wire]:
        """The wire of observations and that of answers."""
        up, down = (
            Wire(self.link, is_up, size, self.delivery, self.packet_bytes)
            for is_up, size in ((True, self.observation_bytes), (False, self.action_bytes))
        )
        return up, down


class Wire(NamedTuple):
    """What decides how the messages of one direction arrive, but for their random numbers."""

    link: LinkProfile
    uplink: bool  # whether they leave the robot
    size: int  # of a message, usually [bytes]
    delivery: str  # one of DELIVERIES
    packet_bytes: int  # most bytes of a packet

    @property
    def profile(self) -> DirectionProfile:
        """The direction's own profile."""
        return self.link.uplink if self.uplink else self.link.downlink

    @property
    def back(self) -> DirectionProfile:
        """The profile of the other direction."""
        return self.link.downlink if self.uplink else self.link.uplink

    @property
    def cut(self) -> Cut:
        """How messages are cut into packets."""
        return Cut(self.packet_bytes).for_size(self.size)

    @property
    def is_plain(self) -> bool:
        """Whether a usual message is one packet that nobody repairs."""
        return self.delivery == DATAGRAMS and self.size <= self.packet_bytes

    @property
    def bits(self) -> int:
        """Size of a usual message with the headers of its packets [bit]."""
        return 8 * (self.size + self.cut.usual * HEADER_BYTES)

    @property
    def occupies(self) -> float:
        """Time for which a usual message occupies the bottleneck [s]; NaN without one."""
        rate = summary(self.profile)["rate"]
        return self.bits / rate if rate else nan


@lru_cache(maxsize=64)
def expected(wire: Wire, period: float) -> tuple[float, float]:
    """Return the mean delay [s] and the loss of messages, one per `period` [s]."""
    if wire.is_plain:
        asked = OneWay(wire.profile, 0, uplink=True).expected(period, wire.size)
        return asked.mean, asked.loss
    count = max(MESSAGES_MIN, PACKETS // wire.cut.usual)
    lane, period_ns = Lane(wire, 0, " expected"), round(period * 1e9)
    for number in range(count):
        lane.send(number, number * period_ns, None)
    lane.run(count * period_ns + SETTLED_NS)
    found = lane.summary(period, asked=(nan, nan))
    is_simple = wire.delivery == DATAGRAMS and isnan(wire.occupies)
    only = Timeline(wire.profile).only() if is_simple else None
    share = 1.0 - lane.arrived / count
    if only is not None and not only.blackout:
        intact = (1.0 - wire.profile.corrupt) ** wire.cut.usual
        share = 1.0 - intact * whole_share(only.loss, wire.cut.usual)
    return found["delay_measured"], share


class Lane:
    """The messages of one direction, in flight and counted.

    Attributes:
        queue: The messages in flight; of a stream, those that have arrived.
        is_stream: Whether losses are repaired. Then call `run` before you look into the queue.
    """

    def __init__(self, wire: Wire, seed: int, stream: str) -> None:
        """Send over a link with its `seed` and its name, `stream`."""
        self._wire, self._seed, self._name = wire, seed, stream
        self._way = OneWay(wire.profile, seed, wire.uplink, stream=stream)
        self._size, self._cut, self._occupies = wire.size, wire.cut, wire.occupies
        self.is_stream = wire.delivery == STREAM
        # Largest message that is a packet with its own number.
        self._plain = wire.packet_bytes if wire.is_plain else -1
        self.begin(0)

    def begin(self, episode: int) -> None:
        """Begin an episode without packets."""
        self._episode, self.queue = episode, PacketQueue()
        self.sent = self._delays_ns = self._delivered = 0
        self._more_sent = self._more_lost = 0  # packets beyond one of each message
        if self.is_stream:
            self._agenda = PacketQueue()
            ways = self._medium(self._wire.uplink), self._medium(not self._wire.uplink)
            self._stream = MessageStream(self._agenda, ways, episode, self._cut, self._deliver)

    def _medium(self, uplink: bool) -> Medium:
        profile = self._wire.link.uplink if uplink else self._wire.link.downlink
        name, headers = self._name, HEADER_BYTES
        return Medium(profile, self._seed, uplink, 0, stream=name, headers=headers)

    def send(self, number: int, now_ns: int, message: Any, more: int = 0) -> None:
        """Send a message at `now_ns` [ns] with `more` bytes than usual, or lose it."""
        self.sent += 1
        size = self._size + more
        if size <= self._plain:  # nearly all messages: save time
            arrivals = self._way.send(self._episode, number, size, now_ns)
            if len(arrivals) > 1:
                arrivals = (min(arrivals),)  # of two copies
        elif self.is_stream:
            self._agenda.put(self._stream.send, (now_ns,), (number, size, (now_ns, message)))
            return
        else:
            pieces = self._cut.pieces(number, size)
            arrivals, lost = self._way.send_pieces(self._episode, pieces, now_ns)
            self._more_sent += len(pieces) - 1
            self._more_lost += lost - (not arrivals)
        if arrivals:
            self._delays_ns += arrivals[0] - now_ns
        self.queue.put(None, arrivals, message)

    def run(self, until_ns: int) -> None:
        """Let a stream send, repair and deliver all that is due by `until_ns` [ns]."""
        if self.is_stream:
            run_due(self._agenda, until_ns)

    def _deliver(self, sent: tuple[int, Any], now_ns: int) -> None:
        """Take a message of the stream."""
        sent_ns, message = sent
        self._delays_ns += now_ns - sent_ns
        self._delivered += 1
        self.queue.put(None, (now_ns,), message)

    @property
    def arrived(self) -> int:
        """Number of messages that arrive; of a stream, that have arrived."""
        return self._delivered if self.is_stream else self.sent - self.queue.lost

    def summary(self, period: float, asked: tuple[float, float] | None = None) -> dict[str, float]:
        """Return delay [s] and loss of messages: asked by the profile, measured in this episode.

        One message per `period` [s] is asked for, unless mean delay and loss are given as `asked`.
        """
        lost, arrived = self.queue.lost, self.arrived
        delay, loss = asked or expected(self._wire, period)
        packets = self.sent + self._more_sent, lost + self._more_lost
        if self.is_stream:
            packets = self._stream.transmissions, self._stream.lost
        return {
            "delay_asked": delay,
            "delay_measured": self._delays_ns * 1e-9 / arrived if arrived else nan,
            "loss_asked": loss,
            "loss_measured": lost / self.sent if self.sent else nan,
            "sent": self.sent,
            "packets_sent": packets[0],
            "packets_lost": packets[1],
            "bytes": self._size,
            "on_link": self._occupies,
        }


class RemoteLoop:
    """One robot, one policy and the link between them.

    Attributes:
        seen: The newest observation that the policy has taken, and the environment's info about it.
        is_asked: Whether this observation is new, so that the policy's next answer is sent.
        compute: Function that returns how long the policy computes the answer to the observation
            of a tick [s]; at first, it is that of the settings.
        start: What the robot executes without any answer.
    """

    def __init__(
        self,
        settings: Settings,
        executor: Executor,
        stream: str = "",
        *,
        judge: Callable[[Any], None] | None = None,
    ) -> None:
        """Connect; `stream` is the name of the robot. Call `begin` for each episode.

        `judge` raises an exception for a value of the executor that is no action.
        """
        self._settings, self._executor, self._judge = settings, executor, judge
        self.start = settings.start
        self._tick = -1  # before the first episode
        self._wires = settings.wires
        self._up, self._down = (Lane(wire, settings.seed, stream) for wire in self._wires)
        self._stream, self._episode = stream, -1
        self._within_ns = round(settings.answer_within * 1e9)
        self.compute: Callable[[int], float] = self._draw_time
        self.seen: list[Any] = [None, {}]

    def begin(self, seed: int | None, observation: Any, info: Mapping[str, Any]) -> None:
        """Begin an episode: the policy has the first observation at once.

        With a `seed`, that of the environment, the episode meets the network of this seed, else
        that of the next episode.
        """
        self._episode = self._episode + 1 if seed is None else (int(seed) + 1) * EPISODES
        self._up.begin(self._episode)
        self._down.begin(self._episode)
        self._tick = self._now_ns = self._seen_tick = 0
        self.seen, self._committed = [copied(observation), info], Committed()
        self.is_asked = True
        self._begin_ns = self._free_ns = 0  # when the policy began its last answer, and has it
        self._held = 0
        self._last, self._basis = self.start, -1.0
        self._is_held = False
        self._observation_ages = list[int]()  # [ticks], as the others
        self._action_ages, self._loop_ages = list[float](), list[int]()
        self._fresh_ages = list[float]()  # of new actions since the first of _action_ages, else NaN
        self._executor.basis = -1
        self._executor.begin(self._ticks_late(), round(self._settings.dt * 1e9))

    def _ticks_late(self) -> int:
        """Return the expected age of the loop [ticks]."""
        settings = self._settings
        (up, _), (down, _) = (expected(wire, settings.dt) for wire in self._wires)
        late = float(np.nan_to_num(up + down)) + settings.compute[0] - settings.answer_within
        return max(0, ceil(late / settings.dt - 1e-6))

    def act(self, actions: tuple[Any, ...]) -> Any:
        """Take the policy's answer, if it is asked; return the action that the robot executes."""
        tick, executor = self._tick, self._executor
        if tick < 0:
            raise ResetNeeded("call reset() before step()")
        if self.is_asked:
            self._answer(actions)
        self._receive(self._now_ns + self._within_ns)
        action = executor.action(tick)
        self._is_held = action is None
        if action is not None:
            if self._judge is not None:
                self._judge(action)
                Quantity(ge=0, le=tick).of(executor.basis, "basis")
            self._last, self._basis = action, executor.basis
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
        chunk = Chunk(self._seen_tick, actions)
        if self._settings.waits and not self._tick:
            self._executor.receive(chunk, 0)  # the episode begins when this answer has arrived
            return
        self._free_ns = self._begin_ns + self._time_to_compute()
        self._down.send(self._seen_tick, self._free_ns, chunk)

    def _receive(self, limit_ns: int) -> None:
        """Give the executor the answers that have arrived by `limit_ns` [ns]."""
        if self._down.is_stream:
            self._down.run(limit_ns)
        queue = self._down.queue
        while queue.next_ns <= limit_ns:
            _, _, chunk = queue.pop()
            if chunk.basis:
                self._loop_ages.append(self._tick - chunk.basis)
            self._executor.receive(chunk, self._tick)

    def observe(self, observation: Any, info: Mapping[str, Any]) -> None:
        """Move to the next tick, in which the world gives an observation and its info."""
        self._tick = tick = self._tick + 1
        self._now_ns = now_ns = round(tick * self._settings.dt * 1e9)
        self._receive(now_ns)
        if self._executor.asks(tick, observation):
            committed = self._executor.committed(tick)
            message = (tick, committed, copied(observation), dict(info))
            self._up.send(tick, now_ns, message, size_of(committed.actions))
        self._ask(now_ns + self._within_ns)
        if self._seen_tick:
            self._observation_ages.append(tick - self._seen_tick)

    def _ask(self, limit_ns: int) -> None:
        """Let the policy begin with the observations that have arrived by `limit_ns` [ns]."""
        if self._up.is_stream:
            self._up.run(limit_ns)
        queue, self.is_asked = self._up.queue, False
        while (begin_ns := max(queue.next_ns, self._free_ns)) <= limit_ns:
            before = self._seen_tick
            while queue.next_ns <= begin_ns:
                _, _, message = queue.pop()
                if message[0] > self._seen_tick:
                    self._seen_tick, self._committed, *self.seen = message
            if self._seen_tick > before:
                self.is_asked, self._begin_ns = True, begin_ns
                self._free_ns = begin_ns + self._time_to_compute()

    def _time_to_compute(self) -> int:
        """Return how long the policy computes the answer to its newest observation [ns]."""
        return round(self.compute(self._seen_tick) * 1e9)

    def _draw_time(self, tick: int) -> float:
        mean, deviation = self._settings.compute
        if not deviation:
            return mean
        key = stream_key(self._settings.seed, False, self._episode, _COMPUTE, self._stream)
        counter = [0, 0, 0, tick]
        bits = np.random.Philox(key=np.array(key, dtype=np.uint64), counter=counter)
        shape = (mean / deviation) ** 2
        return np.random.Generator(bits).gamma(shape, mean / shape)

    def told(self) -> dict[str, Any]:
        """Return what the policy may know about the loop, as `info["cloudrc"]`."""
        dt = self._settings.dt
        found: dict[str, Any] = {
            "asked": self.is_asked,
            "observation_age": (self._tick - self._seen_tick) * dt,
            "action_age": (self._tick - 1 - self._basis) * dt if self._basis >= 0 else inf,
            "held": self._is_held,
            "lost_uplink": self._up.queue.lost,
            "lost_downlink": self._down.queue.lost,
        }
        if self._committed.actions:
            found["prefix"], found["delay"] = self._committed
        return found

    def summary(self, deadline: float | None = None) -> dict[str, Any]:
        """Return what the loop was like in this episode: asked and measured.

        `late_share` is the share of steps whose action is older than `deadline` [s], by default
        that of the settings. `age_counts` has the steps by the action's age in ticks, rounded up;
        the last possible, all older ones.
        """
        ticks, dt = self._tick, self._settings.dt
        if ticks < 0:
            raise ResetNeeded("call reset() before summary()")
        if deadline is None:
            deadline = self._settings.deadline
        actions = np.array(self._action_ages) * dt
        late = nan
        if deadline is not None and len(actions):
            late = float(np.mean(actions > deadline + 1e-9))
        is_new = np.array(self._fresh_ages) * dt <= (inf if deadline is None else deadline) + 1e-9
        rounded = np.ceil(np.array(self._action_ages) - 1e-9).clip(max=AGES - 1)
        return {
            "ticks": ticks,
            "loop_age": float(np.mean(self._loop_ages)) * dt if self._loop_ages else nan,
            **_describe("observation_age", np.array(self._observation_ages) * dt, dt),
            **_describe("action_age", actions, dt),
            "age_counts": np.bincount(rounded.astype(int)).tolist(),
            "late_share": late,
            "misses_in_10": most_missed(~is_new) if len(is_new) else nan,
            "held_share": self._held / ticks if ticks else nan,
            "uplink": self._up.summary(dt),
            "downlink": self._down.summary(dt),
        }


def _describe(name: str, ages: Floats, dt: float) -> dict[str, float]:
    """Return numbers of the ages [s] in successive steps of `dt` [s], shape (n,).

    A peak is the age in the last step before that of a fresher observation.
    """
    found = {"mean": nan, "p99": nan, "max": nan, "peak_mean": nan}
    if len(ages):
        found |= {"mean": ages.mean(), "p99": np.percentile(ages, 99.0), "max": ages.max()}
    peaks = ages[:-1][np.diff(ages) < dt - 1e-9]
    if len(peaks):
        found["peak_mean"] = peaks.mean()
    numbers = {f"{name}_{part}": float(value) for part, value in found.items()}
    return {**numbers, f"{name}_of": len(ages)}
