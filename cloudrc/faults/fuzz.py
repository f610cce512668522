"""One schedule in virtual time: it goes in, the invariants that broke come out.

An operator flies mission after mission: what has ended is followed by the next one, what is latched
is acknowledged. In the calm at the end the robot must be flying again, or it is stuck.

What may happen once only, and in its order: a command is flown, a waypoint is reached.

An honest cloud whose controller has a bug: now and then a command holds impossible numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, nan

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.faults.adversary import Lie, temptation, tempting
from cloudrc.faults.asks import held
from cloudrc.faults.flight import Flight, seen_now
from cloudrc.faults.inject import inject
from cloudrc.faults.invariants import Breach
from cloudrc.faults.models import Clock
from cloudrc.faults.remains import Remains
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Event, Schedule, shaped
from cloudrc.faults.toll import Generator
from cloudrc.faults.walls import steppable_wall_clock
from cloudrc.messages import Command, GuardState
from cloudrc.records import CommandApplied, Control, GuardChange, Record, SessionOpened
from cloudrc.teleop.service import LATCHED, MissionService
from cloudrc.teleop.store import QUEUED


class Once:
    """Listens to a flight through every life of its ends, and reads its journal."""

    def __init__(self, flight: Flight) -> None:
        """Listen from now on."""
        self._flight = flight
        self._newest = (0, -1)  # epoch and counter
        flight.listeners.append(self.hear)

    def hear(self, records: list[Record], now_ns: int) -> None:
        """Note a command [ns] that is older than one flown before, or of an epoch that is over."""
        for record in records:
            kind = type(record)
            if kind is CommandApplied:
                self._take(record.epoch, record.counter, record.stamp_ns)  # type: ignore[union-attr]
            elif kind is SessionOpened:
                self._take(record.epoch, -1, record.stamp_ns)  # type: ignore[union-attr]

    def judge(self) -> None:
        """Note a mission whose waypoints the journal has as reached twice, or out of order."""
        reached: dict[str, list[int]] = {}
        for entry in self._flight.desk.entries:
            if entry.get("event") == "reached":
                reached.setdefault(entry["mission"], []).append(entry["waypoint"])
        for mission, waypoints in reached.items():
            if waypoints != list(range(len(waypoints))):
                text = f"{mission} reached its waypoints as {waypoints}"
                self._flight.watch.note(self._flight.run.now_ns, "waypoint", text)

    def _take(self, epoch: int, counter: int, stamp_ns: int) -> None:
        if (epoch, counter) <= self._newest:
            text = f"command {counter} of epoch {epoch} after {self._newest}"
            self._flight.watch.note(stamp_ns, "order", text)
        self._newest = max(self._newest, (epoch, counter))


BUGS = ("values_invalid", "values_huge")
"""Kinds of faults that are one."""
IMPOSSIBLE = (nan, inf, -inf)
HUGE = (1e308, -1e308)


def buggy(schedule: Schedule, clock: Clock) -> Lie:
    """Make what a schedule's bugs turn commands into: one in each 1/value [s] of their whiles.

    Args:
        schedule: With the bugs.
        clock: Of cloud, which the stamps of commands are read on.
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


def _ruined(command: Command, event: Event, rng: Generator) -> Command:
    """One of the four numbers is not finite, or the velocity is huge."""
    if event.kind == "values_huge":
        x, y, z = (HUGE[n] for n in rng.integers(0, len(HUGE), 3).tolist())
        return command._replace(velocity=(x, y, z))
    numbers = [*command.velocity, command.yaw_rate]
    numbers[int(rng.integers(4))] = IMPOSSIBLE[int(rng.integers(len(IMPOSSIBLE)))]
    x, y, z, yaw_rate = numbers
    return command._replace(velocity=(x, y, z), yaw_rate=yaw_rate)


