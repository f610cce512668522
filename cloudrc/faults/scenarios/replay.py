"""A flight that was captured is played to both ends, which have been started anew meanwhile."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import islice
from math import nan

from cloudrc.faults import asks
from cloudrc.faults.flight import Flight
from cloudrc.faults.models import Mortal
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.faults.toll import Generator, kind_of, unharmed
from cloudrc.records import SessionOpened
from cloudrc.tunnel import codec

SETTLED = 2.0
"""When the session of a new flight stands [s]; a greeting that is answered could hasten it."""


def _old_session(seed: int) -> Outcome:
    """Record a whole flight; play it to a world and a cloud that have both been started anew."""
    captured: list[bytes] = []
    first = Flight(seed=seed, life=7)

    def record(data: bytes, now_ns: int) -> list[bytes]:
        captured.append(data)
        return [data]

    first.world.tamper = first.cloud.tamper = record
    first.fly_mission()
    tapes: dict[Mortal, Iterator[bytes]] = defaultdict(lambda: iter(captured))

    def replayed(end: Mortal, data: bytes, rng: Generator) -> list[bytes]:
        return list(islice(tapes[end], 6))

    outcome = unharmed(seed, replayed, "tag", since=SETTLED, both=True)
    for end in tapes.values():
        outcome.same("captured datagrams that were not played to an end", len(list(end)), 0)
    _greet_again(outcome, seed, captured)
    return outcome


def _greet_again(outcome: Outcome, seed: int, captured: list[bytes]) -> None:
    """Play the captured greetings to both ends while these are greeting each other."""
    clean, flight = Flight(seed=seed).fly(SETTLED), Flight(seed=seed)
    greetings = [data for data in captured if kind_of(data) <= codec.LAST_GREETING]
    kinds = {kind_of(data) for data in greetings}
    outcome.least("kinds of greeting captured: hello, challenge, accept", len(kinds), 3)

    def tamper(data: bytes, now_ns: int) -> list[bytes]:
        return [*greetings, data] if now_ns * 1e-9 < SETTLED else [data]

    flight.world.tamper = flight.cloud.tamper = tamper
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    late = _opened_at(flight) - _opened_at(clean)
    outcome.most("amid captured greetings the session opens later by", late, 0.5, "s")
    outcome.true("and no other one", asks.epochs(flight) == asks.epochs(clean))


def _opened_at(flight: Flight) -> float:
    """When cloud took its first session [s]."""
    opened = [r.stamp_ns for r in flight.of_cloud if isinstance(r, SessionOpened)]
    return min(opened, default=nan) * 1e-9


SCENARIOS = (
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
