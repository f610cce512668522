"""Faults F8, F20 to F22 and F24: damaged, forged, replayed and malformed datagrams, a flood."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import islice
from math import nan

from cloudrc.faults import measures
from cloudrc.faults.datagrams import Generator, HostileSender, check_no_effect, flipped, kind_of
from cloudrc.faults.flight import Flight
from cloudrc.faults.models import RestartableEndpoint, Tamper
from cloudrc.faults.scenario import Outcome, Scenario, generator
from cloudrc.records import Fault, SessionOpened
from cloudrc.tunnel import codec

FLOOD = 100
"""Datagrams of garbage per honest one: 10,000 in a second."""


def _corruption(seed: int) -> Outcome:
    """Flip one bit in 1 % of the datagrams, and for a second 1 % of all bits."""
    outcome, at, rng = Outcome(), measures.instant(seed), generator(seed, 8)
    flight = Flight(seed=seed)
    sender = HostileSender()

    def tamper(process: RestartableEndpoint) -> Tamper:
        def tampered(data: bytes, now_ns: int) -> list[bytes]:
            storm = at <= now_ns * 1e-9 < at + 1.0
            flips = int(rng.binomial(8 * len(data), 0.01)) if storm else int(rng.random() < 0.01)
            if not flips:
                return [data]
            sender.send(process, flipped(data, rng, flips), now_ns)
            return []

        return tampered

    flight.world.tamper, flight.cloud.tamper = tamper(flight.world), tamper(flight.cloud)
    flight.fly_mission()
    measures.safe_and_done(outcome, flight)
    measures.held_in_time(outcome, flight)
    metric = ("datagrams_total", "downlink", "tag")
    measures.moves(outcome, flight, "world", *metric, since=at)
    before, after = (  # world tells its counts once a second
        measures.reading("world", measures.seen_by(flight, "world", until), *metric)
        for until in (at, at + 2.0)
    )
    outcome.least(f"metric {' '.join(metric)} in two seconds from the worst on", after - before, 50)
    outcome.least("corrupted datagrams", sender.sent, 100)
    outcome.same("of them taken", sender.taken, 0)
    return outcome


def _flood(seed: int) -> Outcome:
    def garbage(end: RestartableEndpoint, data: bytes, rng: Generator) -> list[bytes]:
        size = len(data)
        block = rng.bytes(FLOOD * size)
        pieces = [block[at : at + size] for at in range(0, len(block), size)]
        head = data[: codec.HEADER_SIZE]
        return [
            # Noise; a right head before noise that is too short; one before as much as it takes.
            (piece, head + piece[:32], head + piece[len(head) :])[n % 3]
            for n, piece in enumerate(pieces)
        ]

    return check_no_effect(seed, garbage, "malformed", "tag")


def _forgery(seed: int) -> Outcome:
    """Send copies before each honest datagram, with a bit or the counter changed."""

    def forged(end: RestartableEndpoint, data: bytes, rng: Generator) -> list[bytes]:
        ahead = data[:8] + (2**63).to_bytes(8, "little") + data[16:]
        return [flipped(data, rng, 1), flipped(data, rng, 2), ahead]

    return check_no_effect(seed, forged, "tag")


def _malformed(seed: int) -> Outcome:
    def strange(end: RestartableEndpoint, data: bytes, rng: Generator) -> list[bytes]:
        longer = codec.DATAGRAM_MAX + 1
        cut = int(rng.integers(0, len(data)))
        other = bytes([data[0] + 1]) + data[1:]
        return [b"", data[:cut], data + b"\0", bytes(longer), data[:1] * 2048, other]

    outcome = check_no_effect(seed, strange, "malformed", "version")
    _another_version(outcome, seed)
    return outcome


def _another_version(outcome: Outcome, seed: int) -> None:
    """Let a cloud of the next version run for 2 s, then one of ours."""
    flight, newer = Flight(seed=seed), codec.VERSION + 1

    def tamper(data: bytes, now_ns: int) -> list[bytes]:
        return [bytes([newer]) + data[1:]] if now_ns * 1e-9 < 2.0 else [data]

    flight.world.tamper = tamper
    flight.fly(2.0)
    outcome.same("a cloud of another version: sessions", len(measures.epochs(flight)), 0)
    flight.fly_mission()
    measures.safe_and_done(outcome, flight)
    told = [r.text for r in flight.of_world if isinstance(r, Fault) and r.code == "version"]
    text = f"peer speaks v{newer}, we speak v{codec.VERSION}"
    outcome.true(f"it is told once: {text}", len(told) == 1 and told[0].startswith(text))


SETTLED = 2.0
"""Time at which a new flight has its session [s]; an answered greeting could open it earlier."""


def _old_session(seed: int) -> Outcome:
    """Record a whole flight, and replay it to both ends after their restart."""
    captured: list[bytes] = []
    first = Flight(seed=seed, life=7)

    def record(data: bytes, now_ns: int) -> list[bytes]:
        captured.append(data)
        return [data]

    first.world.tamper = first.cloud.tamper = record
    first.fly_mission()
    tapes: dict[RestartableEndpoint, Iterator[bytes]] = defaultdict(lambda: iter(captured))

    def replayed(end: RestartableEndpoint, data: bytes, rng: Generator) -> list[bytes]:
        return list(islice(tapes[end], 6))

    outcome = check_no_effect(seed, replayed, "tag", since=SETTLED, both=True)
    for end in tapes.values():
        outcome.same("captured datagrams that were not played to an end", len(list(end)), 0)
    _greet_again(outcome, seed, captured)
    return outcome


def _greet_again(outcome: Outcome, seed: int, captured: list[bytes]) -> None:
    """Replay the captured greetings while both ends greet each other."""
    clean, flight = Flight(seed=seed).fly(SETTLED), Flight(seed=seed)
    greetings = [data for data in captured if kind_of(data) <= codec.LAST_GREETING]
    kinds = {kind_of(data) for data in greetings}
    outcome.least("kinds of greeting captured: hello, challenge, accept", len(kinds), 3)

    def tamper(data: bytes, now_ns: int) -> list[bytes]:
        return [*greetings, data] if now_ns * 1e-9 < SETTLED else [data]

    flight.world.tamper = flight.cloud.tamper = tamper
    flight.fly_mission()
    measures.safe_and_done(outcome, flight)
    late = _opened_at(flight) - _opened_at(clean)
    outcome.most("amid captured greetings the session opens later by", late, 0.5, "s")
    outcome.true("and no other one", measures.epochs(flight) == measures.epochs(clean))


def _opened_at(flight: Flight) -> float:
    """Return when cloud got its first session [s]."""
    opened = [r.stamp_ns for r in flight.of_cloud if isinstance(r, SessionOpened)]
    return min(opened, default=nan) * 1e-9


SCENARIOS = (
    Scenario(
        8,
        "corruption",
        "1 % of the datagrams lose a bit; for 1 s, 1 % of all bits turn over",
        "corrupted datagrams are dropped",
        "those",
        "cloudrc_datagrams_total{outcome=tag}",
        _corruption,
    ),
    Scenario(
        20,
        "garbage-flood",
        "10,000 datagrams of garbage per second at the world's port",
        "no effect: the same path, bit by bit",
        "none",
        "cloudrc_datagrams_total{outcome=malformed}, {outcome=tag}",
        _flood,
    ),
    Scenario(
        22,
        "forged-command",
        "copies with bits turned over, and with a counter far ahead",
        "no effect: the same path, bit by bit",
        "none",
        "cloudrc_datagrams_total{outcome=tag}",
        _forgery,
    ),
    Scenario(
        24,
        "malformed",
        "empty, truncated, oversized datagrams and those of another version; a cloud of another "
        "version for 2 s",
        "dropped before any cryptography: the same path, bit by bit; no session with the other",
        "those",
        "fault 'version' with both numbers, cloudrc_datagrams_total{outcome=malformed}, "
        "{outcome=version}",
        _malformed,
    ),
    Scenario(
        21,
        "old-session",
        "a captured flight is played to both ends after their restart",
        "no effect: the same path, bit by bit",
        "none",
        "cloudrc_datagrams_total{outcome=tag}",
        _old_session,
    ),
)
