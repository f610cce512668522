# SPDX-License-Identifier: Apache-2.0

"""What an evaluation plays: an environment, a policy, and the conditions of the network."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from hashlib import sha256
from math import isnan
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from cloudrc.base.outside.code import sources
from cloudrc.base.outside.reuse import reuse
from cloudrc.base.plugins import is_path
from cloudrc.flight.own_files import hash_of
from cloudrc.flight.trials.fingerprint import fingerprint
from cloudrc.gym.lane import DATAGRAMS, Wire
from cloudrc.gym.options import ANSWER
from cloudrc.gym.step import StepTime
from cloudrc.link.library import PACKET_BYTES, LinkProfile, read_profile
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.radio import mean_delay
from cloudrc.studies.policy.observation import Mapped

Compute = float | tuple[float, float] | tuple[str, str]
"""Time for an answer [s]: constant; or mean and deviation; or (FILE, name) or (MEASURED, "")."""
FILE, MEASURED = "file", "measured"
SEED = "{seed}"
"""Value of an environment's argument that stands for the seed of the episode."""
BASELINE = "no network"
"""Executor of the episodes without a network: the policy answers each observation in its step."""
BARE: dict[str, Any] = {
    "link": "ideal",
    "compute": 0.0,
    "observation_bytes": None,
    "delivery": DATAGRAMS,
    "packet_bytes": PACKET_BYTES,
    "sent_bytes": None,
    "codec": None,
}
"""What these episodes have in place of the values of the setup."""


class SharedChannel(NamedTuple):
    """A channel that the robots of an episode share, as `cloudrc.gym.Channel` takes it."""

    slot_ms: float | None = None  # time of a slot [ms]; None: that of a step
    per_slot: int = 1  # observations that leave in a slot
    schedule: str | None = "round_robin"  # a name, or the path of a file; None: nothing is shared

    def __str__(self) -> str:
        slot = "in a step" if self.slot_ms is None else f"in {self.slot_ms:g} ms"
        return f"a channel ({self.per_slot} {slot}, {self.schedule})"


