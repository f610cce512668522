"""Fly with the faults of one schedule in virtual time, and return the broken invariants.

An operator orders one mission after another, and acknowledges each landing and emergency stop. The
last part of the flight has no faults: the robot must then fly again, otherwise it counts as stuck.
This module injects all faults except those of the link; `cloudrc.faults.schedule.shaped` adds those
to the link's profile.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import islice
from math import inf, nan

import numpy as np

from cloudrc.drivers.virtual import Clock
from cloudrc.errors import describe_error
from cloudrc.faults.adversary import Lie, dishonesty
from cloudrc.faults.flight import SECRET, Flight
from cloudrc.faults.invariants import LATCHED, Breach
from cloudrc.faults.measures import events_of_missions, held
from cloudrc.faults.models import Action, Call, RestartableEndpoint, Tamper
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Event, Schedule, shaped
from cloudrc.messages import Command, GuardState
from cloudrc.records import Control, GuardChange, Record
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.wire import QUEUED
from cloudrc.tunnel.keys import Key, KeySet

INVARIANTS = {
    "collision": "collisions",
    "fence": "fence breaches",
    "cap": "cap breaches",
    "stop": "too fast towards the fence",
    "stale": "motion on stale commands",
    "rest": "motion long after the last command",
    "latch": "rotors on without an acknowledgement",
    "hold": "HOLDs that end too early or too late",
    "tick": "steps without the guard",
    "obeyed": "emergency stops without effect",
    "order": "commands applied out of order",
    "waypoint": "waypoints reached out of order, or twice",
    "stuck": "stuck states",
    "alarm": "false alarms",
    "error": "errors in world or cloud",
}
"""Name of an invariant -> name of its breaches in a table."""
BACK = 10.0  # time without faults in which the robot must have flown [s]
FORGETFUL = ("world_killed", "teleop_killed", "teleop_shut_down", "pod_killed", "pod_shut_down")
"""Faults that replace the robot or teleop, so that teleop may not know of an earlier stop."""
PATIENCE_NS = 1_000_000_000  # shortest time between two actions of the operator [ns]
CAPTURED = 2_000  # number of datagrams that an intruder keeps
NEXT_KEY = KeySet(Key(b"the next key of the fault suite!"), SECRET.current)
WRONG_KEY = KeySet(Key(b"a key that world has never read!"))
BUGS = ("values_invalid", "values_huge")  # faults of an honest cloud whose controller has a bug
IMPOSSIBLE = (nan, inf, -inf)


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a flight with a schedule of faults."""

    schedule: Schedule
    breaches: tuple[Breach, ...]  # the first ones of each kind
    sha256: str = ""  # hash of all records, if they were kept
    margin: float = 9.0  # smallest distance of the base to the fence's walls and ceiling [m]
    speed: float = 0.0  # largest reference [m/s]
    missions: int = 0  # number of completed missions

    @property
    def kinds(self) -> set[str]:
        """Names of the broken invariants, such as "fence"."""
        return {breach.kind for breach in self.breaches}


def fly(schedule: Schedule, *settings: str, keep: bool = False) -> Finding:
    """Fly with a schedule of faults, and with further `settings` of the experiment, as for `--set`.

    With `keep` the records are kept and hashed, which doubles the time.

    Raises:
        BadInputError: If the schedule names an unknown link profile, or an unknown policy of a
            dishonest cloud.
    """
    flight = _prepare(schedule, settings, keep)
    watch, operator = flight.watch, Operator(flight, schedule)
    inject(flight, schedule)
    try:
        flight.fly(schedule.duration)
    except Exception as error:  # world and cloud must survive every fault
        watch.note(flight.run.now_ns, "error", describe_error(error))
    checks: dict[str, Callable[[], None]] = {
        "waypoint": lambda: _check_waypoints(flight),
        "stuck": operator.check_stuck,
        "obeyed": operator.check_stops,
        "alarm": lambda: _check_alarms(flight),
    }
    for kind in [kind for kind in checks if kind in checked_in(schedule)]:
        checks[kind]()
    sha256, done = flight.sha256() if keep else "", len(flight.events("done"))
    return Finding(schedule, tuple(watch.breaches), sha256, watch.margin, watch.speed, done)


