"""Hostile datagrams beside honest ones, and the proof that they have no effect."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.faults import measures
from cloudrc.faults.flight import Flight
from cloudrc.faults.models import RestartableEndpoint, Tamper
from cloudrc.faults.scenario import Outcome, generator
from cloudrc.tunnel import codec
from cloudrc.world.endpoint import WorldEndpoint

Generator: TypeAlias = np.random.Generator
Make: TypeAlias = Callable[[RestartableEndpoint, bytes, Generator], list[bytes]]
"""Makes the hostile datagrams that arrive at an end before an honest one."""
REFUSED = ("tag", "malformed", "version", "direction", "old_epoch", "repeated")
"""Counts of refused datagrams."""
GREETED = ("hello", "unanswered", "accept_ignored")
"""Counts of captured greetings; a challenge is the only answer."""


class HostileSender:
    """Hands over hostile datagrams, and counts those that were not refused.

    Attributes:
        sent: Number of hostile datagrams.
        taken: Number of them that had an effect.
    """

    def __init__(self) -> None:
        self.sent = self.taken = 0

    def send(self, process: RestartableEndpoint, data: bytes, now_ns: int) -> None:
        """Hand one datagram to an end at `now_ns` [ns]."""
        before, epoch = _counts(process)
        process.receive_now(data, now_ns)
        after, epoch_after = _counts(process)
        self.sent += 1
        rose = after - before
        sent = rose.pop("sent", 0)  # an answer, or a hello to a peer that may have a new epoch
        for name in [name for name in rose if name.startswith("limited_")]:
            del rose[name]  # by the ticks before a greeting
        # A challenge that nobody has asked for is neither counted nor answered.
        ignored = not rose and not sent and kind_of(data) == codec.Kind.CHALLENGE
        refused = rose.total() == 1 and rose.keys() <= {*REFUSED, *GREETED}
        self.taken += epoch != epoch_after or not (ignored or refused)


def _counts(process: RestartableEndpoint) -> tuple[Counter[str], int]:
    inner = process.inner
    assert isinstance(inner, WorldEndpoint | CloudEndpoint)
    return inner.counts, inner.epoch


def kind_of(data: bytes) -> int:
    """Return the kind that a datagram's header names; 0 if there is no header."""
    return codec.peek(data)[0] if len(data) >= codec.HEADER_SIZE else 0


def flipped(data: bytes, rng: Generator, flips: int) -> bytes:
    """Return a datagram with some bits flipped."""
    bits = bytearray(data)
    for place in rng.choice(8 * len(data), min(flips, 8 * len(data)), replace=False).tolist():
        bits[place >> 3] ^= 1 << (place & 7)
    return bytes(bits)


def check_no_effect(
    seed: int, make: Make, *refusals: str, since: float = 0.0, both: bool = False
) -> Outcome:
    """Fly with hostile datagrams beside the honest ones; the flight must be the same.

    Args:
        seed: Seed of the flight.
        make: Makes the hostile datagrams.
        refusals: Counts of world that have to rise.
        since: When the hostile datagrams begin [s].
        both: Whether they go to cloud, too.
    """
    outcome, rng, sender = Outcome(), generator(seed, 20), HostileSender()
    clean, flight = Flight(seed=seed).fly_mission(), Flight(seed=seed)

    def tamper(process: RestartableEndpoint) -> Tamper:
        def tampered(data: bytes, now_ns: int) -> list[bytes]:
            if now_ns * 1e-9 >= since:
                for hostile in make(process, data, rng):
                    sender.send(process, hostile, now_ns)
            return [data]

        return tampered

    flight.world.tamper = tamper(flight.world)
    if both:
        flight.cloud.tamper = tamper(flight.cloud)
    flight.fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.true("the same path, bit by bit", measures.same_path(clean, flight))
    for refusal in refusals:
        labels = ("downlink", refusal)
        measures.moves(outcome, flight, "world", "datagrams_total", *labels, since=since)
    shown = [
        measures.metric(flight, "world", "datagrams_total", "downlink", each) for each in REFUSED
    ]
    outcome.least("metric datagrams_total, refused", sum(n for n in shown if n == n), 900)
    outcome.least("hostile datagrams", sender.sent, 1000)
    outcome.same("of them taken", sender.taken, 0)
    same = measures.epochs(clean) == measures.epochs(flight)
    outcome.true("they opened no session", same)
    return outcome
