"""The `link` container of a pod: it chooses a shaper, tells the route, and follows what changes.

Peer and profile come from other threads, which leave them here; the shaper is touched by the one
thread that is in `run` and by no other.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, TypeAlias

from cloudrc.errors import CloudrcError, MissingPrerequisiteError
from cloudrc.link.netem_text import check, notes
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay_lane import Address
from cloudrc.link.route import publish, publish_route, withdraw
from cloudrc.link.shaper import Shaper
from cloudrc.link.sidecar_follow import Loaded
from cloudrc.link.sidecar_told import Told, in_force_now
from cloudrc.link.state import RELEASED_SUFFIX, Change, LinkState, summary, to_text

Mode: TypeAlias = Literal["auto", "netem", "relay"]
Make: TypeAlias = Callable[[DirectionProfile, int], Shaper]
"""Makes a shaper from conditions and the instant [ns] that their time line counts from."""

COUNT_PERIOD_NS = 1_000_000_000
RELEASED_PERIOD_NS = 2_000_000_000
"""Between two tellings of how late datagrams left [ns]: as often as an end notes it."""
_WAIT = 0.05
_STEP = 0.05
"""Longest time in which a change that was left here is not seen [s]."""


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
        wait: Sleeps for so long [s].
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
    """Whoever keeps the metrics."""

    def shapes(self, shaper: str) -> None:
        """Learn that from now on this shaper is in force, and that the route is told."""
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
        peer: Where the other pod's tunnel end is; another thread sets it.
        profile: What is asked for; another thread sets it.
    """

    def __init__(
        self, settings: Settings, machine: Machine, profile: Loaded, watcher: Watcher | None = None
    ) -> None:
        self.peer: Address | None = None
        self.profile = profile
        self._settings = settings
        self._machine = machine
        self._watcher = watcher
        self._reason = ""
        self._origin_ns: int | None = None
        self._state: LinkState | None = None
        self._published: LinkState | None = None
        self._in_force: tuple[LinkState, DirectionProfile] | None = None
        self._released, self._released_ns = settings.state.with_suffix(RELEASED_SUFFIX), 0
        self._seen = profile.change.number

    def run(
        self, stop: Callable[[], bool], wait_for_peer: Callable[[], None] = lambda: None
    ) -> None:
        """Shape until `stop` says True.

        Args:
            stop: Whether to end.
            wait_for_peer: Called once it is sure that a strict mode can be kept: from then on the
                peer is looked for.

        Raises:
            CloudrcError: If the mode is strict and its shaper cannot do what is asked.
        """
        withdraw(self._settings.route)  # an earlier process may have left one
        if self._settings.mode == "netem":
            self._insist()
        wait_for_peer()
        while self.peer is None:
            if stop():
                return
            self._machine.wait(_WAIT)
        try:
            while not stop():
                self._shape(self.peer, stop)
        finally:
            withdraw(self._settings.route)
            withdraw(self._released)

    def told(self) -> Told | None:
        """Say who shapes, and what is in force; None before that. Other threads may ask."""
        if self._in_force is None:
            return None
        state, profile = self._in_force
        elapsed_ns = self._machine.clock() - (state.origin_ns or 0)
        return Told(state.shaper, state.reason, in_force_now(profile, elapsed_ns))

    def _insist(self) -> None:
        """Find out whether netem will do, before anybody is waited for."""
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
                shaper.step(_STEP)
                if (now_ns := self._machine.clock()) >= count_ns:
                    count_ns = now_ns + COUNT_PERIOD_NS
                    self._count(shaper, now_ns)
        finally:
            shaper.close()

    def _count(self, shaper: Shaper, now_ns: int) -> None:
        """Tell how it goes: the metrics what became of datagrams, this pod's end how late."""
        if self._watcher:
            self._watcher.counted(now_ns, shaper.counts())
        if self._published is not self._state:
            self._publish()
        if now_ns >= self._released_ns and (released := shaper.released()):
            self._released_ns = now_ns + RELEASED_PERIOD_NS
            with suppress(OSError):  # a full disk is no reason to stop shaping
                publish(self._released, json.dumps(released))

    def _choose(self, profile: Loaded, peer: Address) -> tuple[Shaper, Address]:
        """Take the shaper of the mode, or find out which one works; say why."""
        machine, mode = self._machine, self._settings.mode
        self._reason = f"link.mode={mode}"
        if mode != "relay":
            netem = machine.netem(profile.direction, self._origin_ns or 0)
            try:
                if not machine.may_shape:
                    raise MissingPrerequisiteError("no uid 0 with NET_ADMIN")
                route = netem.follow_peer(peer)
            except CloudrcError as error:
                if mode == "netem":
                    raise
                self._reason = f"netem does not work here: {_cause(error)}"
            else:
                return netem, route
        relay = machine.relay(profile.direction, self._origin_ns or 0)
        return relay, relay.follow_peer(peer)

    def _replace(self, shaper: Shaper, profile: Loaded) -> bool:
        """Put a new profile in force; False if that takes another shaper."""
        try:
            shaper.follow_profile(profile.direction, restart=self._change_of(profile).restart)
        except CloudrcError as error:
            if self._settings.mode == "auto":
                self._machine.log(f"changes the shaper: {_cause(error)}")
                return False
            self._machine.log(f"the new profile is refused, the old one stays: {error}")
            self._refuse(profile, str(error))
            return True
        if self._change_of(profile).restart:
            self._origin_ns = self._machine.clock()
        self._machine.log(f"the new profile is in force ({self._change_of(profile).cause})")
        self._tell(shaper, profile)
        return True

    def _announce(self, shaper: Shaper, route: Address, profile: Loaded) -> None:
        settings = self._settings
        self._machine.log(f"{shaper.name} shapes the {settings.direction} ({self._reason})")
        self._tell(shaper, profile)
        publish_route(settings.route, route)
        if self._watcher:
            self._watcher.shapes(shaper.name)

    def _change_of(self, profile: Loaded) -> Change:
        """Say who changed a profile; a note that was there before is not about this change."""
        return profile.change if profile.change.number != self._seen else Change()

    def _tell(self, shaper: Shaper, profile: Loaded) -> None:
        """Write for ends, users and reports what shapes the link from now on."""
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
        self._seen = profile.change.number
        self._publish()
        if self._watcher:
            self._watcher.asked(asked["delay"] or 0.0)

    def _refuse(self, profile: Loaded, why: str) -> None:
        """Write for users that their change did not take force."""
        if self._state is not None:
            self._state = replace(self._state, refused=profile.change.number, refusal=why)
            self._publish()

    def _publish(self) -> None:
        """Write the state for others; what a full disk does not take is written a second later."""
        if self._state is not None:
            with suppress(OSError):
                publish(self._settings.state, to_text(self._state))
                self._published = self._state


def _cause(error: CloudrcError) -> str:
    """Take from an error what is wrong, without what to do about it."""
    return str(error).partition("; ")[0]
