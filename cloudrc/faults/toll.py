"""Hostile datagrams beside honest ones: each is counted, and nothing else may come of it.

The gate of teleop's API without a server: requests go in, what it has counted comes out.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np

from cloudrc.faults import asks
from cloudrc.faults import asks as meters
from cloudrc.faults.flight import Flight
from cloudrc.faults.models import Mortal, Tamper
from cloudrc.faults.scenario import Outcome, generator
from cloudrc.teleop.models import RefusedError
from cloudrc.teleop.store import ConflictError
from cloudrc.tunnel import codec
from cloudrc.tunnel.channel import USED

Generator: TypeAlias = np.random.Generator
REFUSED = ("tag", "malformed", "version", "direction", "old_epoch", "repeated")
"""What a hostile datagram is counted under."""
GREETED = ("hello", "unanswered", "accept_ignored")
"""What a captured greeting is counted under: a challenge is all it gets, if anything."""


class Toll:
    """Counts hostile datagrams, and those of them that were not refused for what they are."""

    def __init__(self) -> None:
        self.given = self.taken = 0

    def give(self, mortal: Mortal, data: bytes, now_ns: int) -> None:
        """Hand one to an end."""
        before, state = _refused(mortal), _state(mortal)
        mortal.receive_now(data, now_ns)
        self.given += 1
        # A challenge that nobody has asked for is not counted, nor answered.
        ignored = kind_of(data) == codec.Kind.CHALLENGE and _state(mortal) == state
        self.taken += not ignored and _refused(mortal) != before + 1


def _refused(mortal: Mortal) -> int:
    counts = mortal.inner._counts  # type: ignore[union-attr]
    return sum(counts.get(name, 0) for name in (*REFUSED, *GREETED))


def kind_of(data: bytes) -> int:
    """What a datagram says that it carries; 0 if it is too short for that."""
    return codec.peek(data)[0] if len(data) >= codec.HEADER_SIZE else 0


def _state(mortal: Mortal) -> tuple[int, int, int]:
    """What a datagram could change: the session, what is let through, what is answered."""
    inner: Any = mortal.inner
    return inner._session.epoch, inner._counts.get(USED, 0), len(inner._datagrams)


def unharmed(
    seed: int,
    hostile: Callable[[Mortal, bytes, Generator], list[bytes]],
    *refusals: str,
    since: float = 0.0,
    both: bool = False,
) -> Outcome:
    """Fly with hostile datagrams beside the honest ones: nothing may be any different.

    Args:
        seed: Of the flight.
        hostile: Gives those that come to an end before an honest one.
        refusals: What world has to count them under.
        since: From when on they come [s].
        both: Whether they come to cloud, too.
    """
    outcome, rng, toll = Outcome(), generator(seed, 20), Toll()
    clean, flight = Flight(seed=seed).fly_mission(), Flight(seed=seed)

    def tamper(mortal: Mortal) -> Tamper:
        def tampered(data: bytes, now_ns: int) -> list[bytes]:
            if now_ns * 1e-9 >= since:
                for strange in hostile(mortal, data, rng):
                    toll.give(mortal, strange, now_ns)
            return [data]

        return tampered

    flight.world.tamper = tamper(flight.world)
    if both:
        flight.cloud.tamper = tamper(flight.cloud)
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.true("the same path, bit by bit", asks.same_path(clean, flight))
    for refusal in refusals:
        labels = ("downlink", refusal)
        meters.moves(outcome, flight, "world", "datagrams_total", *labels, since=since)
    seen = [asks.metric(flight, "world", "datagrams_total", "downlink", each) for each in REFUSED]
    outcome.least("metric datagrams_total, refused", sum(n for n in seen if n == n), 900)
    outcome.least("hostile datagrams", toll.given, 1000)
    outcome.same("of them taken", toll.taken, 0)
    outcome.true("they opened no session", asks.epochs(clean) == asks.epochs(flight))
    return outcome


def counted(application: Any, method: str, path: str, count: int = 1) -> Counter[str]:
    """Ask so many times at once, as the robot's owner.

    Args:
        application: Behind the gate; it may wait for something that never comes.
        method: Of HTTP.
        path: What for.
        count: How often.
    """
    from cloudrc.teleop.auth import Gate  # needs FastAPI

    async def nothing(message: Any = None) -> Any:
        return {}

    gate = Gate(application, tokens=None)
    scope = {"type": "http", "method": method, "path": path, "headers": []}
    asked = [gate(dict(scope), nothing, nothing) for _ in range(count)]
    for asking in asked:
        with suppress(StopIteration):
            asking.send(None)
    counts = gate.counts.copy()
    for asking in asked:
        asking.close()
    return counts


def ordered(order: Callable[[], object]) -> Counter[str]:
    """Post one mission; what `order` raises becomes the status that the API gives it."""

    async def application(scope: Any, receive: Any, send: Any) -> None:
        status = 201
        try:
            order()
        except RefusedError:
            status = 422
        except ConflictError:
            status = 409
        await send({"type": "http.response.start", "status": status, "headers": []})

    return counted(application, "POST", "/v1/missions")
