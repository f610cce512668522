"""Injects the faults of a schedule: of processes, keys, datagrams, teleop and the operator.

The faults of the link are in its conditions: see `cloudrc.faults.schedule.shaped`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from itertools import islice
from math import inf, nan

import numpy as np

from cloudrc.faults.adversary import Lie
from cloudrc.faults.datagrams import flipped
from cloudrc.faults.flight import SECRET, Flight
from cloudrc.faults.models import Call, Clock, SeparateTeleop, Tamper
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.messages import Command
from cloudrc.records import Control
from cloudrc.teleop.service import MissionService
from cloudrc.tunnel.keys import Key, KeySet

CAPTURED = 2_000
"""Number of datagrams that an intruder keeps."""
NEXT_KEY = KeySet(Key(b"the next key of the fault suite!"), SECRET.current)
WRONG_KEY = KeySet(Key(b"a key that world has never read!"))
BUGS = ("values_invalid", "values_huge")
"""Faults of an honest cloud whose controller has a bug."""
IMPOSSIBLE = (nan, inf, -inf)
HUGE = (1e308, -1e308)


def inject(flight: Flight, schedule: Schedule) -> None:
    """Schedule all faults on a flight."""
    for event in schedule.events:
        _inject_into_ends(flight, event)
        _inject_into_teleop(flight, event)
    intrusions, rng = schedule.of("corruption", "garbage", "replay"), generator(schedule.seed, 41)
    for way, process in (("down", flight.world), ("up", flight.cloud)):
        if mine := [event for event in intrusions if event.way in ("both", way)]:
            process.tamper = _tamper(mine, rng)


def _tamper(events: list[Event], rng: np.random.Generator) -> Tamper:
    captured: deque[bytes] = deque(maxlen=CAPTURED)

    def tamper(data: bytes, now_ns: int) -> list[bytes]:
        captured.append(data)
        now, hostile = now_ns * 1e-9, list[bytes]()
        for event in events:
            if not event.at <= now < event.end:
                continue
            if event.kind == "corruption":
                if rng.random() < event.value:
                    data = flipped(data, rng, int(rng.integers(1, 9)))
            elif event.kind == "garbage":
                hostile += [rng.bytes(int(rng.integers(0, 200))) for _ in range(int(event.value))]
            else:
                start = int(rng.integers(0, len(captured)))
                hostile += islice(captured, start, start + int(event.value))
        return [*hostile, data]

    return tamper


def _inject_into_ends(flight: Flight, event: Event) -> None:
    """Schedule a fault of world, cloud, their keys, or of another cloud."""
    at, lasts, cloud, world = event.at, event.duration, flight.cloud, flight.world
    match event.kind:
        case "cloud_killed":
            cloud.at(at, lambda now_ns: flight.kill_cloud(now_ns, lasts))
        case "pod_killed":
            cloud.at(at, lambda now_ns: flight.kill_cloud_pod(now_ns, lasts))
        case "cloud_paused":
            cloud.at(at, lambda now_ns: cloud.freeze(now_ns, lasts))
        case "cloud_throttled":
            cloud.throttle(at, lasts, event.value)
        case "world_killed":
            world.at(at, lambda now_ns: flight.kill_world(now_ns, lasts))
        case "world_paused":
            world.at(at, lambda now_ns: world.freeze(now_ns, lasts))
        case "world_throttled":
            world.throttle(at, lasts, event.value)
        case "second_cloud":
            cloud.at(event.end, lambda _: flight.end_rival())
        case "key_rotated":
            world.at(at, lambda _: flight.replace_key("world", NEXT_KEY))
            cloud.at(event.end, lambda _: flight.replace_key("cloud", NEXT_KEY))
        case "key_wrong":
            cloud.at(at, lambda _: flight.replace_key("cloud", WRONG_KEY))
            cloud.at(event.end, lambda _: flight.replace_key("cloud", flight.secrets["world"]))


def _inject_into_teleop(flight: Flight, event: Event) -> None:
    """Schedule a fault of teleop, or an action of the operator."""
    cloud, teleop = flight.cloud, flight.teleop

    def ask(call: Call) -> Callable[[int], None]:
        return lambda now_ns: teleop.ask(call, cloud.clock.at(now_ns))

    match event.kind:
        case "teleop_killed":
            cloud.at(event.at, lambda _: teleop.kill())
            cloud.at(event.end, lambda _: teleop.start())
        case "teleop_paused":
            assert isinstance(teleop, SeparateTeleop), "the flight of such a schedule has one"
            cloud.at(event.at, lambda now_ns: teleop.freeze(now_ns, event.duration))
        case "teleop_shut_down" | "pod_shut_down":
            _shut_down(flight, event)
        case "second_order":
            cloud.at(event.at, flight.order_if_possible)
        case "stopped":
            cloud.at(event.at, lambda now_ns: teleop.stop_rotors(cloud.clock.at(now_ns)))
        case "held":
            cloud.at(event.at, ask(MissionService.hold))
            cloud.at(event.end, ask(MissionService.resume))


def _shut_down(flight: Flight, event: Event) -> None:
    """Ask teleop to end, as SIGTERM does; it is gone after a share of the event's duration."""
    cloud, teleop, gone = flight.cloud, flight.teleop, event.at + event.value * event.duration
    cloud.at(event.at, lambda now_ns: teleop.shut_down(cloud.clock.at(now_ns)))
    if event.kind == "pod_shut_down":
        cloud.at(gone, lambda now_ns: flight.kill_cloud_pod(now_ns, event.end - gone))
    else:
        cloud.at(gone, lambda _: teleop.kill())
        cloud.at(event.end, lambda _: teleop.start())


def buggy(schedule: Schedule, clock: Clock) -> Lie:
    """Make the lie of a schedule's bugs: `value` impossible commands a second.

    Args:
        schedule: A schedule with bugs.
        clock: Cloud's clock, which stamps the commands.
    """
    rng = generator(schedule.seed, 43)
    events = schedule.of(*BUGS)
    due = [event.at for event in events]

    def lie(command: Command, control: Control) -> Command:
        now = clock.when(control.stamp_ns) * 1e-9
        for n, event in enumerate(events):
            if due[n] <= now < event.end:
                due[n] = now + 1.0 / max(event.value, 1e-3)
                command = _ruined(command, event, rng)
        return command

    return lie


def _ruined(command: Command, event: Event, rng: np.random.Generator) -> Command:
    """Make one of the four numbers not finite, or the velocity huge."""
    if event.kind == "values_huge":
        x, y, z = (HUGE[n] for n in rng.integers(0, len(HUGE), 3).tolist())
        return command._replace(velocity=(x, y, z))
    numbers = [*command.velocity, command.yaw_rate]
    numbers[int(rng.integers(4))] = IMPOSSIBLE[int(rng.integers(len(IMPOSSIBLE)))]
    x, y, z, yaw_rate = numbers
    return command._replace(velocity=(x, y, z), yaw_rate=yaw_rate)
