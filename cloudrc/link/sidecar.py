"""Run a pod's `link` container: choose relay or netem, and follow changes of profile and peer.

The peer is the end of the tunnel in the other pod. The route file contains the address to which
this pod's end of the tunnel has to send.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

from cloudrc.errors import CloudrcError
from cloudrc.link.follow import Loaded
from cloudrc.link.netem import Iproute2, Netem, Run
from cloudrc.link.profile import DirectionProfile, Timeline, settled
from cloudrc.link.relay import Address, RelayShaper
from cloudrc.link.state import (
    RELEASED_SUFFIX,
    STATE_FILE,
    Change,
    LinkState,
    publish,
    summary,
    to_text,
)
from cloudrc.records import Counted

Mode: TypeAlias = Literal["auto", "netem", "relay"]
"""Setting `link.mode`: the only allowed shaper, or "auto": netem if it works, else the relay."""
COUNT_PERIOD_NS = 1_000_000_000  # time between two updates of metrics and lateness file [ns]
STEP = 0.05  # longest time until `run` reacts to a new peer or profile [s]

Shaper: TypeAlias = RelayShaper | Netem
"""Shapes the datagrams that this pod's end of the tunnel sends."""
Make: TypeAlias = Callable[[DirectionProfile, int], Shaper]
"""Function that makes a shaper from a profile and the monotonic start of its time line [ns]."""


def find_netems(run: Run, host: str) -> dict[str, Any]:
    """Find the interface to a host, and all netem qdiscs of this pod; {} if the kernel refuses.

    Returns:
        `interface`, and `netems`: interface -> its netem qdiscs, if it has any, as objects of
        `tc -s -j qdisc show`.
    """
    iproute2, netems = Iproute2(run), dict[str, list[dict[str, Any]]]()
    try:
        interface = iproute2.device(host)
        for one in iproute2.show("qdisc", "show"):
            if one.get("kind") == "netem":
                netems.setdefault(str(one["dev"]), []).append(one)
    except (CloudrcError, ValueError, LookupError):
        return {}
    return {"interface": interface, "netems": netems}


class Machine(NamedTuple):
    """Functions of the machine on which a sidecar runs."""

    relay: Make  # makes a `RelayShaper`
    netem: Make  # makes a `Netem`, without changing the network yet
    clock: Callable[[], int]  # returns the time on the monotonic clock [ns]
    wait: Callable[[float], None]  # sleeps for a time [s]
    log: Callable[[str], None]  # writes one line to the log


class Metrics(Protocol):
    """Exports the metrics of a sidecar."""

    def shaped(self, shaper: str, direction: str, mode: str) -> None:
        """Export the shaper that a direction uses from now on."""

    def ready(self, ready: bool) -> None:
        """Export whether the route file exists."""

    def asked(self, direction: str, delay: float) -> None:
        """Export `delay` [s], the mean one-way delay that the profile requests."""

    def see(self, records: Iterable[Counted]) -> None:
        """Export the number of datagrams by outcome; called once a second."""


