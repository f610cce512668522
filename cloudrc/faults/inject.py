"""The faults of a schedule are brought about: of the ends, their keys, the desk, its journal."""

from __future__ import annotations

from functools import partial

from cloudrc import assembly
from cloudrc.faults.desk_apart import Apart
from cloudrc.faults.flight import Flight
from cloudrc.faults.inject_way import waylay
from cloudrc.faults.options import SECRET
from cloudrc.faults.schedule import STALLS, Event, Schedule
from cloudrc.faults.walls import TAKE_OFF, Wall
from cloudrc.teleop.bridge import Bridge, Call
from cloudrc.teleop.journal import MAGIC, parse, to_bytes
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import Order, UnavailableError
from cloudrc.tunnel.keys import Key, KeySet

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
    raise OSError(28, "No space left on device")


def _damage(flight: Flight, event: Event, now_ns: int) -> None:
    """The pod dies, and its journal is not what it was: torn at the end, or wrong in one bit."""
    flight.kill_cloud_pod(now_ns, event.duration)
    data = bytearray(to_bytes(flight.desk.entries))
    if event.kind == "journal_torn":
        del data[max(len(MAGIC), len(data) - int(event.value)) :]
    else:
        data[min(int(event.value * len(data)), len(data) - 1)] ^= 4
    flight.desk.entries = parse(bytes(data)).entries


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
