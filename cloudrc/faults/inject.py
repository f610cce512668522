"""The faults of a schedule are brought about: of the ends, the desk, the disks, the datagrams."""

from __future__ import annotations

from collections import deque
from itertools import islice

import numpy as np

from cloudrc import assembly
from cloudrc.cloud.teleop.api_bridge import Bridge, Call
from cloudrc.cloud.teleop.journal_format import MAGIC, parse, to_bytes
from cloudrc.cloud.teleop.service_book import ConflictError, UnavailableError
from cloudrc.cloud.teleop.service_mission import Order
from cloudrc.faults.family_intruder import flipped
from cloudrc.faults.flight import Flight
from cloudrc.faults.mortal import Mortal, Tamper
from cloudrc.faults.options import SECRET
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.faults.walls import Wall
from cloudrc.tunnel.keys import Key, KeySet

NEXT_KEY = KeySet(Key(b"the next key of a fuzzed flight!"), SECRET.current, 30.0)
CAPTURED = 2_000
FLOOD_PERIOD = 0.1
"""Between two bunches of requests [s]."""


def inject(flight: Flight, schedule: Schedule, wall: Wall) -> None:
    """Have everything happen but what is in the conditions of the link, and the recording's disk.

    Args:
        flight: That it befalls.
        schedule: What, and when.
        wall: The clock on it.
    """
    for event in schedule.events:
        if not _at_an_end(flight, event) and not _at_the_desk(flight, event):
            _around(flight, event, wall)
    _intrude(flight, schedule)


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
        world.at(event.at, lambda now_ns: flight.rotate("world", NEXT_KEY, now_ns))
        cloud.at(event.end, lambda now_ns: flight.rotate("cloud", NEXT_KEY, now_ns))
    elif event.kind == "wall_clock":
        world.at(event.at, lambda _: wall.step(event.value))


def _at_the_desk(flight: Flight, event: Event) -> bool:
    """Faults of teleop, its journal and its callers; say whether this is one."""
    cloud, desk = flight.cloud, flight.desk
    if event.kind == "teleop_killed":
        cloud.at(event.at, lambda _: desk.kill())
        cloud.at(event.end, lambda _: desk.start())
    elif event.kind == "journal_full":
        cloud.at(event.at, lambda _: setattr(desk, "refuse", _refuse))
        cloud.at(event.end, lambda _: setattr(desk, "refuse", None))
    elif event.kind in ("journal_torn", "journal_rotten"):
        cloud.at(event.at, lambda now_ns: _damage(flight, event, now_ns))
    elif event.kind == "api_flood":
        for n in range(int(event.duration / FLOOD_PERIOD) + 1):
            cloud.at(event.at + n * FLOOD_PERIOD, lambda now_ns: _flood(flight, event, now_ns))
    elif event.kind == "second_order":
        cloud.at(event.at, lambda now_ns: _order(flight, now_ns))
    elif event.kind == "held":
        cloud.at(event.at, lambda now_ns: _say(flight, "hold", now_ns))
        cloud.at(event.end, lambda now_ns: _say(flight, "resume", now_ns))
    else:
        return False
    return True


def _refuse() -> None:
    raise OSError(28, "No space left on device")


def _say(flight: Flight, verb: str, now_ns: int) -> None:
    try:
        if flight.desk.service is not None:
            getattr(flight.desk.service, verb)(flight.cloud.clock.at(now_ns))
    except ConflictError:
        return


def _order(flight: Flight, now_ns: int) -> None:
    try:
        if flight.desk.service is not None:
            flight.order(now_ns)
    except (ConflictError, UnavailableError):
        return


def _damage(flight: Flight, event: Event, now_ns: int) -> None:
    """The pod dies, and its journal is not what it was: torn at the end, or wrong in one bit."""
    flight.kill_cloud_pod(now_ns, event.duration)
    data = bytearray(to_bytes(flight.desk.entries))
    if event.kind == "journal_torn":
        del data[max(len(MAGIC), len(data) - int(event.value)) :]
    else:
        data[min(int(event.value * len(data)), len(data) - 1)] ^= 4
    flight.desk.entries = parse(bytes(data)).entries


def _flood(flight: Flight, event: Event, now_ns: int) -> None:
    """Many requests at once through the API's bridge: people who look, one who orders."""
    service = flight.desk.service
    if service is None:
        return
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
        call(flight.cloud.clock.at(now_ns))


def _intrude(flight: Flight, schedule: Schedule) -> None:
    """Damage, forge and replay datagrams on their way."""
    events = schedule.of("corruption", "garbage", "replay")
    if events:
        rng = generator(schedule.seed, 41)
        for way, end in (("down", flight.world), ("up", flight.cloud)):
            mine = [event for event in events if event.way in ("both", way)]
            if mine:
                end.tamper = _tamper(end, mine, rng)


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
