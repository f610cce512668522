# SPDX-License-Identifier: Apache-2.0

"""Carry TCP connections to a server over the emulated link, until a signal."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from cloudrc.base.files import at_place
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.config.profile import DIRECTIONS
from cloudrc.flight.interrupts import is_interrupted, noted_interrupts
from cloudrc.flight.links.carrier import STEP, CarrySettings, LiveLink
from cloudrc.flight.pod.realtime import Address, show_address
from cloudrc.link.carry.punctual import settle
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.carry.tcp.relay import StreamRelay
from cloudrc.link.profile import DirectionProfile

WAITING = 512  # connections that the kernel keeps until the relay accepts them


@dataclass(frozen=True)
class RelaySettings(CarrySettings):
    """What to relay; a field is the flag of this name."""

    listen: Address
    to: Address


def relay_tcp(settings: RelaySettings, tell: Callable[[str], None]) -> dict[str, Any]:
    """Relay connections until a signal interrupts; return counts, and the times of turns [s]."""
    with contextlib.ExitStack() as stack:
        link = LiveLink(settings, "link relay tcp", tell, stack, check=check_keys)
        family, to = _find(settings.to)
        listening = stack.enter_context(_listen(settings.listen))
        where = show_address(listening.getsockname()[:2])
        now_ns = link.begin()
        up, down = (
            Medium(link.profile(way), settings.seed, way == "uplink", now_ns) for way in DIRECTIONS
        )
        relay = StreamRelay(listening, to, family, (up, down))
        stack.callback(relay.close)
        link.serve(relay.engine, {"uplink": up, "downlink": down})
        settle()
        with noted_interrupts():  # an exception at any line would leave a half-closed connection
            tell(f"{where} leads to {show_address(settings.to)}; link: {link.cause}")
            while not is_interrupted():
                relay.engine.step(STEP)
        return _summary(relay)


def check_keys(profile: DirectionProfile, name: str) -> None:
    """Check that bytes of a TCP connection can show all keys of the profile."""
    for key in ("duplicate", "corrupt", "reorder"):
        if getattr(profile, key):
            raise InvalidValueError(
                f"{key}: TCP hands bytes on once, undamaged and in order, so a relay of bytes"
                f" cannot show it; set {name}.{key}=0, or use 'cloudrc link exec'"
            )


def _listen(where: Address) -> socket.socket:
    family = socket.AF_INET6 if ":" in where[0] else socket.AF_INET
    with at_place(f"--listen {show_address(where)}"):
        return socket.create_server(where, family=family, backlog=WAITING)


def _find(to: Address) -> tuple[int, tuple[str, int]]:
    """Look up the server's address, IPv4 if it has one; return its family, host and port."""
    with at_place(f"--to {show_address(to)}"):
        found = socket.getaddrinfo(*to, type=socket.SOCK_STREAM)
    # A server rarely listens at ::1 alone, but localhost often names it first.
    family, _, _, _, address = min(found, key=lambda one: one[0] != socket.AF_INET)
    return int(family), (str(address[0]), int(address[1]))


def _summary(relay: StreamRelay) -> dict[str, Any]:
    times: dict[str, float] = {"count": len(relay.response_times)}
    if relay.response_times:
        cuts = np.percentile(np.array(relay.response_times) * 1e-9, (50, 95, 100)).tolist()
        times |= zip(("median", "p95", "max"), cuts, strict=True)
    return {"schemaVersion": 1, **relay.counts, "turns": times}
