"""Run the `link` container of a pod: choose a shaper, publish the route, follow changes.

Other threads set the attributes `peer` and `profile` of the `Sidecar`; only the thread in `run`
uses the shaper.
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
from cloudrc.link.netem import Iproute2, Run, notes
from cloudrc.link.profile import DirectionProfile, Timeline, settled
from cloudrc.link.relay import Address
from cloudrc.link.state import RELEASED_SUFFIX, Change, LinkState, publish, summary, to_text

Mode: TypeAlias = Literal["auto", "netem", "relay"]
"""Setting `link.mode`: "relay" and "netem" are strict, "auto" uses netem if possible."""
COUNT_PERIOD_NS = 1_000_000_000
"""Time between two updates of the metrics [ns]."""
RELEASED_PERIOD_NS = 2_000_000_000
"""Time between two publications of how late datagrams left [ns]; an end reads with this period."""
STEP = 0.05
"""Longest time until the thread in `run` sees a new peer or profile [s]."""


class Shaper(Protocol):
    """Shapes the datagrams from this pod's tunnel end to the other pod's: relay or netem."""

    @property
    def name(self) -> str:
        """Name as in the setting `link.mode`: "relay" or "netem"."""

    def follow_peer(self, peer: Address) -> Address:
        """Shape the datagrams to this peer from now on; raise a CloudrcError if that fails.

        Returns:
            The route: the address to which this pod's tunnel end has to send.
        """

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        """Shape by this profile from now on; datagrams in flight are not lost.

        The time line starts now (`restart`) or continues. If the shaper cannot do this, the old
        profile stays in force, and a CloudrcError is raised.
        """

    def step(self, timeout: float) -> None:
        """Work or wait for about `timeout` [s]."""

    def counts(self) -> dict[str, int]:
        """Return the number of datagrams so far, by outcome."""

    def released(self) -> dict[str, int]:
        """Return by how much datagrams left too late, as counts; empty if unknown."""

    def close(self) -> None:
        """Stop shaping and leave nothing behind."""


Make: TypeAlias = Callable[[DirectionProfile, int], Shaper]
"""Function that makes a shaper from conditions and the start of their time line [ns]."""


@dataclass(frozen=True, slots=True)
class Near:
    """The netem qdiscs of a network namespace, including those of other programs.

    Attributes:
        interface: Interface through which the tunnel's flow leaves.
        netems: Interface -> its netem qdiscs, if any, as objects of `tc -s -j qdisc show`.
    """

    interface: str
    netems: dict[str, list[dict[str, Any]]]


@dataclass(frozen=True, slots=True)
class Told:
    """Report of a link's process about the direction that it shapes.

    Attributes:
        shaper: "relay" or "netem".
        why: Why this shaper was chosen, in words.
        applied: The constant conditions in force; None while a time line runs.
        near: The netem qdiscs that the kernel lists; None if the kernel cannot be asked.
    """

    shaper: str
    why: str
    applied: DirectionProfile | None
    near: Near | None = None


def look_near(run: Run, host: str) -> Near | None:
    """Ask the kernel for its netem qdiscs and for the interface to a host; None if that fails."""
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
    """Format a `Told` as JSON."""
    return TypeAdapter(Told).dump_json(told, indent=2).decode() + "\n"


def read_told(text: str) -> Told:
    """Parse the JSON of a `Told`; raise a ValueError if the text is something else."""
    return TypeAdapter(Told).validate_json(text)


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of a sidecar: `link.mode`, "uplink" or "downlink", route file and state file.

    The route file holds the address to which this pod's tunnel end has to send.
    """

    mode: Mode
    direction: str
    route: Path
    state: Path


@dataclass(frozen=True, slots=True)
class Machine:
    """Functions and facts of the machine that a sidecar needs.

    Attributes:
        relay: Makes the relay.
        netem: Makes the `Netem`, without touching the network yet.
        may_shape: Whether this process is root with NET_ADMIN.
        clock: Returns the time on the monotonic clock [ns].
        today: Returns date and time in UTC as text, for reports.
    """

    relay: Make
    netem: Make
    may_shape: bool
    clock: Callable[[], int]
    today: Callable[[], str]
    wait: Callable[[float], None]
    log: Callable[[str], None]


