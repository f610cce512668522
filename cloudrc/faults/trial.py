"""Flies one schedule in virtual time, and returns the invariants that broke.

An operator flies one mission after the other, and acknowledges what is latched. In the calm at the
end the robot must fly again; otherwise it is stuck.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from cloudrc.faults.adversary import dishonesty
from cloudrc.faults.flight import Flight
from cloudrc.faults.injection import BUGS, buggy, inject
from cloudrc.faults.invariants import Breach
from cloudrc.faults.measures import events_of_missions, held
from cloudrc.faults.models import Clock
from cloudrc.faults.schedule import Schedule, shaped
from cloudrc.messages import GuardState
from cloudrc.records import CommandApplied, GuardChange, Record, SessionOpened
from cloudrc.teleop.service import LATCHED, MissionService
from cloudrc.teleop.store import QUEUED

BACK = 10.0
"""Time of calm in which the robot must have flown [s]."""
ALWAYS = ("fence", "cap", "stop", "stale", "rest", "latch", "hold", "tick", "order", "error")
"""Invariants that are checked in every flight."""
FORGETFUL = ("world_killed", "teleop_killed", "teleop_shut_down", "pod_killed", "pod_shut_down")
"""Faults after which there is another robot, or a teleop that need not know of a stop."""
PATIENCE_NS = 1_000_000_000
"""Shortest time between two actions of the operator [ns]."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a schedule.

    Attributes:
        schedule: The schedule.
        breaches: The invariants that broke first; none if all held.
        sha256: Hash of all records, if they were kept.
        margin: Smallest distance of the base to the fence's walls and ceiling [m].
        speed: Largest reference [m/s].
        holds: Number of HOLDs during a mission.
        missions: Number of missions that were done.
    """

    schedule: Schedule
    breaches: tuple[Breach, ...]
    sha256: str = ""
    margin: float = 9.0
    speed: float = 0.0
    holds: int = 0
    missions: int = 0

    @property
    def kinds(self) -> set[str]:
        """Kinds of the breaches."""
        return {breach.kind for breach in self.breaches}


def fly(schedule: Schedule, *settings: str, keep: bool = False) -> Finding:
    """Fly a schedule.

    Args:
        schedule: The schedule.
        settings: Changes of the experiment, as `--set` takes them.
        keep: Whether records are kept and hashed; this doubles the time.

    Raises:
        BadInputError: If there is no such profile or policy.
    """
    flight = _prepare(schedule, settings, keep)
    operator, order = Operator(flight, schedule), OrderInvariant(flight)
    inject(flight, schedule)
    try:
        flight.fly(schedule.duration)
    except Exception as error:  # an end has to survive whatever comes
        flight.watch.note(flight.run.now_ns, "error", f"{type(error).__name__}: {error}")
    checked = checked_in(schedule)
    if "waypoint" in checked:
        order.check_waypoints()
    if "stuck" in checked:
        operator.check_stuck()
    if "obeyed" in checked:
        operator.check_stops()
    if "alarm" in checked:
        _check_alarms(flight)
    watch = flight.watch
    return Finding(
        schedule,
        tuple(watch.breaches),
        flight.sha256() if keep else "",
        watch.margin,
        watch.speed,
        len(held(flight)),
        len(flight.events("done")),
    )


def _prepare(schedule: Schedule, settings: tuple[str, ...], keep: bool) -> Flight:
    has_own_clock = bool(schedule.cloud_offset or schedule.cloud_drift)
    clock = Clock(round((schedule.cloud_offset + 1e6) * 1e9), schedule.cloud_drift)
    clock = clock if has_own_clock else Clock()
    lies, words = [], None
    if schedule.policy:
        lie, words = dishonesty(schedule)
        lies.append(lie)
    if schedule.of(*BUGS):
        lies.append(buggy(schedule, clock))
    return Flight(
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
        separate=schedule.teleop_is_separate,
    )


def checked_in(schedule: Schedule) -> frozenset[str]:
    """Return the invariants that a schedule is checked for.

    With a dishonest cloud a contact is no breach, and nothing has to go on. A robot needs `BACK` of
    calm to recover. A HOLD, LAND or ESTOP is a false alarm if there are no faults. A stop must be
    obeyed by the robot that it was meant for, if teleop runs on.
    """
    kinds = set(ALWAYS)
    if not schedule.policy:
        kinds |= {"collision", "waypoint"}
        if schedule.duration - schedule.quiet_from >= BACK:
            kinds.add("stuck")
            if schedule.of("stopped") and not schedule.of(*FORGETFUL):
                kinds.add("obeyed")
        if not schedule.events:
            kinds.add("alarm")
    return frozenset(kinds)


class Operator:
    """Keeps ordering missions, and acknowledges what is latched."""

    def __init__(self, flight: Flight, schedule: Schedule) -> None:
        self._flight = flight
        self._next_ns, self._tracked_ns = 0, -1
        self._unmet_ns = [round(event.at * 1e9) for event in schedule.of("stopped")]
        flight.listeners.append(self._look)

    def check_stuck(self) -> None:
        """Check that the robot has flown in the calm at the end."""
        flight, now_ns = self._flight, self._flight.run.now_ns
        if now_ns - self._tracked_ns > BACK * 1e9:
            state, cause = flight.guard_now()
            mission = flight.mission.state if flight.teleop.missions else "none"
            text = f"not flown in {BACK:g} s of calm: guard {state.name} ({cause}), mission"
            flight.watch.note(now_ns, "stuck", f"{text} {mission}")

    def check_stops(self) -> None:
        """Check that each emergency stop has stopped the robot."""
        for at_ns in self._unmet_ns:
            text = f"the operator's stop at {at_ns * 1e-9:.2f} s has stopped nothing"
            self._flight.watch.note(self._flight.run.now_ns, "obeyed", text)

    def _look(self, records: list[Record], now_ns: int) -> None:
        """Look at the robot, every 100 ms."""
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
        # What the operator sees: a world that was restarted is in GROUND, and changes nothing.
        own_ns = flight.cloud.clock.at(now_ns)
        seen = service.state(own_ns)["seen"]
        is_over = not flight.teleop.missions or flight.mission.ended
        if seen is None or not (is_over or flight.mission.state == QUEUED):
            return
        self._next_ns = now_ns + PATIENCE_NS
        if seen["guard"] in [each.name for each in LATCHED]:
            flight.teleop.ask(MissionService.acknowledge, own_ns)
        elif is_over:
            flight.order_if_possible(now_ns)


class OrderInvariant:
    """Checks that commands are applied, and waypoints reached, once and in order."""

    def __init__(self, flight: Flight) -> None:
        self._flight = flight
        self._newest = (0, 0, -1)  # process of world, epoch and counter
        flight.listeners.append(self.see)

    def see(self, records: list[Record], now_ns: int) -> None:
        """Check that no command is older than one before, or of an epoch that has ended.

        A new process of world counts epochs on from what its cloud knows, which may be nothing.
        """
        for record in records:
            if isinstance(record, CommandApplied):
                self._check(record.epoch, record.counter, record.stamp_ns)
            elif isinstance(record, SessionOpened):
                self._check(record.epoch, -1, record.stamp_ns)

    def check_waypoints(self) -> None:
        """Check the waypoints of each mission in teleop's log."""
        reached: dict[str, list[int]] = {}
        for event in events_of_missions(self._flight, "reached"):
            reached.setdefault(event["mission"], []).append(event["waypoint"])
        for mission, waypoints in reached.items():
            if waypoints != list(range(len(waypoints))):
                text = f"{mission} reached its waypoints as {waypoints}"
                self._flight.watch.note(self._flight.run.now_ns, "waypoint", text)

    def _check(self, epoch: int, counter: int, stamp_ns: int) -> None:
        this = bisect_right(self._flight.world_starts_ns, stamp_ns), epoch, counter
        if this <= self._newest:
            text = f"command {counter} of epoch {epoch} after {self._newest[1:]}"
            self._flight.watch.note(stamp_ns, "order", text)
        self._newest = max(self._newest, this)


def _check_alarms(flight: Flight) -> None:
    latched = [change for change in flight.changes if change.state in LATCHED]
    for change in (*held(flight), *latched):
        text = f"{change.state.name} in a flight without faults: {change.cause}"
        flight.watch.note(change.stamp_ns, "alarm", text)
