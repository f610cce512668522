# SPDX-License-Identifier: Apache-2.0

"""Shape one direction of the link: choose relay or netem, follow changes of profile and peer.

The sidecar delays the datagrams that one end of the tunnel sends, its own end: the end in the same
pod, or one end of a local run. The peer is the other end. The route file contains the address to
which the own end has to send.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from cloudrc.base.errors import CloudrcError
from cloudrc.base.files import write_atomically
from cloudrc.link.carry.udp import Address, Relay
from cloudrc.link.follow import Loaded, publish_state
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import RELEASED_SUFFIX, STATE_FILE, LinkState, publish, to_text

if TYPE_CHECKING:
    from cloudrc.link.netem import Netem

Mode = Literal["auto", "netem", "relay"]
"""Setting `link.mode`: the only allowed shaper, or "auto": netem if it works, else the relay."""
COUNT_PERIOD_NS = 1_000_000_000  # time between two updates of the metrics [ns]
STEP = 0.05  # longest time until `run` reacts to a new peer or profile [s]

Shaper: TypeAlias = "Relay | Netem"
"""Shapes the datagrams that the own end of the tunnel sends."""
Make = Callable[[DirectionProfile, int], Shaper]
"""Function that makes a shaper from a profile and the monotonic start of its schedule [ns]."""


@dataclass(eq=False, kw_only=True)
class Sidecar:
    """Shapes the datagrams that the own end of the tunnel sends.

    Other threads set `peer` and `profile`. They also call `publish_released`, because the loop that
    forwards must not wait for a disk.
    """

    relay: Make  # makes a `Relay`
    netem: Make  # makes a `Netem`, without changing the network yet
    clock: Callable[[], int]  # returns the time on the monotonic clock [ns]
    wait: Callable[[float], None]  # sleeps for a time [s]
    log: Callable[[str], None]  # writes one line to the log
    profile: Loaded  # requested profile
    mode: Mode
    direction: str  # "uplink" or "downlink"
    route: Path  # file with the address to which the tunnel sends; the state is beside it
    tell: Callable[[LinkState], object]  # exports each new state of the link as metrics
    count: Callable[[dict[str, int]], object]  # exports datagrams by outcome, once a second
    origin_ns: int = 0  # when the link comes up, then time 0 of its schedule [ns]; 0: not yet
    peer: Address | None = None  # address of the other end
    state: LinkState | None = None  # last state that is published
    _reason: str = ""  # why this shaper was chosen, in words
    _shaper: Shaper | None = None

    def __post_init__(self) -> None:
        self._state_file = self.route.with_name(STATE_FILE)
        self._released_file = self._state_file.with_suffix(RELEASED_SUFFIX)

    def run(self, stop: Callable[[], bool]) -> None:
        """Wait until the peer is known, then shape datagrams until `stop` returns True.

        Raises:
            CloudrcError: If the mode names a shaper (relay or netem), and this shaper cannot
                realise the profile.
        """
        self.route.unlink(missing_ok=True)  # an earlier process may have left one
        while self.peer is None:
            if stop():
                return
            self.wait(STEP)
        self.origin_ns = (self.origin_ns or self.clock()) - self.profile.start_ns
        if self.profile.note:
            self.log(self.profile.note)
        try:
            while not stop():
                self._shape(self.peer, stop)
        finally:
            for file in (self.route, self._released_file):
                file.unlink(missing_ok=True)

    def publish_released(self) -> None:
        """Write the lateness of datagrams to a file, which the own end of the tunnel reads."""
        shaper = self._shaper  # another thread may replace it
        if shaper and (released := shaper.released()):
            publish(json.dumps(released), self._released_file)

    def _shape(self, peer: Address, stop: Callable[[], bool]) -> None:
        """Run netem or the relay until `stop()` is true, or until a profile needs the other."""
        profile = self.profile
        if self.state and profile.change.restart:
            self.origin_ns = self.clock() - profile.start_ns
        shaper, route = self._choose(profile, peer)
        self._shaper = shaper
        try:
            self.log(f"{shaper.name} shapes the {self.direction} ({self._reason})")
            state = self._publish(shaper, profile)
            self._publish_route(route)  # others read the state once the route is there
            self.tell(state)
            count_ns = self.clock()
            while not stop():
                if self.peer is not None and self.peer != peer:
                    peer = self.peer
                    self._publish_route(shaper.follow_peer(peer))
                if self.profile is not profile:
                    profile = self.profile
                    if not self._replace(shaper, profile):
                        return
                shaper.step(STEP)
                if (now_ns := self.clock()) >= count_ns:
                    count_ns = now_ns + COUNT_PERIOD_NS
                    self.count(shaper.counts())
        finally:
            self._shaper = None
            shaper.close()

    def _choose(self, profile: Loaded, peer: Address) -> tuple[Shaper, Address]:
        """Choose netem or the relay, and store the reason; "auto" uses netem if it works."""
        self._reason = f"link.mode={self.mode}"
        if self.mode != "relay":
            netem = self.netem(profile.direction, self.origin_ns)
            try:
                return netem, netem.follow_peer(peer)
            except CloudrcError as error:
                if self.mode == "netem":
                    raise
                self._reason = f"netem does not work here: {error.cause}"
        relay = self.relay(profile.direction, self.origin_ns)
        return relay, relay.follow_peer(peer)

    def _replace(self, shaper: Shaper, profile: Loaded) -> bool:
        """Apply or refuse a new profile; return False if the relay has to replace netem for it."""
        restart, start_ns = profile.change.restart, profile.start_ns
        try:
            shaper.follow_profile(profile.direction, restart=restart, start_ns=start_ns)
        except CloudrcError as error:
            if self.mode == "auto":
                self.log(f"the shaper changes to the relay: {error.cause}")
                return False
            self.log(f"the new profile is refused, the old one stays: {error}")
            if self.state:
                number = profile.change.number
                self.state = replace(self.state, refused=number, refusal=str(error))
                publish(to_text(self.state), self._state_file)
            return True
        if restart:
            self.origin_ns = self.clock() - start_ns
        self.log(f"the new profile is in force ({profile.change.cause})")
        self.tell(self._publish(shaper, profile))
        return True

    def _publish(self, shaper: Shaper, profile: Loaded) -> LinkState:
        """Publish the state after a change of profile or shaper; return it."""
        state = self.state = publish_state(
            self._state_file,
            self.state,
            profile,
            self.clock(),
            shaper=shaper.name,
            reason=self._reason,
            mode=self.mode,
            direction=self.direction,
            origin_ns=self.origin_ns,
        )
        return state

    def _publish_route(self, route: Address) -> None:
        write_atomically(self.route, f"{route[0]}:{route[1]}\n".encode())
