"""Faults of names: what the peer is called leads nowhere for a while, then somewhere else."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cloudrc.faults import asks
from cloudrc.faults import asks as meters
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, Scenario, generator
from cloudrc.faults.scenarios.link import instant
from cloudrc.link.follow import PEER_PAUSE, PeerName
from cloudrc.records import Counted, Record


def _names(seed: int) -> Outcome:
    """The peer's name stops to be resolved, then has another address."""
    outcome, said, fails = Outcome(), list[str](), [False]
    addresses = [["10.0.0.7"]]

    def resolve(name: str) -> list[str]:
        if fails[0]:
            raise OSError(-3, "Temporary failure in name resolution")
        return addresses[0]

    peer = PeerName(("cloud", 7400), resolve, said.append)
    first = peer.poll()
    fails[0] = True
    kept = [peer.poll() for _ in range(30)]
    outcome.true("keeps the peer while DNS fails", set(kept) == {first})
    outcome.same("lines in the log about it", len(said) - 1, 1)
    outcome.true("it says so", "cannot be resolved" in said[-1])
    fails[0], addresses[0] = False, ["10.0.0.9"]
    outcome.true("follows the new address", peer.poll() == ("10.0.0.9", 7400))
    outcome.true("it says that too", "was 10.0.0.7" in said[-1])
    outcome.least("shortest pause that it is set to ask again after", PEER_PAUSE[0], 0.1, "s")
    outcome.most("longest pause that it is set to ask again after", PEER_PAUSE[1], 5.0, "s")
    _flown_without_names(outcome, seed)
    return outcome


def _flown_without_names(outcome: Outcome, seed: int) -> None:
    """Fly while no name is resolved; then the cloud moves, and only its name tells where to."""
    at = instant(seed, 2.0, 4.0)
    clean, flight = Flight(seed=seed).fly_mission(), Flight(seed=seed)
    told = _follow(flight, lambda now: "10.0.0.7", at, at + 30.0)
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    meters.moves_among(outcome, "link", told, "dns_errors_total", since=at)
    text = "no name is resolved for 30 s of flight: the same path, bit by bit"
    outcome.true(text, asks.same_path(clean, flight))
    moved, back = at + 5.0, at + 10.0
    flight = Flight("criteria.time_limit_s=120", seed=seed)
    _follow(flight, lambda now: "10.0.0.9" if now >= moved else "10.0.0.7", at, back)
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.least("cloud moves meanwhile: HOLDs", len(asks.held(flight)), 1)
    resumed = asks.resumed_after(flight, back)
    outcome.most("flown again after the name is", resumed, PEER_PAUSE[1] + 1.0, "s")


def _follow(
    flight: Flight, at_home: Callable[[float], str], since: float, until: float
) -> list[Record]:
    """What is sent to cloud goes where its name led to when it was resolved last.

    Args:
        flight: Which.
        at_home: Address of cloud at an instant [s].
        since: From when on no name is resolved [s].
        until: Until when [s].

    Returns:
        What the link tells its metrics of it; more is added while the flight goes on.
    """

    def resolve(name: str) -> list[str]:
        if since <= flight.now < until:
            raise OSError(-3, "Temporary failure in name resolution")
        return [at_home(flight.now)]

    peer, goes = PeerName(("cloud", 7400), resolve, lambda line: None), [""]
    told: list[Record] = []

    def ask(now_ns: int) -> None:
        goes[0] = (peer.poll() or ("", 0))[0]
        told.append(Counted(now_ns, "link", "unresolved", peer.failures))

    def deliver(data: bytes, now_ns: int) -> list[bytes]:
        return [data] if goes[0] == at_home(now_ns * 1e-9) else []

    ask(0)
    for at in np.cumsum(generator(flight.experiment.seed, 78).uniform(*PEER_PAUSE, 240)):
        flight.world.at(float(at), ask)
    flight.cloud.tamper = deliver
    return told


SCENARIOS = (
    Scenario(
        19,
        "dns-failure",
        "the peer's name is not resolved for 30 s, then has a new address",
        "keeps the last peer: the same path, bit by bit; follows the new one within 2 s",
        "none",
        "one line in the log of the link; cloudrc_dns_errors_total",
        _names,
    ),
)
