# SPDX-License-Identifier: Apache-2.0

"""Inject the faults of a schedule into the link, into commands and into the parts of a flight."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from itertools import islice
from math import inf, nan
from typing import TYPE_CHECKING

import numpy as np

from cloudrc.flight.virtual.run import Clock
from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott
from cloudrc.teleop.service import MissionService
from cloudrc.wire.messages import Command
from cloudrc.wire.records import Control
from cloudrc.wire.tunnel.keys import Key, KeySet
from tests.faults.adversary import Lie
from tests.faults.models import Tamper
from tests.faults.schedule import FaultEvent, Schedule, generator

if TYPE_CHECKING:
    from tests.faults.flight import FaultRun

SECRET = KeySet(Key(b"a key of the fault suite, 32 b.."))
CAPTURED = 2_000  # number of datagrams that an intruder keeps
NEXT_KEY = KeySet(Key(b"the next key of the fault suite!"), SECRET.current)
WRONG_KEY = KeySet(Key(b"a key that world has never read!"))
BUGS = ("values_invalid", "values_huge")  # faults of an honest cloud whose controller has a bug
IMPOSSIBLE = (nan, inf, -inf)


def shaped(schedule: Schedule, profile: DirectionProfile, way: str) -> DirectionProfile:
    """Return the profile of one direction ("up" or "down") with the link faults of a schedule.

    Raises:
        ValueError: If both the profile and a fault change the conditions over time.
    """
    mine = [event for event in schedule.events if event.way in ("both", way)]
    lasting = [event for event in mine if event.kind == "blackout" and event.duration > 0.0]
    blackouts = [Blackout(start_s=one.at, duration_s=one.duration) for one in lasting]
    waves = [e for e in mine if e.kind in ("delay", "jitter", "loss", "bursts")]
    if waves and (profile.changes or profile.rows is not None):
        raise ValueError(
            f"the link's profile {schedule.profile} changes over time, so that the fault "
            f"{waves[0].kind} cannot be added; choose a profile without changes"
        )
    changes = _changes(profile, waves)
    return replace(
        profile,
        blackouts=(*profile.blackouts, *blackouts),
        changes=changes or profile.changes,
        duplicate=max(profile.duplicate, schedule.duplicate),
        reorder=max(profile.reorder, schedule.reorder),
    )


def _changes(profile: DirectionProfile, waves: list[FaultEvent]) -> tuple[Change, ...]:
    """Return the changes of a link in which each event of `waves` acts while it lasts."""
    edges = sorted({instant for event in waves for instant in (event.at, event.end)})
    return tuple(_change(profile, [e for e in waves if e.at <= t < e.end], t) for t in edges)


def _change(profile: DirectionProfile, active: list[FaultEvent], at: float) -> Change:
    """Return the link's conditions from `at` [s] on: the profile with the `active` faults."""
    delay_ms, jitter_ms, loss = profile.delay_ms, profile.jitter_ms, profile.loss
    for event in active:
        if event.kind == "delay":
            delay_ms += event.value * 1e3
        elif event.kind == "jitter":
            jitter_ms = max(jitter_ms, event.value * 1e3)
        elif event.kind == "loss":
            loss = event.value
        else:
            loss = GilbertElliott(bad_start=0.01, bad_end=1.0 / max(event.value, 1.0))
    return Change(at_s=at, delay_ms=delay_ms, jitter_ms=jitter_ms, loss=loss)


def inject(flight: FaultRun) -> None:
    """Schedule the faults of processes, keys, datagrams, teleop and the operator in a flight."""
    schedule = flight.schedule
    for event in schedule.events:
        _disturb_processes(flight, event)
        _use_keys_and_api(flight, event)
    intrusions, rng = schedule.of("corruption", "garbage", "replay"), generator(schedule.seed, 41)
    for way, process in (("down", flight.world), ("up", flight.cloud)):
        if mine := [event for event in intrusions if event.way in ("both", way)]:
            process.tamper = _tamper(mine, rng)


def order(flight: FaultRun) -> None:
    """Order the experiment's mission; teleop may not take the order."""
    mission = flight.make_order()
    flight.teleop.ask(lambda service, now_ns: service.create(mission, now_ns))


