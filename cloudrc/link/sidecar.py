"""Run the `link` container of a pod: choose a shaper, publish the route, follow what changes.

Other threads leave the peer and the profile here; only the thread in `run` touches the shaper.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol, TypeAlias

from pydantic import TypeAdapter

from cloudrc.errors import CloudrcError, MissingPrerequisiteError
from cloudrc.link.follow import Loaded
from cloudrc.link.profile import DirectionProfile, Timeline, settled
from cloudrc.link.relay import Address
from cloudrc.link.state import (
    RELEASED_SUFFIX,
    Change,
    LinkState,
    publish,
    publish_route,
    summary,
    to_text,
    withdraw,
)
from cloudrc.link.tc import Iproute2, Run, check, notes

Mode: TypeAlias = Literal["auto", "netem", "relay"]
COUNT_PERIOD_NS = 1_000_000_000
"""Time between two updates of the metrics [ns]."""
RELEASED_PERIOD_NS = 2_000_000_000
"""Time between two publications of how late datagrams left [ns]; an end reads it as often."""
STEP = 0.05
"""Longest time in which a change that was left here is not seen [s]."""


class Shaper(Protocol):
    """Shapes what one pod's tunnel end sends to the other's: the relay, or netem."""

    @property
    def name(self) -> str:
        """As in `link.mode`: "relay" or "netem"."""
        ...

    def follow_peer(self, peer: Address) -> Address:
        """Shape what goes to this peer from now on.

        Returns:
            The route: where this pod's tunnel end has to send.

        Raises:
            CloudrcError: If it cannot.
        """
        ...

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        """Shape by this profile from now on; what is in flight is not lost.

        Args:
            profile: Conditions.
            restart: Whether their time line starts now; otherwise it continues.

        Raises:
            CloudrcError: If it cannot; then the old profile stays in force.
        """
        ...

    def step(self, timeout: float) -> None:
        """Work or wait, at most about `timeout` [s]."""
        ...

    def counts(self) -> dict[str, int]:
        """Return how many datagrams met which outcome so far."""
        ...

    def released(self) -> dict[str, int]:
        """Return how late datagrams left since the beginning; empty if that is not known."""
        ...

    def close(self) -> None:
        """Stop shaping and leave nothing behind."""
        ...


Make: TypeAlias = Callable[[DirectionProfile, int], Shaper]
"""Makes a shaper from conditions and the start of their time line [ns]."""


@dataclass(frozen=True, slots=True)
class Near:
    """The netem qdiscs of a network namespace, whoever put them there.

    Attributes:
        interface: The one through which the tunnel's flow leaves.
        netems: By interface: objects of `tc -s -j qdisc show`; only where there are any.
    """

    interface: str
    netems: dict[str, list[dict[str, Any]]]


@dataclass(frozen=True, slots=True)
class Told:
    """What a link's process says of the direction that it shapes.

    Attributes:
        shaper: "relay" or "netem".
        why: Why this one, in words.
        applied: What it was asked to apply and has applied; None while a time line runs.
        near: What the kernel says; None where that cannot be asked.
    """

    shaper: str
    why: str
    applied: DirectionProfile | None
    near: Near | None = None


def look_near(run: Run, host: str) -> Near | None:
    """Ask the kernel for its netems, and for the way to a host; None if it cannot be asked."""
    iproute2, netems = Iproute2(run), dict[str, list[dict[str, Any]]]()
    try:
        interface = iproute2.device(host)
        for one in iproute2.show("qdisc", "show"):
            if one.get("kind") == "netem":
                netems.setdefault(str(one["dev"]), []).append(one)
    except (CloudrcError, ValueError, LookupError):
        return None
    return Near(interface, netems)


def write_told(told: Told) -> str:
    """Write it as JSON."""
    return TypeAdapter(Told).dump_json(told, indent=2).decode() + "\n"


def read_told(text: str) -> Told:
    """Read it; raises a ValueError if it is something else."""
    return TypeAdapter(Told).validate_json(text)


@dataclass(frozen=True, slots=True)
class Settings:
    """How a sidecar is set up.

    Attributes:
        mode: `link.mode`: "relay" and "netem" are strict, "auto" takes netem where it can.
        direction: "uplink" or "downlink", for reports.
        route: File that tells this pod's tunnel end where it has to send.
        state: File beside it that tells reports what shapes the link and why.
    """

    mode: Mode
    direction: str
    route: Path
    state: Path


@dataclass(frozen=True, slots=True)
class Machine:
    """What a sidecar needs of the machine.

    Attributes:
        relay: Makes the relay.
        netem: Makes netem, without touching the network yet.
        may_shape: Whether this process is root with NET_ADMIN.
        try_netem: Raises a CloudrcError if this kernel has no netem; leaves nothing behind.
        clock: Monotonic [ns].
        today: Date and time in UTC as text, for reports.
        wait: Sleeps for a time [s].
        log: Gets lines for people.
    """

    relay: Make
    netem: Make
    may_shape: bool
    try_netem: Callable[[], None]
    clock: Callable[[], int]
    today: Callable[[], str]
    wait: Callable[[float], None]
    log: Callable[[str], None]


class Watcher(Protocol):
    """Keeps the metrics of a sidecar."""

    def shapes(self, shaper: str) -> None:
        """Learn that this shaper is in force from now on, and that the route is published."""
        ...

    def asked(self, delay: float) -> None:
        """Learn the mean delay [s] that the profile in force asks for."""
        ...

    def counted(self, stamp_ns: int, counts: dict[str, int]) -> None:
        """Learn once a second how many datagrams met which outcome so far."""
        ...


class Sidecar:
    """Shapes what one pod's tunnel end sends to the other's.

    Attributes:
        peer: Address of the other pod's tunnel end; another thread sets it.
        profile: What is asked for; another thread sets it.
    """

    def __init__(
        self, settings: Settings, machine: Machine, profile: Loaded, watcher: Watcher | None = None
    ) -> None:
        self.peer: Address | None = None
        self.profile = profile
        self._settings, self._machine, self._watcher = settings, machine, watcher
        self._reason = ""
        self._origin_ns: int | None = None
        self._state: LinkState | None = None
        self._published: LinkState | None = None
        self._in_force: tuple[LinkState, DirectionProfile] | None = None
        self._released, self._released_ns = settings.state.with_suffix(RELEASED_SUFFIX), 0
        self._number = profile.change.number

    def run(
        self, stop: Callable[[], bool], wait_for_peer: Callable[[], None] = lambda: None
    ) -> None:
        """Shape until `stop` returns True.

        Args:
            stop: Whether to end.
            wait_for_peer: Called once it is sure that a strict mode can be kept: from then on the
                peer is looked for.

        Raises:
            CloudrcError: If the mode is strict and its shaper cannot do what is asked.
        """
        withdraw(self._settings.route)  # an earlier process may have left one
        if self._settings.mode == "netem":
            self._check_netem()
        wait_for_peer()
        while self.peer is None:
            if stop():
                return
            self._machine.wait(STEP)
        try:
            while not stop():
                self._shape(self.peer, stop)
        finally:
            withdraw(self._settings.route)
            withdraw(self._released)

    def told(self) -> Told | None:
        """Say what shapes, and what is in force; None before that. Any thread may call this."""
        if self._in_force is None:
            return None
        state, profile = self._in_force
        elapsed_ns = self._machine.clock() - (state.origin_ns or 0)
        over = elapsed_ns >= Timeline(profile).starts_ns[-1]
        return Told(state.shaper, state.reason, settled(profile) if over else None)

    def _check_netem(self) -> None:
        """Find out whether netem will do, before the peer is waited for."""
        if not self._machine.may_shape:
            raise MissingPrerequisiteError(
                "link.mode=netem needs uid 0 and NET_ADMIN; give this container both, or set "
                "link.mode=relay, which needs neither"
            )
        check(self.profile.direction)
        self._machine.try_netem()

    def _shape(self, peer: Address, stop: Callable[[], bool]) -> None:
        """Shape with one shaper, until `stop` or until a profile asks for another one."""
        profile = self.profile
        if self._origin_ns is None or (self._state and self._change_of(profile).restart):
            self._origin_ns = self._machine.clock()
        shaper, route = self._choose(profile, peer)
        try:
            self._announce(shaper, route, profile)
            count_ns = self._machine.clock()
            while not stop():
                if self.peer is not None and self.peer != peer:
                    peer = self.peer
                    publish_route(self._settings.route, shaper.follow_peer(peer))
                if self.profile is not profile:
                    profile = self.profile
                    if not self._replace(shaper, profile):
                        return
                shaper.step(STEP)
                if (now_ns := self._machine.clock()) >= count_ns:
                    count_ns = now_ns + COUNT_PERIOD_NS
                    self._count(shaper, now_ns)
        finally:
            shaper.close()

    def _choose(self, profile: Loaded, peer: Address) -> tuple[Shaper, Address]:
        """Take the shaper of the mode, or find out which one works; remember why."""
        machine, mode = self._machine, self._settings.mode
        self._reason = f"link.mode={mode}"
        if mode != "relay":
            netem = machine.netem(profile.direction, self._origin_ns or 0)
            try:
                if not machine.may_shape:
                    raise MissingPrerequisiteError("no uid 0 with NET_ADMIN")
                return netem, netem.follow_peer(peer)
            except CloudrcError as error:
                if mode == "netem":
                    raise
                self._reason = f"netem does not work here: {_cause(error)}"
        relay = machine.relay(profile.direction, self._origin_ns or 0)
        return relay, relay.follow_peer(peer)

    def _replace(self, shaper: Shaper, profile: Loaded) -> bool:
        """Apply a new profile; return False if that takes another shaper."""
        change = self._change_of(profile)
        try:
            shaper.follow_profile(profile.direction, restart=change.restart)
        except CloudrcError as error:
            if self._settings.mode == "auto":
                self._machine.log(f"changes the shaper: {_cause(error)}")
                return False
            self._machine.log(f"the new profile is refused, the old one stays: {error}")
            if self._state is not None:
                number = profile.change.number
                self._state = replace(self._state, refused=number, refusal=str(error))
                self._publish()
            return True
        if change.restart:
            self._origin_ns = self._machine.clock()
        self._machine.log(f"the new profile is in force ({change.cause})")
        self._tell(shaper, profile)
        return True

    def _change_of(self, profile: Loaded) -> Change:
        """Return the change of a profile; a note that was there before is not about this one."""
        return profile.change if profile.change.number != self._number else Change()

    def _announce(self, shaper: Shaper, route: Address, profile: Loaded) -> None:
        self._machine.log(f"{shaper.name} shapes the {self._settings.direction} ({self._reason})")
        self._tell(shaper, profile)
        publish_route(self._settings.route, route)
        if self._watcher:
            self._watcher.shapes(shaper.name)

    def _tell(self, shaper: Shaper, profile: Loaded) -> None:
        """Publish for ends, users and reports what shapes the link from now on."""
        before, change, asked = self._state, self._change_of(profile), summary(profile.direction)
        for note in notes(profile.direction) if shaper.name == "netem" else ():
            self._machine.log(note)
        self._state = LinkState(
            shaper=shaper.name,
            reason=self._reason,
            mode=self._settings.mode,
            direction=self._settings.direction,
            profile=profile.values,
            since=self._machine.today(),
            since_ns=self._machine.clock(),
            changes=before.changes + 1 if before else 0,
            change=change.number,
            cause=change.cause if before else "",
            asked=asked,
            origin_ns=self._origin_ns,
        )
        self._in_force = self._state, profile.direction
        self._number = profile.change.number
        self._publish()
        if self._watcher:
            self._watcher.asked(asked["delay"] or 0.0)

    def _count(self, shaper: Shaper, now_ns: int) -> None:
        """Update the metrics, and tell this pod's end how late datagrams left."""
        if self._watcher:
            self._watcher.counted(now_ns, shaper.counts())
        if self._published is not self._state:
            self._publish()
        if now_ns >= self._released_ns and (released := shaper.released()):
            self._released_ns = now_ns + RELEASED_PERIOD_NS
            with suppress(OSError):  # a full disk is no reason to stop shaping
                publish(self._released, json.dumps(released))

    def _publish(self) -> None:
        """Write the state; what a full disk does not take is written a second later."""
        if self._state is not None:
            with suppress(OSError):
                publish(self._settings.state, to_text(self._state))
                self._published = self._state


def _cause(error: CloudrcError) -> str:
    """Take the cause from an error, without the remedy."""
    return str(error).partition("; ")[0]