@dataclass(frozen=True)
class EvalSetup:
    """An evaluation without its conditions; all fields are plain values, for worker processes."""

    env: str  # id of gymnasium
    policy: str  # path of a file, or address of a server
    env_args: tuple[tuple[str, Any], ...] = ()
    link: str = "ideal"  # profile, by name or path
    compute: Compute = 0.0
    times: tuple[float, ...] = ()  # times for answers that a file has [s]
    mapped: tuple[Mapped, ...] = ()  # how an observation becomes the policy's; (): as it is
    success_at: float | None = None  # smallest return of a success [1]; None: what the info says
    dt: float | None = None  # time of a step [s]; None: that of the environment
    max_steps: int = 10_000  # longest episode
    observation_bytes: int | None = None  # of an observation on the wire; None: that of its arrays
    answer_within: float | None = None  # how long the robot waits in a step [s]; None: 5 % of it
    follows_seed: bool = True  # whether equal seeds give equal episodes
    env_code: str = ""  # hash of the environment's code and files
    deadline: float | None = None  # an action of an older observation is late [s]
    step: StepTime | None = None  # of the environment, and who tells its time
    delivery: str = DATAGRAMS  # of messages, as `Networked` takes it
    packet_bytes: int = PACKET_BYTES  # most bytes of a packet
    sent_bytes: int | None = None  # of the first observation on the wire; None: not known yet
    start: Any = ANSWER  # action before the first answer, as `Networked` takes it; a list is one
    hold: str = "repeat"  # what the robot executes without an action, as `Networked` takes it
    observe_age: bool = False  # what the policy observes beside its observation, likewise
    observe_actions: int = 0
    observe_step: bool = False
    robots: int = 1  # that play an episode together
    channel: SharedChannel | None = None  # that they share
    codec: str | None = None  # of the images of an observation, as `Networked` takes it

    @property
    def is_remote(self) -> bool:
        """Whether a server computes the actions."""
        return "://" in self.policy

    @property
    def is_repeatable(self) -> bool:
        """Whether the environment follows its seed, and no clock of this machine counts."""
        return self.follows_seed and not self.is_measured

    @property
    def is_measured(self) -> bool:
        """Whether the time for an answer is measured."""
        return self.compute == (MEASURED, "")

    @property
    def memory(self) -> dict[str, Any]:
        """What the policy observes beside its observation, as `Networked` takes it."""
        return {name: value for name, value in vars(self).items() if name.startswith("observe_")}

    @property
    def compute_times(self) -> Any:
        """Time for an answer, or its mean and its deviation [s], unless it is measured."""
        return fmean(self.times) if self.times else self.compute

    def wire(self, size: int, *, uplink: bool) -> Wire:
        """Return how messages of `size` bytes cross the link: observations, or answers."""
        return Wire(read_profile(self.link), uplink, size, self.delivery, self.packet_bytes)

    @property
    def sent(self) -> dict[str, Any]:
        """An observation on the wire: bytes, packets, and its time at the bottleneck if any."""
        if self.sent_bytes is None:
            return {}
        wire = self.wire(self.sent_bytes, uplink=True)
        found = {"observation_bytes": wire.size, "observation_packets": wire.cut.usual}
        if isnan(wire.occupies):
            return found
        return {**found, "on_link_ms": round(1e3 * wire.occupies, 3)}  # to the microsecond

    @property
    def facts(self) -> str:
        """The step and, in words, how large an observation is on the wire, and its time there."""
        if not self.sent:
            return f"step {self.step}"
        text = f"step {self.step}, observations of {self.sent_bytes:,} bytes"
        if (count := self.sent["observation_packets"]) > 1:
            text += f" in {count:,} packets ({self.delivery})"
        if self.codec:
            text += f", images as {self.codec}"
        if self.channel:
            text += f", {self.robots} robots share {self.channel}"
        on_link = self.sent.get("on_link_ms")
        return text if on_link is None else f"{text}, {on_link:g} ms on the link"

    def identity(self) -> dict[str, Any]:
        """Return all that the result of an episode depends on, but its condition and seed: JSON."""
        told = asdict(self)
        if not self.is_remote:
            told["policy"] = hash_of(sources(Path(self.policy)))
        told["link"] = _code_of_link(read_profile(self.link))
        told["compute"] = told.pop("times") or self.compute
        if self.channel is None:
            del told["robots"], told["channel"]
        elif is_path(f"{self.channel.schedule}"):
            told["schedule"] = hash_of(sources(Path(f"{self.channel.schedule}")))
        if self.codec is None:
            del told["codec"]
        return json.loads(json.dumps(told))  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Episode:
    """One episode: a condition, and the seed of environment and network."""

    rtt_ms: float | None  # mean round trip [ms]; None: that of the profile
    executor: str
    seed: int
    parameters: tuple[tuple[str, Any], ...] = ()  # of the executor

    @property
    def point(self) -> dict[str, Any]:
        """The condition without its seed."""
        given = [f"{key}={value}" for key, value in self.parameters]
        return {"rtt_ms": self.rtt_ms, "executor": " ".join([self.executor, *given])}

    @property
    def file(self) -> str:
        """Name of a file about it alone."""
        name = re.sub(r"[^\w.=]+", "-", self.point["executor"])
        rtt = "" if self.rtt_ms is None else f"-{self.rtt_ms:g}ms"
        return f"{name}{rtt}-seed{self.seed}.json"

    @property
    def chosen(self) -> dict[str, Any]:
        """The executor with its parameters, as `Networked` takes it."""
        return {"name": self.executor, **dict(self.parameters)}

    @property
    def is_baseline(self) -> bool:
        """Whether the episode has no network."""
        return self.executor == BASELINE

    def key(self, identity: Mapping[str, Any]) -> str:
        """Return the name of the row: equal keys mean equal episodes."""
        if self.is_baseline:
            identity = {**identity, **BARE}
            del identity["codec"]  # as without one: its images do not travel
        own = ""  # an executor of a package counts by its version
        if is_path(self.executor):
            file = Path(self.executor)
            own = reuse(("executor", self.executor), lambda: hash_of(sources(file)))
        return fingerprint(identity, self.point, own, self.seed)


def _code_of_link(link: LinkProfile) -> str:
    """Return the hash of a profile with the contents of its files, wherever they are."""
    both = link.uplink, link.downlink
    ways = [replace(way, trace=None, table=None, rate_trace=None) for way in both]
    radios = [[way.radio for way in both]] * any(way.radio for way in both)  # not in a repr
    return sha256(repr([*ways, link.start_s, *radios]).encode()).hexdigest()


def radio_ms(link: LinkProfile) -> float:
    """Return the mean round trip in the radios of a link [ms]."""
    return 1e3 * (mean_delay(link.uplink, True) + mean_delay(link.downlink, False))


def link_at(profile: str, rtt_ms: float | None) -> LinkProfile:
    """Return a link profile with the mean round trip `rtt_ms` [ms]; None: as it is.

    The two delays keep the ratio of the profile; a radio has its part of the round trip. Jitter,
    loss and rate stay, but no jitter is larger than its delay, which would raise the mean.
    """
    link = read_profile(profile)
    if rtt_ms is None:
        return link
    rtt_ms -= radio_ms(link)
    both = link.uplink, link.downlink
    whole = sum(way.delay_ms for way in both)
    share = link.uplink.delay_ms / whole if whole else 0.5

    def at(way: DirectionProfile, delay: float) -> DirectionProfile:
        return replace(way, delay_ms=delay, jitter_ms=min(way.jitter_ms, delay))

    up, down = at(link.uplink, share * rtt_ms), at(link.downlink, (1 - share) * rtt_ms)
    return replace(link, uplink=up, downlink=down)