class Sidecar:
    """Shapes the datagrams that this pod's end of the tunnel sends.

    Another thread sets `peer`, the address of the other pod's end, and `profile`, the requested
    profile.
    """

    def __init__(
        self,
        machine: Machine,
        profile: Loaded,
        *,
        mode: Mode,
        direction: str,
        route: Path,
        metrics: Metrics | None = None,
    ) -> None:
        """Store the arguments; `route` is the path of the route file, beside the state file.

        `direction` is "uplink" or "downlink".
        """
        self.peer: Address | None = None
        self.profile = profile
        self._machine, self._metrics = machine, metrics
        self._mode, self._direction, self._route = mode, direction, route
        self._state_file = route.with_name(STATE_FILE)
        self._released_file = self._state_file.with_suffix(RELEASED_SUFFIX)
        self._reason, self._origin_ns, self._number = "", 0, profile.change.number
        self._in_force: tuple[LinkState, DirectionProfile] | None = None

    def run(self, stop: Callable[[], bool]) -> None:
        """Wait until the peer is known, then shape until `stop` returns True.

        Raises:
            CloudrcError: If the mode is not "auto" and its shaper cannot realise the profile.
        """
        self._route.unlink(missing_ok=True)  # an earlier process may have left one
        while self.peer is None:
            if stop():
                return
            self._machine.wait(STEP)
        self._origin_ns = self._machine.clock()
        try:
            while not stop():
                self._shape(self.peer, stop)
        finally:
            for file in (self._route, self._released_file):
                file.unlink(missing_ok=True)

    def status(self) -> dict[str, Any]:
        """Return shaper, reason and rate [bit/s]; {} before the first shaper.

        The rate is None if it is unlimited, and absent while a time line may change it. Any thread
        may call this method.
        """
        if self._in_force is None:
            return {}
        state, profile = self._in_force
        found = {"shaper": state.shaper, "reason": state.reason}
        elapsed_ns = self._machine.clock() - (state.origin_ns or 0)
        if elapsed_ns < Timeline(profile).last_ns:
            return found
        return {**found, "rate": settled(profile).rate}

    def _shape(self, peer: Address, stop: Callable[[], bool]) -> None:
        """Shape with one shaper until `stop` returns True, or a profile needs the other shaper."""
        profile, machine = self.profile, self._machine
        if self._in_force and self._change_of(profile).restart:
            self._origin_ns = machine.clock()
        shaper, route = self._choose(profile, peer)
        try:
            machine.log(f"{shaper.name} shapes the {self._direction} ({self._reason})")
            self._tell(shaper, profile)
            self._publish_route(route)
            if self._metrics:
                self._metrics.shaped(shaper.name, self._direction, self._mode)
                self._metrics.ready(True)
            count_ns = machine.clock()
            while not stop():
                if self.peer is not None and self.peer != peer:
                    peer = self.peer
                    self._publish_route(shaper.follow_peer(peer))
                if self.profile is not profile:
                    profile = self.profile
                    if not self._replace(shaper, profile):
                        return
                shaper.step(STEP)
                if (now_ns := machine.clock()) >= count_ns:
                    count_ns = now_ns + COUNT_PERIOD_NS
                    self._count(shaper, now_ns)
        finally:
            shaper.close()

    def _choose(self, profile: Loaded, peer: Address) -> tuple[Shaper, Address]:
        """Choose the shaper and store the reason; "auto" tries netem first, then uses the relay."""
        machine, mode = self._machine, self._mode
        self._reason = f"link.mode={mode}"
        if mode != "relay":
            netem = machine.netem(profile.direction, self._origin_ns)
            try:
                return netem, netem.follow_peer(peer)
            except CloudrcError as error:
                if mode == "netem":
                    raise
                self._reason = f"netem does not work here: {_cause(error)}"
        relay = machine.relay(profile.direction, self._origin_ns)
        return relay, relay.follow_peer(peer)

    def _replace(self, shaper: Shaper, profile: Loaded) -> bool:
        """Apply a new profile; return False if the profile needs the other shaper."""
        change = self._change_of(profile)
        try:
            shaper.follow_profile(profile.direction, restart=change.restart)
        except CloudrcError as error:
            if self._mode == "auto":
                self._machine.log(f"the shaper changes to the relay: {_cause(error)}")
                return False
            self._machine.log(f"the new profile is refused, the old one stays: {error}")
            if self._in_force is not None:
                state, old = self._in_force
                state = replace(state, refused=profile.change.number, refusal=str(error))
                self._publish(state, old)
            return True
        if change.restart:
            self._origin_ns = self._machine.clock()
        self._machine.log(f"the new profile is in force ({change.cause})")
        self._tell(shaper, profile)
        return True

    def _change_of(self, profile: Loaded) -> Change:
        """Return the change that led to a profile; an empty change if its number is not new."""
        return profile.change if profile.change.number != self._number else Change()

    def _tell(self, shaper: Shaper, profile: Loaded) -> None:
        """Write the new state to the state file, and export it as metrics."""
        change, asked = self._change_of(profile), summary(profile.direction)
        before = self._in_force[0] if self._in_force else None
        state = LinkState(
            shaper=shaper.name,
            reason=self._reason,
            mode=self._mode,
            direction=self._direction,
            profile=profile.values,
            since=datetime.now(UTC).isoformat(timespec="seconds"),
            since_ns=self._machine.clock(),
            changes=before.changes + 1 if before else 0,
            change=change.number,
            cause=change.cause if before else "",
            asked=asked,
            origin_ns=self._origin_ns,
        )
        self._number = profile.change.number
        self._publish(state, profile.direction)
        if self._metrics:
            self._metrics.asked(self._direction, asked["delay"] or 0.0)

    def _count(self, shaper: Shaper, now_ns: int) -> None:
        """Update the metrics, and the file from which world or cloud reads the lateness."""
        if self._metrics:
            counts = shaper.counts().items()
            self._metrics.see([Counted(now_ns, "link", name, number) for name, number in counts])
        if released := shaper.released():
            with suppress(OSError):  # shaping continues even if the disk is full
                publish(self._released_file, json.dumps(released))

    def _publish(self, state: LinkState, profile: DirectionProfile) -> None:
        self._in_force = state, profile
        with suppress(OSError):
            publish(self._state_file, to_text(state))

    def _publish_route(self, route: Address) -> None:
        publish(self._route, f"{route[0]}:{route[1]}\n")


def _cause(error: CloudrcError) -> str:
    return str(error).partition("; ")[0]
