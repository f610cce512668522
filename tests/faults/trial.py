# SPDX-License-Identifier: Apache-2.0

"""Fly with the faults of one schedule in virtual time, and return the broken invariants.

An operator orders one mission after another, and acknowledges each landing and emergency stop. The
last part of the flight has no faults: the robot must then fly again, otherwise it counts as stuck.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cloudrc.base.errors import describe_error
from cloudrc.base.text import escape
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.wire import QUEUED
from tests.faults.flight import FaultRun
from tests.faults.inject import order
from tests.faults.invariants import FlightSteps
from tests.faults.measures import events_of_missions, held
from tests.faults.rules import ESTOP, LATCHED, TRACK, Breach
from tests.faults.schedule import Schedule

INVARIANTS = {
    "collision": "collisions",
    "fence": "fence breaches",
    "cap": "cap breaches",
    "stop": "too fast towards the fence",
    "stale": "motion on stale commands",
    "rest": "motion long after the last command",
    "latch": "on without an acknowledgement",
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


@dataclass(frozen=True, slots=True)
class TrialResult:
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

    def as_text(self) -> str:
        """Describe the breaches, one per line, and in the last line the result."""
        lines = [escape(f"{at.time:8.3f} s  {at.kind}: {at.text}") for at in self.breaches]
        word = "FAILED" if self.breaches else "passed"
        return "\n".join([*lines, f"{word}  records {self.sha256[:16]}"])


def fly(schedule: Schedule, *, hashed: bool = False) -> TrialResult:
    """Fly with a schedule of faults; `hashed` asks for the hash of all records.

    Raises:
        CloudrcError: If the schedule names an unknown link profile or policy.
        ValueError: If its faults do not fit the profile.
    """
    flight, found = FaultRun(schedule), list[Breach]()
    try:
        flight.fly(schedule.duration, TrialOperator(flight).act)
    except Exception as error:  # world and cloud must survive every fault
        found.append(Breach(flight.now, "error", describe_error(error)))
    wanted, steps = checked_in(schedule), flight.steps()
    found += [*flight.breaches(), *_unanswered(flight, steps)]
    found += [*_waypoints(flight), *_alarms(flight)]
    return TrialResult(
        schedule,
        tuple(breach for breach in sorted(found) if breach.kind in wanted),
        flight.sha256() if hashed else "",
        margin=min(each.smallest_margin for each in steps),
        speed=max(each.top_speed for each in steps),
        missions=len(flight.events("done")),
    )


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


class TrialOperator:
    """Orders one mission after another, and acknowledges each landing and emergency stop."""

    def __init__(self, flight: FaultRun) -> None:
        self._flight, self._next_ns = flight, 0

    def act(self) -> None:
        """Acknowledge a landing or a stop, or order the next mission."""
        flight, service = self._flight, self._flight.teleop.service
        now_ns = flight.run.now_ns
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
            order(flight)


def _unanswered(flight: FaultRun, steps: list[FlightSteps]) -> Iterator[Breach]:
    """Yield that the guard was not in TRACK for `BACK` [s], and stops without effect."""
    states = np.concatenate([each.rows.state for each in steps])
    times = np.concatenate([each.rows.now_ns for each in steps]) * 1e-9
    if TRACK not in states[times >= flight.now - BACK]:
        state, cause = flight.guard_now()
        mission = flight.mission.state if flight.teleop.missions else "none"
        text = f"not flown in {BACK:g} s of calm: guard {state.name} ({cause}), mission"
        yield Breach(flight.now, "stuck", f"{text} {mission}")
    for event in flight.schedule.of("stopped"):
        if ESTOP not in states[times >= event.at]:
            text = f"the operator's stop at {event.at:.2f} s has stopped nothing"
            yield Breach(flight.now, "obeyed", text)


def _waypoints(flight: FaultRun) -> Iterator[Breach]:
    reached: dict[str, list[int]] = {}
    for event in events_of_missions(flight, "reached"):
        reached.setdefault(event["mission"], []).append(event["waypoint"])
    for mission, waypoints in reached.items():
        if waypoints != list(range(len(waypoints))):
            text = f"{mission} reached its waypoints as {waypoints}"
            yield Breach(flight.now, "waypoint", text)


def _alarms(flight: FaultRun) -> Iterator[Breach]:
    latched = [change for change in flight.changes if change.state in LATCHED]
    for change in (*held(flight), *latched):
        text = f"{change.state.name} in a flight without faults: {change.cause}"
        yield Breach(change.stamp_ns * 1e-9, "alarm", text)