BACK = 10.0
"""In so long of calm the robot must have flown [s]."""
ALWAYS = frozenset(
    {"fence", "cap", "stop", "stale", "rest", "latch", "hold", "tick", "order", "error"}
)
"""Invariants that are looked at in every flight."""
FORGETFUL = (
    *("world_killed", "teleop_killed", "teleop_shut_down", "pod_killed", "pod_shut_down"),
    *("journal_torn", "journal_rotten"),
)
"""Kinds after which there is another robot, or a teleop that need not know of a stop."""
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
        fallen: How far outside the fence it came, its rotors stopped by the operator's word [m].
        thrown: Likewise, its rotors stopped by a hit [m].
        landed_on: What it touched when it landed or was stopped, the floor left out.
    """

    schedule: Schedule
    breaches: tuple[Breach, ...]
    sha256: str
    margin: float
    speed: float
    holds: int
    missions: int
    fallen: float = 0.0
    thrown: float = 0.0
    landed_on: frozenset[str] = frozenset()

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
    offset = schedule.cloud_offset or schedule.cloud_drift
    clock = Clock(round((schedule.cloud_offset + 1e6) * 1e9), schedule.cloud_drift)
    flight = Flight(
        f"link.profile={schedule.profile}",
        f"guard.hold_max_s={schedule.hold_max:g}",
        seed=schedule.seed,
        cloud_clock=clock if offset else None,
        uplink=lambda profile: shaped(schedule, profile, "up"),
        downlink=lambda profile: shaped(schedule, profile, "down"),
        honest=not schedule.policy,
        keep=keep,
        tempt=_tempt(schedule, clock if offset else Clock()),
        second=min((event.at for event in schedule.of("second_cloud")), default=None),
        apart=schedule.has_teleop_apart,
    )
    operator = Operator(flight, schedule)
    flight.listeners.append(operator.look)
    remains, once = Remains(flight, schedule), Once(flight)
    with steppable_wall_clock() as wall:
        inject(flight, schedule, wall)
        try:
            flight.fly(schedule.duration)
        except Exception as error:  # an end has to survive whatever comes
            flight.watch.note(flight.run.now_ns, "error", f"{type(error).__name__}: {error}")
    remains.judge()
    looked_at = judged(schedule)
    if "stuck" in looked_at:
        _ask_whether_stuck(flight, operator)
    if "waypoint" in looked_at:
        once.judge()
    if "obeyed" in looked_at:
        _ask_whether_stopped(flight, operator)
    if "alarm" in looked_at:
        _ask_for_alarms(flight)
    return _finding(flight, schedule, keep)


def _finding(flight: Flight, schedule: Schedule, keep: bool) -> Finding:
    watch = flight.watch
    return Finding(
        schedule,
        tuple(watch.breaches),
        flight.sha256() if keep else "",
        watch.margin,
        watch.speed,
        len(held(flight)),
        sum(event.event == "done" for event in flight.desk.events),
        watch.fallen,
        watch.thrown,
        frozenset(watch.landed_on),
    )


def _tempt(schedule: Schedule, clock: Clock) -> Callable[[CloudEndpoint], None]:
    """Make what turns a new cloud into that of a schedule: one that lies, or has a bug, or both."""
    changes = [temptation(schedule)] if schedule.policy else []
    if schedule.of(*BUGS):
        changes.append(tempting(buggy(schedule, clock)))

    def tempt(cloud: CloudEndpoint) -> None:
        for change in changes:
            change(cloud)

    return tempt


class Operator:
    """Keeps missions coming, and acknowledges what is latched.

    Attributes:
        tracked_ns: When the robot last flew commands [ns]; -1 if it never did.
        unmet_ns: When the operator made stops that were not seen to be obeyed [ns].
    """

    def __init__(self, flight: Flight, schedule: Schedule) -> None:
        self._flight = flight
        self._next_ns = 0
        self.tracked_ns = -1
        self.unmet_ns = [round(event.at * 1e9) for event in schedule.of("stopped")]

    def look(self, records: list[Record], now_ns: int) -> None:
        """Look at the robot, every 100 ms."""
        flight = self._flight
        state, _ = seen_now(flight.world.inner)
        if state is GuardState.TRACK:
            self.tracked_ns = now_ns
        changes = [record for record in records if isinstance(record, GuardChange)]
        if GuardState.ESTOP in (state, *(change.state for change in changes)):
            self.unmet_ns = [at_ns for at_ns in self.unmet_ns if at_ns > now_ns]
        service = flight.desk.service
        if service is None or now_ns < self._next_ns or flight.cloud.inner is None:
            return
        over = not flight.desk.missions or flight.mission.ended
        waits = not over and flight.mission.state == QUEUED
        if service.sight.seen is None or not (over or waits):
            return
        self._next_ns = now_ns + PATIENCE_NS
        # What the operator sees: a world that was restarted is in GROUND, and changes nothing.
        own_ns = flight.cloud.clock.at(now_ns)
        if service.state(own_ns)["seen"]["guard"] in [each.name for each in LATCHED]:
            flight.desk.ask(MissionService.acknowledge, own_ns)
        elif over:
            flight.ask_for_mission(now_ns)


def judged(schedule: Schedule) -> frozenset[str]:
    """Say which invariants a schedule is held to.

    Under a cloud that means no good a contact is no breach, and nobody has to get on; what goes
    wrong to the end leaves no time to find back; a HOLD, LAND or ESTOP is a false alarm where
    nothing goes wrong; what a damaged journal has lost may be written down again. A stop is asked
    again until it is obeyed, by a teleop that lives, of the robot that was there.
    """
    kinds = set(ALWAYS)
    if not schedule.policy:
        kinds.add("collision")
        if not schedule.of("journal_torn", "journal_rotten"):
            kinds.add("waypoint")
        if schedule.duration - schedule.quiet_from >= BACK:
            kinds.add("stuck")
            if schedule.of("stopped") and not schedule.of(*FORGETFUL):
                kinds.add("obeyed")
        if not schedule.events:
            kinds.add("alarm")
    if schedule.of(*Remains.KINDS):
        kinds.add("recording")
    return frozenset(kinds)


def _ask_whether_stuck(flight: Flight, operator: Operator) -> None:
    if flight.run.now_ns - operator.tracked_ns > BACK * 1e9:
        state, cause = seen_now(flight.world.inner)
        mission = flight.mission.state if flight.desk.missions else "none"
        text = f"not flown in {BACK:g} s of calm: guard {state.name} ({cause}), mission {mission}"
        flight.watch.note(flight.run.now_ns, "stuck", text)


def _ask_whether_stopped(flight: Flight, operator: Operator) -> None:
    """Whatever the link, the disk and the other processes do, the robot is stopped in the end."""
    for at_ns in operator.unmet_ns:
        text = f"the operator's stop at {at_ns * 1e-9:.2f} s has stopped nothing"
        flight.watch.note(flight.run.now_ns, "obeyed", text)


def _ask_for_alarms(flight: Flight) -> None:
    latched = [change for change in flight.changes if change.state in LATCHED]
    for change in (*held(flight), *latched):  # nothing has gone wrong
        text = f"{change.state.name} in a clean flight: {change.cause}"
        flight.watch.note(change.stamp_ns, "alarm", text)
