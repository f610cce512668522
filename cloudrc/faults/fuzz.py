"""One schedule in virtual time: it goes in, the invariants that broke come out.

An operator flies mission after mission: what has ended is followed by the next one, what is latched
is acknowledged. In the calm at the end the robot must be flying again, or it is stuck.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from itertools import islice

import numpy as np

from cloudrc.cloud.teleop.service_book import ConflictError, UnavailableError
from cloudrc.faults.adversary import temptation
from cloudrc.faults.family_intruder import flipped
from cloudrc.faults.flight import Flight
from cloudrc.faults.mortal import Clock, Mortal, Tamper
from cloudrc.faults.options import SECRET
from cloudrc.faults.schedule import Event, Schedule, shaped
from cloudrc.faults.watch import Breach
from cloudrc.messages import GuardState
from cloudrc.records import GuardChange, Record
from cloudrc.tunnel.keys import Key, KeySet

LATCHED = (GuardState.LAND, GuardState.ESTOP)
BACK = 10.0
"""In so long of calm the robot must have flown [s]."""
NEXT_KEY = KeySet(Key(b"the next key of a fuzzed flight!"), SECRET.current, 30.0)
CAPTURED = 2_000
PATIENCE_NS = 1_000_000_000
"""The operator does something at most this often [ns]."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What a schedule showed.

    Attributes:
        schedule: That was flown.
        breaches: The first invariants that broke; none if all held.
        sha256: Over all records, if they were kept.
        margin: Smallest distance of the base to the fence's walls and ceiling [m].
        speed: Largest speed that was let through [m/s].
        holds: How often the guard held although the mission was on.
        missions: How many missions were done.
    """

    schedule: Schedule
    breaches: tuple[Breach, ...]
    sha256: str
    margin: float
    speed: float
    holds: int
    missions: int

    @property
    def kinds(self) -> set[str]:
        """Of the breaches."""
        return {breach.kind for breach in self.breaches}


def fly(schedule: Schedule, *, keep: bool = False) -> Finding:
    """Fly a schedule.

    Args:
        schedule: What befalls the flight.
        keep: Whether records are kept and hashed; takes twice as long.
    """
    second = schedule.of("second_cloud")
    offset = schedule.cloud_offset or schedule.cloud_drift
    flight = Flight(
        f"link.profile={schedule.profile}",
        seed=schedule.seed,
        cloud_clock=Clock(round((schedule.cloud_offset + 1e6) * 1e9), schedule.cloud_drift)
        if offset
        else None,
        uplink=lambda profile: shaped(schedule, profile, "up"),
        downlink=lambda profile: shaped(schedule, profile, "down"),
        honest=not schedule.policy,
        keep=keep,
        tempt=temptation(schedule) if schedule.policy else None,
        second=second[0].at if second else None,
    )
    operator = Operator(flight)
    flight.listeners.append(operator.look)
    for event in schedule.events:
        _inject(flight, event)
    _intrude(flight, schedule)
    try:
        flight.fly(schedule.duration)
    except Exception as error:  # an end has to survive whatever comes
        flight.watch.note(flight.run.now_ns, "error", f"{type(error).__name__}: {error}")
    if not schedule.policy:
        _ask_whether_stuck(flight, schedule, operator)
    watch, holds = flight.watch, _holds(flight)
    if not (schedule.events or schedule.policy):
        for hold in holds:  # nothing has gone wrong
            watch.note(hold.stamp_ns, "alarm", f"HOLD in a clean flight: {hold.cause}")
    return Finding(
        schedule,
        tuple(watch.breaches),
        flight.sha256() if keep else "",
        watch.margin,
        watch.speed,
        len(holds),
        sum(event.event == "done" for event in flight.desk.events),
    )


def _holds(flight: Flight) -> list[GuardChange]:
    """HOLDs that are not a mission's end."""
    held = [change for change in flight.changes if change.state is GuardState.HOLD]
    return [change for change in held if change.cause != "mission ended"]