def checked_in(schedule: Schedule) -> frozenset[str]:
    """Return the invariants that a flight of this schedule must keep."""
    honest = not schedule.policy  # a dishonest cloud may touch things and end the mission
    recovers = honest and schedule.duration - schedule.quiet_from >= BACK
    is_stopped = bool(schedule.of("stopped")) and not schedule.of(*FORGETFUL)
    sometimes = {
        "collision": honest,
        "waypoint": honest,
        "stuck": recovers,
        "obeyed": recovers and is_stopped,
        "alarm": honest and not schedule.events,  # a HOLD, LAND or ESTOP without a fault
    }
    return frozenset(name for name in INVARIANTS if sometimes.get(name, True))


def _prepare(schedule: Schedule, settings: tuple[str, ...], keep: bool) -> Flight:
    has_own_clock = bool(schedule.cloud_offset or schedule.cloud_drift)
    offset_ns = round((schedule.cloud_offset + 1e6) * 1e9)
    clock = Clock(offset_ns, schedule.cloud_drift) if has_own_clock else Clock()
    lies, words = [], None
    if schedule.policy:
        lie, words = dishonesty(schedule)
        lies.append(lie)
    if schedule.of(*BUGS):
        lies.append(_bugs(schedule, clock))
    plans = ["guard.plan_max_s=0.8"] if "plans" in schedule.policy else []
    return Flight(
        *plans,
        f"link.profile={schedule.profile}",
        f"guard.hold_max_s={schedule.hold_max:g}",
        *settings,
        seed=schedule.seed,
        cloud_clock=clock if has_own_clock else None,
        uplink=lambda profile: shaped(schedule, profile, "up"),
        downlink=lambda profile: shaped(schedule, profile, "down"),
        honest=not schedule.policy,
        keep=keep,
        lies=lies,
        words=words,
        second=min((event.at for event in schedule.of("second_cloud")), default=None),
    )


class Operator:
    """Orders one mission after another, and acknowledges each landing and emergency stop."""

    def __init__(self, flight: Flight, schedule: Schedule) -> None:
        self._flight = flight
        self._next_ns, self._tracked_ns = 0, -1
        self._unmet_ns = [round(event.at * 1e9) for event in schedule.of("stopped")]
        flight.listeners.append(self._look)

    def check_stuck(self) -> None:
        """Report a breach if the guard was never in TRACK in the last `BACK` [s] (no faults)."""
        flight, now_ns = self._flight, self._flight.run.now_ns
        if now_ns - self._tracked_ns > BACK * 1e9:
            state, cause = flight.guard_now()
            mission = flight.mission.state if flight.teleop.missions else "none"
            text = f"not flown in {BACK:g} s of calm: guard {state.name} ({cause}), mission"
            flight.watch.note(now_ns, "stuck", f"{text} {mission}")

    def check_stops(self) -> None:
        """Check that each emergency stop of the operator led to ESTOP."""
        for at_ns in self._unmet_ns:
            text = f"the operator's stop at {at_ns * 1e-9:.2f} s has stopped nothing"
            self._flight.watch.note(self._flight.run.now_ns, "obeyed", text)

    def _look(self, records: list[Record], now_ns: int) -> None:
        flight = self._flight
        state, _ = flight.guard_now()
        if state is GuardState.TRACK:
            self._tracked_ns = now_ns
        changes = [record.state for record in records if isinstance(record, GuardChange)]
        if GuardState.ESTOP in (state, *changes):
            self._unmet_ns = [at_ns for at_ns in self._unmet_ns if at_ns > now_ns]
        service = flight.teleop.service
        if service is None or now_ns < self._next_ns or flight.cloud.inner is None:
            return
        # A restarted world is in GROUND without a change of state, so ask for the state.
        seen = service.state(flight.cloud.clock.at(now_ns))["seen"]
        is_over = not flight.teleop.missions or flight.mission.ended
        if seen is None or not (is_over or flight.mission.state == QUEUED):
            return
        self._next_ns = now_ns + PATIENCE_NS
        if seen["guard"] in [each.name for each in LATCHED]:
            flight.teleop.ask(MissionService.acknowledge)
        elif is_over:
            flight.order_if_possible(now_ns)


