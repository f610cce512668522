"""The faults of a schedule are brought about: of the ends, their keys, the desk, its journal.

What befalls datagrams on their way: damaged, forged and replayed ones, names that lead nowhere.

The conditions of the link itself are no part of it: see `cloudrc.faults.schedule.shaped`.
"""

from __future__ import annotations

import sqlite3
from collections import deque
from functools import partial
from itertools import islice

import numpy as np

from cloudrc import assembly
from cloudrc.faults.flight import SECRET, Flight
from cloudrc.faults.models import Apart, Mortal, Tamper
from cloudrc.faults.scenario import generator
from cloudrc.faults.scenarios.intruder import flipped
from cloudrc.faults.schedule import STALLS, Event, Schedule
from cloudrc.faults.walls import TAKE_OFF, Wall
from cloudrc.link.follow import PEER_PAUSE, PeerName
from cloudrc.teleop.bridge import Bridge, Call
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import Order, UnavailableError
from cloudrc.tunnel.keys import Key, KeySet

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


NEXT_KEY = KeySet(Key(b"the next key of a fuzzed flight!"), SECRET.current, 30.0)
WRONG_KEY = Key(b"a key that world has never read!")
FLOOD_PERIOD = 0.1
"""Between two bunches of requests [s]."""


def inject(flight: Flight, schedule: Schedule, wall: Wall) -> None:
    """Have everything happen but what is in the conditions of the link, and the recording's disk.

    Args:
        flight: That it befalls.
        schedule: What, and when.
        wall: The clock on it.
    """
    flight.wall = wall
    for event in schedule.events:
        if not _at_an_end(flight, event) and not _at_the_desk(flight, event):
            _around(flight, event, wall)
    waylay(flight, schedule)


def _at_an_end(flight: Flight, event: Event) -> bool:
    """Faults of world and cloud; say whether this is one."""
    at, lasts, cloud, world = event.at, event.duration, flight.cloud, flight.world
    if event.kind == "cloud_killed":
        cloud.at(at, lambda now_ns: flight.kill_cloud(now_ns, lasts))
    elif event.kind == "pod_killed":
        cloud.at(at, lambda now_ns: flight.kill_cloud_pod(now_ns, lasts))
    elif event.kind == "cloud_paused":
        cloud.at(at, lambda now_ns: cloud.freeze(now_ns, lasts))
    elif event.kind == "cloud_throttled":
        cloud.throttle(at, lasts, event.value)
    elif event.kind == "world_paused":
        world.at(at, lambda now_ns: world.freeze(now_ns, lasts))
    elif event.kind == "world_throttled":
        world.throttle(at, lasts, event.value)
    elif event.kind == "world_killed":
        world.at(at, lambda now_ns: flight.kill_world(now_ns, lasts))
    else:
        return False
    return True


def _around(flight: Flight, event: Event, wall: Wall) -> None:
    """Rivals, keys, and the clock on the wall."""
    cloud, world = flight.cloud, flight.world
    if event.kind == "second_cloud":
        cloud.at(event.end, lambda _: flight.send_rival_away())
    elif event.kind == "key_rotated":
        # Made by an operator whose clock is right; that of the ends may have been stepped.
        until = TAKE_OFF + event.at + NEXT_KEY.overlap
        keys = NEXT_KEY._replace(until=float(round(until)))
        world.at(event.at, lambda now_ns: flight.rotate("world", keys, now_ns))
        cloud.at(event.end, lambda now_ns: flight.rotate("cloud", keys, now_ns))
    elif event.kind == "key_wrong":
        wrong = KeySet(WRONG_KEY, None, event.value)
        cloud.at(event.at, lambda now_ns: flight.rotate("cloud", wrong, now_ns))
        # The right one is the one that world has read by then.
        cloud.at(event.end, lambda now_ns: flight.rotate("cloud", flight.secrets["world"], now_ns))
    elif event.kind == "wall_clock":
        world.at(event.at, lambda _: wall.step(event.value))


