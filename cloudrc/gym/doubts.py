# SPDX-License-Identifier: Apache-2.0

"""Say in words what makes the messages of a robot useless: few arrive, or they are too many."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from cloudrc.gym.lane import DATAGRAMS, Wire
from cloudrc.link.profile import LinkSchedule, whole_share


class LinkWarning(UserWarning):
    """Episodes over a link tell little of the policy, or rest on a guess."""


def doubts(wires: Iterable[Wire], dt: float, *, asks_always: bool) -> Iterator[str]:
    """Say what is lost of messages in several packets, and which need more than the link's rate.

    `dt` is the time of a step [s]; `asks_always` says whether each step sends a message.
    """
    for wire in wires:
        if wire.delivery == DATAGRAMS and wire.cut.usual > 1:
            yield from _describe_loss(wire)
        if asks_always:
            yield from _describe_rate(wire, dt)


def _name(wire: Wire) -> str:
    return f"{'an observation' if wire.uplink else 'an answer'} of {wire.size:,} bytes"


def _describe_loss(wire: Wire) -> Iterator[str]:
    count, queue, shares = wire.cut.usual, wire.profile.queue_packets, list[float]()
    pieces = [piece for piece in LinkSchedule(wire.profile).pieces if not piece.blackout]
    for piece in pieces:
        intact = (1.0 - wire.profile.corrupt) ** count
        overflows = bool(wire.rates) and queue < count
        shares.append(0.0 if overflows else intact * whole_share(piece.loss, count))
    if min(shares, default=1.0) == 1.0:
        return
    at_times = " at times" * (min(shares) < max(shares))
    why = f": the queue of the link has {queue} places" * (queue < count and min(shares) == 0.0)
    yield (
        f"{_name(wire)} is {count:,} packets, and lost if one of them is: "
        f"{min(shares):.2%} arrive whole{at_times}{why}; with delivery='stream' "
        "(--delivery stream) all arrive, some of them late"
    )


def _describe_rate(wire: Wire, dt: float) -> Iterator[str]:
    rates, needed = wire.rates, wire.bits / dt
    if wire.exceeds_rate(dt):
        at_times = " at times" * (min(rates) < max(rates))
        way = "uplink" if wire.uplink else "downlink"
        yield (
            f"{_name(wire)} each {dt * 1e3:.4g} ms needs {needed * 1e-3:,.0f} "
            f"kbit/s, but the {way} has {min(rates) * 1e-3:,.0f} kbit/s{at_times}: its queue fills"
        )