class Operator:
    """Keeps missions coming, and acknowledges what is latched."""

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self._next_ns = 0
        self.tracked_ns = -1

    def look(self, records: list[Record], now_ns: int) -> None:
        """Look at the robot, every 100 ms."""
        flight = self._flight
        state = flight.changes[-1].state if flight.changes else GuardState.GROUND
        if state is GuardState.TRACK:
            self.tracked_ns = now_ns
        service = flight.desk.service
        if service is None or now_ns < self._next_ns or flight.cloud.inner is None:
            return
        seen = service.seen
        if not seen or (flight.desk.missions and not flight.mission.ended):
            return
        self._next_ns = now_ns + PATIENCE_NS
        try:
            if state in LATCHED:
                service.acknowledge(flight.cloud.clock.at(now_ns))
            else:
                flight.order(now_ns)
        except (ConflictError, UnavailableError):
            return


def _ask_whether_stuck(flight: Flight, schedule: Schedule, operator: Operator) -> None:
    if schedule.duration - schedule.quiet_from < BACK:
        return
    if flight.run.now_ns - operator.tracked_ns > BACK * 1e9:
        change = flight.changes[-1] if flight.changes else None
        state = f"{change.state.name} ({change.cause})" if change else "GROUND"
        mission = flight.mission.state if flight.desk.missions else "none"
        text = f"not flown in {BACK:g} s of calm: guard {state}, mission {mission}"
        flight.watch.note(flight.run.now_ns, "stuck", text)


def _inject(flight: Flight, event: Event) -> None:
    """Have a fault of an end happen; those of the link are in its conditions."""
    at, lasts, cloud, world = event.at, event.duration, flight.cloud, flight.world
    desk = flight.desk
    if event.kind == "cloud_killed":
        cloud.at(at, lambda now_ns: flight.kill_cloud(now_ns, lasts))
    elif event.kind == "pod_killed":
        cloud.at(at, lambda now_ns: flight.kill_cloud_pod(now_ns, lasts))
    elif event.kind == "teleop_killed":
        cloud.at(at, lambda _: desk.kill())
        cloud.at(at + lasts, lambda _: desk.start())
    elif event.kind == "cloud_paused":
        cloud.at(at, lambda now_ns: cloud.freeze(now_ns, lasts))
    elif event.kind == "cloud_throttled":
        cloud.throttle(at, lasts, event.value)
    elif event.kind == "world_paused":
        world.at(at, lambda now_ns: world.freeze(now_ns, lasts))
    elif event.kind == "world_killed":
        world.at(at, lambda now_ns: flight.kill_world(now_ns, lasts))
    elif event.kind == "second_cloud":
        cloud.at(event.end, lambda _: flight.send_rival_away())
    elif event.kind == "key_rotated":
        world.at(at, lambda now_ns: flight.rotate("world", NEXT_KEY, now_ns))
        cloud.at(at + lasts, lambda now_ns: flight.rotate("cloud", NEXT_KEY, now_ns))
    else:
        _inject_at_desk(flight, event)


def _inject_at_desk(flight: Flight, event: Event) -> None:
    cloud, desk = flight.cloud, flight.desk

    def refuse() -> None:
        raise OSError(28, "No space left on device")

    def say(verb: str, now_ns: int) -> None:
        try:
            if desk.service is not None:
                own_ns = cloud.clock.at(now_ns)
                getattr(desk.service, verb)(own_ns)
        except ConflictError:
            return

    def order(now_ns: int) -> None:
        try:
            if desk.service is not None:
                flight.order(now_ns)
        except (ConflictError, UnavailableError):
            return

    if event.kind == "journal_full":
        cloud.at(event.at, lambda _: setattr(desk, "refuse", refuse))
        cloud.at(event.end, lambda _: setattr(desk, "refuse", None))
    elif event.kind == "second_order":
        cloud.at(event.at, order)
    elif event.kind == "held":
        cloud.at(event.at, lambda now_ns: say("hold", now_ns))
        cloud.at(event.end, lambda now_ns: say("resume", now_ns))


def _intrude(flight: Flight, schedule: Schedule) -> None:
    """Damage, forge and replay datagrams on their way."""
    events = schedule.of("corruption", "garbage", "replay")
    if events:
        rng = np.random.Generator(np.random.PCG64([schedule.seed, 41]))
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
