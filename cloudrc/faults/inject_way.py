"""What befalls datagrams on their way: damaged, forged and replayed ones, names that lead nowhere.

The conditions of the link itself are no part of it: see `cloudrc.faults.schedule.shaped`.
"""

from __future__ import annotations

from collections import deque
from itertools import islice

import numpy as np

from cloudrc.faults.family_intruder import flipped
from cloudrc.faults.flight import Flight
from cloudrc.faults.mortal import Mortal, Tamper
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.link.follow import PEER_PAUSE, PeerName

CAPTURED = 2_000
"""Datagrams that an intruder keeps."""
ASKED = 4.0
"""After the last fault of the names, so long they are asked for [s]."""


def waylay(flight: Flight, schedule: Schedule) -> None:
    """Have everything happen to datagrams that a schedule says."""
    intrusions = schedule.of("corruption", "garbage", "replay")
    chance, pauses = generator(schedule.seed, 41), generator(schedule.seed, 42)
    for way, end in (("down", flight.world), ("up", flight.cloud)):
        mine = [event for event in intrusions if event.way in ("both", way)]
        tampers = [_tamper(end, mine, chance)] if mine else []
        lost = [event for event in schedule.of("names_lost") if event.way in ("both", way)]
        if lost:
            tampers.append(_follow(end, lost, pauses))
        if tampers:
            end.tamper = _one_after_the_other(tampers)


def _one_after_the_other(tampers: list[Tamper]) -> Tamper:
    def tamper(data: bytes, now_ns: int) -> list[bytes]:
        there = [data]
        for each in tampers:
            there = [left for one in there for left in each(one, now_ns)]
        return there

    return tamper


def _tamper(end: Mortal, events: list[Event], rng: np.random.Generator) -> Tamper:
    captured: deque[bytes] = deque(maxlen=CAPTURED)

    def tamper(data: bytes, now_ns: int) -> list[bytes]:
        captured.append(data)
        now, strange = now_ns * 1e-9, list[bytes]()
        for event in events:
            if not event.at <= now < event.end:
                continue
            if event.kind == "corruption":
                if rng.random() < event.value:
                    data = flipped(data, rng, int(rng.integers(1, 9)))
            elif event.kind == "garbage":
                strange += [rng.bytes(int(rng.integers(0, 200))) for _ in range(int(event.value))]
            else:
                start = int(rng.integers(0, len(captured)))
                strange += islice(captured, start, start + int(event.value))
        return [*strange, data]

    return tamper


def _follow(end: Mortal, events: list[Event], rng: np.random.Generator) -> Tamper:
    """What is sent to an end goes where its name led to when it was resolved last.

    Args:
        end: Moves to another address in each of the events.
        events: While they last, no name is resolved.
        rng: Chooses when the name is asked for.
    """
    moves = [event.at + event.value * event.duration for event in events]
    asked_ns, goes = [0], [""]

    def home(now: float) -> str:
        return f"10.0.0.{sum(moved <= now for moved in moves)}"

    def resolve(name: str) -> list[str]:
        now = asked_ns[0] * 1e-9
        if any(event.at <= now < event.end for event in events):
            raise OSError(-3, "Temporary failure in name resolution")
        return [home(now)]

    peer = PeerName(("peer", 7400), resolve, lambda line: None)

    def ask(now_ns: int) -> None:
        asked_ns[0] = now_ns
        goes[0] = (peer.poll() or ("", 0))[0]

    ask(0)
    until = max(event.end for event in events) + ASKED
    at = float(rng.uniform(*PEER_PAUSE))
    while at < until:
        end.at(at, ask)
        at += float(rng.uniform(*PEER_PAUSE))
    return lambda data, now_ns: [data] if goes[0] == home(now_ns * 1e-9) else []