def _at_the_desk(flight: Flight, event: Event) -> bool:
    """Faults of teleop, its journal and its callers; say whether this is one."""
    cloud, desk = flight.cloud, flight.desk
    if event.kind == "teleop_killed":
        cloud.at(event.at, lambda _: desk.kill())
        cloud.at(event.end, lambda _: desk.start())
    elif event.kind in ("teleop_shut_down", "pod_shut_down"):
        _shut_down(flight, event)
    elif event.kind == "journal_full":
        cloud.at(event.at, lambda _: setattr(desk, "refuse", _refuse))
        cloud.at(event.end, lambda _: setattr(desk, "refuse", None))
    elif event.kind in ("journal_torn", "journal_rotten"):
        cloud.at(event.at, lambda now_ns: _damage(flight, event, now_ns))
    elif event.kind == "api_flood":
        call = partial(_flood, flight, event)
        for n in range(int(event.duration / FLOOD_PERIOD) + 1):
            cloud.at(event.at + n * FLOOD_PERIOD, lambda now_ns: _ask(flight, call, now_ns))
    elif event.kind == "second_order":
        cloud.at(event.at, flight.ask_for_mission)
    elif event.kind == "stopped":
        cloud.at(event.at, lambda now_ns: desk.stop_rotors(cloud.clock.at(now_ns)))
    elif event.kind == "held":
        cloud.at(event.at, lambda now_ns: _ask(flight, MissionService.hold, now_ns))
        cloud.at(event.end, lambda now_ns: _ask(flight, MissionService.resume, now_ns))
    elif event.kind in STALLS:
        _stall(flight, event)
    else:
        return False
    return True


def _shut_down(flight: Flight, event: Event) -> None:
    """SIGTERM: teleop holds what is flown and writes it down; a while later it is gone."""
    cloud, gone = flight.cloud, event.at + event.value * event.duration

    cloud.at(event.at, lambda now_ns: flight.desk.shut_down(cloud.clock.at(now_ns)))
    if event.kind == "pod_shut_down":
        cloud.at(gone, lambda now_ns: flight.kill_cloud_pod(now_ns, event.end - gone))
    else:
        cloud.at(gone, lambda _: flight.desk.kill())
        cloud.at(event.end, lambda _: flight.desk.start())


def _stall(flight: Flight, event: Event) -> None:
    """Teleop, a process of its own, stands still."""
    desk = flight.desk
    assert isinstance(desk, Apart), "the flight of such a schedule has one"
    if event.kind == "journal_slow":
        desk.slow.append(event)
    else:
        flight.cloud.at(event.at, lambda now_ns: desk.stop(now_ns, event.duration))


def _refuse() -> None:
    raise sqlite3.OperationalError("database or disk is full")


def _damage(flight: Flight, event: Event, now_ns: int) -> None:
    """The pod dies, and the last commit of its store is lost."""
    flight.kill_cloud_pod(now_ns, event.duration)
    flight.desk.image = flight.desk.image_before


def _ask(flight: Flight, call: Call, now_ns: int) -> None:
    flight.desk.ask(call, flight.cloud.clock.at(now_ns))


def _flood(flight: Flight, event: Event, service: MissionService, own_ns: int) -> None:
    """Many requests at once through the API's bridge: people who look, one who orders."""
    bridge, plan = Bridge(), assembly.build_plan(flight.experiment)
    bridge.open(service)
    calls: list[Call] = [
        lambda service, now_ns: service.state(now_ns),
        lambda service, now_ns: service.book.events_after(0),
        lambda service, now_ns: service.create(Order(plan, "flood"), now_ns),
    ]
    for n in range(int(event.value)):
        try:
            bridge.submit(calls[n % len(calls)])
        except UnavailableError:
            break
    for call in bridge.take():
        call(own_ns)