def _check_waypoints(flight: Flight) -> None:
    reached: dict[str, list[int]] = {}
    for event in events_of_missions(flight, "reached"):
        reached.setdefault(event["mission"], []).append(event["waypoint"])
    for mission, waypoints in reached.items():
        if waypoints != list(range(len(waypoints))):
            text = f"{mission} reached its waypoints as {waypoints}"
            flight.watch.note(flight.run.now_ns, "waypoint", text)


def _check_alarms(flight: Flight) -> None:
    latched = [change for change in flight.changes if change.state in LATCHED]
    for change in (*held(flight), *latched):
        text = f"{change.state.name} in a flight without faults: {change.cause}"
        flight.watch.note(change.stamp_ns, "alarm", text)


# Faults of processes, keys, datagrams, teleop and the operator.


def inject(flight: Flight, schedule: Schedule) -> None:
    """Schedule all faults of a flight except those of the link."""
    for event in schedule.events:
        process = flight.world if event.kind.startswith("world") else flight.cloud
        if event.kind.endswith("throttled"):
            process.throttle(event.at, event.duration, event.value)
        for time, action in _actions(flight, process, event).get(event.kind, ()):
            process.at(time, action)
    intrusions, rng = schedule.of("corruption", "garbage", "replay"), generator(schedule.seed, 41)
    for way, process in (("down", flight.world), ("up", flight.cloud)):
        if mine := [event for event in intrusions if event.way in ("both", way)]:
            process.tamper = _tamper(mine, rng)


def _actions(
    flight: Flight, process: RestartableEndpoint, event: Event
) -> dict[str, tuple[tuple[float, Action], ...]]:
    """Return how to inject `event`: kind of fault -> pairs of time [s] and action.

    The mapping is the same for all kinds of event; the caller selects the entry of the event's
    kind. `process`, world or cloud, is the one that the event kills or freezes.
    """
    at, lasts, end, teleop = event.at, event.duration, event.end, flight.teleop
    gone = at + event.value * lasts  # end of teleop after it was asked to end

    def ask(call: Call) -> Action:
        return lambda now_ns: teleop.ask(call)

    def read(end: str, keys: KeySet | None = None) -> Action:
        return lambda now_ns: flight.replace_key(end, keys or flight.secrets["world"])

    restart, freeze = partial(process.restart, down=lasts), partial(process.freeze, duration=lasts)
    pause = ask(MissionService.pause)
    return {
        **dict.fromkeys(("cloud_killed", "world_killed"), ((at, restart),)),
        **dict.fromkeys(("cloud_paused", "world_paused"), ((at, freeze),)),
        "pod_killed": ((at, partial(flight.restart_pod, down=lasts)),),
        "pod_shut_down": ((at, pause), (gone, partial(flight.restart_pod, down=end - gone))),
        "teleop_killed": ((at, teleop.kill), (end, teleop.start)),
        "teleop_shut_down": ((at, pause), (gone, teleop.kill), (end, teleop.start)),
        "teleop_paused": ((at, partial(teleop.freeze, duration=lasts)),),
        "second_cloud": ((end, lambda now_ns: flight.end_rival()),),
        "key_rotated": ((at, read("world", NEXT_KEY)), (end, read("cloud", NEXT_KEY))),
        "key_wrong": ((at, read("cloud", WRONG_KEY)), (end, read("cloud"))),
        "second_order": ((at, flight.order_if_possible),),
        "stopped": ((at, teleop.stop_rotors),),
        "held": ((at, ask(MissionService.hold)), (end, ask(MissionService.resume))),
    }


def _tamper(events: list[Event], rng: np.random.Generator) -> Tamper:
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


def _bugs(schedule: Schedule, clock: Clock) -> Lie:
    """Return a function that replaces some commands by commands with impossible values.

    While an event lasts, the function replaces `Event.value` commands per second.
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


def _ruined(command: Command, event: Event, rng: np.random.Generator) -> Command:
    """Return the command with one number replaced by NaN or infinity, or with a huge velocity."""
    if event.kind == "values_huge":
        x, y, z = rng.choice([1e308, -1e308], 3).tolist()
        return command._replace(velocity=(x, y, z))
    numbers = [*command.velocity, command.yaw_rate]
    numbers[int(rng.integers(4))] = IMPOSSIBLE[int(rng.integers(len(IMPOSSIBLE)))]
    x, y, z, yaw_rate = numbers
    return command._replace(velocity=(x, y, z), yaw_rate=yaw_rate)