class Watcher(Protocol):
    """Keeps the metrics of a sidecar."""

    def shapes(self, shaper: str) -> None:
        """Note that this shaper is in force from now on, and that the route is published."""

    def asked(self, delay: float) -> None:
        """Note the mean delay [s] that the profile in force requests."""

    def counted(self, stamp_ns: int, counts: dict[str, int]) -> None:
        """Note the number of datagrams so far by outcome; called once a second."""


class Sidecar:
    """Shapes the datagrams from this pod's tunnel end to the other pod's.

    Attributes:
        peer: Address of the other pod's tunnel end; another thread sets this attribute.
        profile: The requested profile; another thread sets this attribute.
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

    def run(self, stop: Callable[[], bool]) -> None:
        """Wait for the peer, then shape, until `stop` returns True.

        Raises:
            CloudrcError: If the mode is strict and its shaper cannot realise the profile.
        """
        files = self._settings.route, self._released
        files[0].unlink(missing_ok=True)  # an earlier process may have left one
        while self.peer is None:
            if stop():
                return
            self._machine.wait(STEP)
        try:
            while not stop():
                self._shape(self.peer, stop)
        finally:
            for file in files:
                file.unlink(missing_ok=True)

    def told(self) -> Told | None:
        """Return shaper and conditions in force; None before the first shaper.

        Any thread may call this method.
        """
        if self._in_force is None:
            return None
        state, profile = self._in_force
        elapsed_ns = self._machine.clock() - (state.origin_ns or 0)
        over = elapsed_ns >= Timeline(profile).last_ns
        return Told(state.shaper, state.reason, settled(profile) if over else None)

    def _shape(self, peer: Address, stop: Callable[[], bool]) -> None:
        """Shape with one shaper until `stop`, or until a new profile needs another shaper."""
        profile = self.profile
        if self._origin_ns is None or (self._state and self._change_of(profile).restart):
            self._origin_ns = self._machine.clock()
        shaper, route = self._choose(profile, peer)
        try:
            self._machine.log(
                f"{shaper.name} shapes the {self._settings.direction} ({self._reason})"
            )
            self._tell(shaper, profile)
            self._publish_route(route)
            if self._watcher:
                self._watcher.shapes(shaper.name)
            count_ns = self._machine.clock()
            while not stop():
                if self.peer is not None and self.peer != peer:
                    peer = self.peer
                    self._publish_route(shaper.follow_peer(peer))
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
        """Choose the shaper and store the reason; in mode "auto" try netem, then use the relay."""
        machine, mode = self._machine, self._settings.mode
        self._reason = f"link.mode={mode}"
        if mode != "relay":
            netem = machine.netem(profile.direction, self._origin_ns or 0)
            try:
                if not machine.may_shape:
                    raise MissingPrerequisiteError(
                        "no uid 0 with NET_ADMIN; give this container both, or set "
                        "link.mode=relay, which needs neither"
                    )
                return netem, netem.follow_peer(peer)
            except CloudrcError as error:
                if mode == "netem":
                    raise
                self._reason = f"netem does not work here: {_cause(error)}"
        relay = machine.relay(profile.direction, self._origin_ns or 0)
        return relay, relay.follow_peer(peer)

    def _replace(self, shaper: Shaper, profile: Loaded) -> bool:
        """Apply a new profile; return False if the profile needs another shaper."""
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
        """Return the change of a profile; an unknown change if its number is that of the last."""
        return profile.change if profile.change.number != self._number else Change()

    def _tell(self, shaper: Shaper, profile: Loaded) -> None:
        """Publish shaper and profile in force from now on, for ends, users and reports."""
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
        self._publish()
        if now_ns >= self._released_ns and (released := shaper.released()):
            self._released_ns = now_ns + RELEASED_PERIOD_NS
            with suppress(OSError):  # a full disk is no reason to stop shaping
                publish(self._released, json.dumps(released))

    def _publish(self) -> None:
        """Write a new state; if the disk is full, the next attempt follows a second later."""
        if self._state is not None and self._state is not self._published:
            with suppress(OSError):
                publish(self._settings.state, to_text(self._state))
                self._published = self._state

    def _publish_route(self, route: Address) -> None:
        """Write the route file for this pod's tunnel end: one line HOST:PORT."""
        publish(self._settings.route, f"{route[0]}:{route[1]}\n")


def _cause(error: CloudrcError) -> str:
    """Return the cause from an error's text, without the remedy."""
    return str(error).partition("; ")[0]
