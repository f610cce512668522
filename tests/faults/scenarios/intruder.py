# SPDX-License-Identifier: Apache-2.0

"""Faults F8, F20 to F22 and F24: damaged, forged, replayed and malformed datagrams."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import islice

from cloudrc.wire.records import GroundTruth
from cloudrc.wire.tunnel import codec
from tests.faults.flight import FaultRun
from tests.faults.inject import flipped
from tests.faults.measures import Outcome, epochs, scenario, told
from tests.faults.models import Tamper
from tests.faults.schedule import FaultEvent, Schedule, generator

FLOOD = 100  # datagrams of garbage per honest one: 10,000 in a second
SETTLED = 2.0
"""Time by which a new flight has its session, so that an old hello message cannot open one [s]."""


def _before(make: Callable[[bytes], Iterable[bytes]], since: float = 0.0) -> Tamper:
    """Return a function that adds hostile datagrams before each honest one, from `since` [s] on.

    `make` makes them from the honest one.
    """
    return lambda data, now_ns: [*make(data), data] if now_ns * 1e-9 >= since else [data]


def _check_no_effect(outcome: Outcome, flight: FaultRun, *reasons: str) -> None:
    """Fly with and without hostile datagrams; check that both flights are equal.

    `reasons` are names of world's counters that must rise.
    """
    clean = outcome.prepare().fly_mission()
    outcome.fly_safely(flight)
    outcome.true("the same path, bit by bit", clean.of(GroundTruth) == flight.of(GroundTruth))
    outcome.rejected(flight, *reasons)
    outcome.least("hostile datagrams", sum(map(flight.count, reasons)), 1000)
    outcome.true("hostile datagrams opened no session", epochs(clean) == epochs(flight))


@scenario(
    8,
    "corruption",
    injects="1 to 8 bits flip in 1 % of the datagrams, for 1 s in all of them",
    expects="corrupted datagrams are dropped",
)
def _corruption(outcome: Outcome) -> None:
    some = FaultEvent("corruption", 0.0, 120.0, 0.01)
    storm = FaultEvent("corruption", outcome.instant(), 1.0, 1.0)
    flight = outcome.fly(events=(some, storm))
    outcome.held_in_time(flight)
    outcome.least("corrupted datagrams", flight.count("tag"), 100)
    outcome.same("epochs opened", len(epochs(flight)), 2)


@scenario(
    20,
    "garbage-flood",
    injects="10,000 random datagrams per second arrive at world's port",
    expects="no effect: the same path, bit by bit",
)
def _flood(outcome: Outcome) -> None:
    """Send datagrams of random bytes.

    Two of three begin with a valid header: one of them is too short, one has the right length.
    """
    rng, flight = generator(outcome.seed, 20), outcome.prepare()

    def garbage(data: bytes) -> Iterable[bytes]:
        size, head = len(data), data[: codec.HEADER_SIZE]
        for n in range(FLOOD):
            noise = rng.bytes(size)
            yield (noise, head + noise[:32], head + noise[len(head) :])[n % 3]

    flight.world.tamper = _before(garbage)
    _check_no_effect(outcome, flight, "malformed", "tag")


@scenario(
    21,
    "old-session",
    injects="world and cloud get the captured datagrams of an earlier flight",
    expects="no effect: the same path, bit by bit",
)
def _old_session(outcome: Outcome) -> None:
    captured: list[bytes] = []
    first = FaultRun(Schedule(outcome.seed), life=7)

    def record(data: bytes, now_ns: int) -> list[bytes]:
        captured.append(data)
        return [data]

    first.world.tamper = first.cloud.tamper = record
    first.fly_mission()
    flight, to_world, to_cloud = outcome.prepare(), iter(captured), iter(captured)
    flight.world.tamper = _before(lambda data: islice(to_world, 6), SETTLED)
    flight.cloud.tamper = _before(lambda data: islice(to_cloud, 6), SETTLED)
    _check_no_effect(outcome, flight, "tag")
    left = [*to_world, *to_cloud]
    outcome.same("captured datagrams that were not sent", len(left), 0)


@scenario(
    22,
    "forged-command",
    injects="copies of datagrams with flipped bits, and with a much higher counter",
    expects="no effect: the same path, bit by bit",
)
def _forgery(outcome: Outcome) -> None:
    rng = generator(outcome.seed, 20)

    def forged(data: bytes) -> Iterable[bytes]:
        ahead = data[:8] + (2**63).to_bytes(8, "little") + data[16:]
        return [flipped(data, rng, 1), flipped(data, rng, 2), ahead]

    flight = outcome.prepare()
    flight.world.tamper = _before(forged)
    _check_no_effect(outcome, flight, "tag")


@scenario(
    24,
    "malformed",
    injects="empty, truncated, oversized datagrams and those of another version; a cloud of "
    "another version for 2 s",
    expects="dropped before any cryptography: the same path, bit by bit; no session between two "
    "versions",
)
def _malformed(outcome: Outcome) -> None:
    rng, newer = generator(outcome.seed, 20), bytes([codec.VERSION + 1])

    def strange(data: bytes) -> Iterable[bytes]:
        cut, oversized = int(rng.integers(0, len(data))), bytes(codec.DATAGRAM_MAX + 1)
        return [b"", data[:cut], data + b"\0", oversized, data[:1] * 2048, newer + data[1:]]

    flight = outcome.prepare()
    flight.world.tamper = _before(strange)
    _check_no_effect(outcome, flight, "malformed", "version")
    flight = outcome.prepare()
    flight.world.tamper = lambda data, now_ns: [newer + data[1:]]
    flight.fly(2.0)
    flight.world.tamper = None
    outcome.same("a cloud of another version: sessions", len(epochs(flight)), 0)
    outcome.fly_safely(flight)
    texts = [fault.text for fault in told(flight.of_world, "version")]
    text = f"peer speaks v{codec.VERSION + 1}, we speak v{codec.VERSION}"
    outcome.true(f"reported once: {text}", len(texts) == 1 and texts[0].startswith(text))