def _disturb_processes(flight: FaultRun, event: FaultEvent) -> None:
    """Schedule when a fault kills, stops or throttles processes, and when they run again."""
    process = flight.world if event.kind.startswith("world") else flight.cloud
    at, lasts, end, teleop = event.at, event.duration, event.end, flight.teleop
    gone = at + event.value * lasts  # end of teleop after it was asked to end

    def restart_pod(down: float) -> None:
        teleop.kill()
        process.restart(down)
        process.at(process.now_ns * 1e-9 + down, teleop.start)

    match event.kind:
        case "cloud_killed" | "world_killed":
            process.at(at, process.restart, lasts)
        case "cloud_paused" | "world_paused":
            process.at(at, process.freeze, lasts)
        case "cloud_throttled" | "world_throttled":
            process.throttle(at, lasts, event.value)
        case "pod_killed":
            process.at(at, restart_pod, lasts)
        case "pod_shut_down":
            process.at(at, teleop.ask, MissionService.pause)
            process.at(gone, restart_pod, end - gone)
        case "teleop_killed":
            process.at(at, teleop.kill)
            process.at(end, teleop.start)
        case "teleop_shut_down":
            process.at(at, teleop.ask, MissionService.pause)
            process.at(gone, teleop.kill)
            process.at(end, teleop.start)
        case "teleop_paused":
            process.at(at, teleop.freeze, lasts)


def _use_keys_and_api(flight: FaultRun, event: FaultEvent) -> None:
    """Schedule when ends read keys, the second cloud leaves, and the operator calls teleop."""
    cloud, teleop, at, end = flight.cloud, flight.teleop, event.at, event.end

    def read(end: str, keys: KeySet | None = None) -> None:
        flight.replace_key(end, keys or flight.secrets["world"])

    match event.kind:
        case "second_cloud":
            cloud.at(end, flight.end_rival)
        case "key_rotated":
            cloud.at(at, read, "world", NEXT_KEY)
            cloud.at(end, read, "cloud", NEXT_KEY)
        case "key_wrong":
            cloud.at(at, read, "cloud", WRONG_KEY)
            cloud.at(end, read, "cloud")
        case "second_order":
            cloud.at(at, order, flight)
        case "stopped":
            cloud.at(at, teleop.switch_off)
        case "held":
            cloud.at(at, teleop.ask, MissionService.hold)
            cloud.at(end, teleop.ask, MissionService.resume)


def _tamper(events: list[FaultEvent], rng: np.random.Generator) -> Tamper:
    captured: deque[bytes] = deque(maxlen=CAPTURED)

    def tamper(data: bytes, now_ns: int) -> list[bytes]:
        captured.append(data)
        hostile = list[bytes]()
        for event in events:
            if not event.at <= now_ns * 1e-9 < event.end:
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


def flipped(data: bytes, rng: np.random.Generator, flips: int) -> bytes:
    """Return a datagram with `flips` flipped bits."""
    bits = bytearray(data)
    for place in rng.choice(8 * len(data), min(flips, 8 * len(data)), replace=False).tolist():
        bits[place >> 3] ^= 1 << (place & 7)
    return bytes(bits)


def bugs(schedule: Schedule, clock: Clock) -> Lie:
    """Return a function that replaces some commands by commands with impossible values.

    While an event lasts, the function replaces `FaultEvent.value` commands per second.
    """
    rng, events = generator(schedule.seed, 43), schedule.of(*BUGS)
    due = [event.at for event in events]

    def lie(command: Command, control: Control) -> Command:
        now = clock.when(control.stamp_ns) * 1e-9
        for n, event in enumerate(events):
            if due[n] <= now < event.end:
                due[n] = now + 1.0 / max(event.value, 1e-3)
                command = _ruined(command, event, rng)
        return command

    return lie


def _ruined(command: Command, event: FaultEvent, rng: np.random.Generator) -> Command:
    """Return the command with one number replaced by NaN or infinity, or with a huge velocity."""
    if event.kind == "values_huge":
        x, y, z = rng.choice([1e308, -1e308], 3).tolist()
        return command._replace(velocity=(x, y, z))
    numbers = [*command.velocity, command.yaw_rate]
    numbers[int(rng.integers(4))] = IMPOSSIBLE[int(rng.integers(len(IMPOSSIBLE)))]
    x, y, z, yaw_rate = numbers
    return command._replace(velocity=(x, y, z), yaw_rate=yaw_rate)
