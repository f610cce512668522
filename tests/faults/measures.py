# SPDX-License-Identifier: Apache-2.0

"""Define a named fault, its checks and their result; measure flights for the checks."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from math import dist, hypot, isfinite, nan
from typing import Any, Literal, TypeAlias

from cloudrc.results.record.columns import Recording
from cloudrc.results.report.document import Run
from cloudrc.results.report.write import assess
from cloudrc.wire.messages import Cause, GuardState
from cloudrc.wire.records import (
    CommandApplied,
    Fault,
    GroundTruth,
    GuardChange,
    Record,
    SessionOpened,
)
from tests.faults.adversary import Lie
from tests.faults.flight import FaultRun
from tests.faults.schedule import Schedule, generator

Relation: TypeAlias = Literal["<=", ">=", "=="]
_COMPARE = {"<=": operator.le, ">=": operator.ge, "==": operator.eq}
YES = "yes"  # unit of a check that is a statement: its value is 1 if the statement holds, else 0
AGE_MAX = 0.252 + 1e-9
"""Largest age of the newest command's odometry when a HOLD begins [s]: the limit
guard.command_age_max_ms plus one step."""
STANDS = 0.05  # speed up to which the robot stands [m/s]
SAMPLE = 0.01  # time between two records of the ground truth [s]
WINDOW_NS = 1_000_000_000  # window in which changes of the guard are counted [ns]
ENDED = Cause.ENDED.words  # cause of a HOLD that the operator has requested


@dataclass(frozen=True, slots=True)
class Requirement:
    """One check of a reaction: compares `measured` with `limit`, both in `unit`."""

    text: str
    measured: float  # [any unit]
    relation: Relation
    limit: float  # [any unit]
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether `measured` complies with `limit`; False if it is not finite (not measured)."""
        return isfinite(self.measured) and bool(_COMPARE[self.relation](self.measured, self.limit))

    @property
    def shown(self) -> str:
        """The measured value beside its limit, such as "0.251 s (<= 0.252)"."""
        if self.unit == YES:
            return "yes" if self.measured else "NO"
        unit = f" {self.unit}" if self.unit else ""
        sign = "" if self.relation == "==" else f"{self.relation} "
        return f"{self.measured:.4g}{unit} ({sign}{self.limit:.4g})"

    def show(self) -> str:
        """Format the check on one line: its text, the measured value and the limit."""
        return f"{self.text}: {self.shown}"


@dataclass(slots=True)
class Outcome:
    """Result of a scenario: its checks in order."""

    checks: list[Requirement] = field(default_factory=list)
    sha256: str = ""  # hash of the records of all its flights
    seed: int = 1  # of all its flights

    def most(self, text: str, measured: float, limit: float, unit: str = "") -> None:
        """Check `measured` <= `limit`, both in `unit` [any unit]; `text` says what is measured."""
        self.checks.append(Requirement(text, measured, "<=", limit, unit))

    def least(self, text: str, measured: float, limit: float) -> None:
        """Check `measured` >= `limit`, both without a unit [1]; `text` says what is measured."""
        self.checks.append(Requirement(text, measured, ">=", limit))

    def same(self, text: str, measured: float, limit: float) -> None:
        """Check that `measured` equals `limit`, both counts [1]; `text` says what is counted."""
        self.checks.append(Requirement(text, measured, "==", limit))

    def true(self, text: str, holds: bool) -> None:
        """Check that the statement `text` is true; `holds` tells whether it is."""
        self.checks.append(Requirement(text, float(holds), "==", 1.0, YES))

    def instant(self, first: float = 4.0, last: float = 24.0) -> float:
        """Choose a time from `first` to `last` [s]; by default, the robot is among the tubes."""
        return generator(self.seed, 77).uniform(first, last)

    def prepare(self, *settings: str, lies: Sequence[Lie] = (), **faults: Any) -> FaultRun:
        """Prepare a flight with `faults`, the values of a `Schedule`; the rest is as there."""
        return FaultRun(Schedule(self.seed, **faults), *settings, lies=lies)

    def fly(self, *settings: str, limit: float = 120.0, **faults: Any) -> FaultRun:
        """Fly the mission, at most until `limit` [s]; check that it was safe and was completed."""
        return self.fly_safely(self.prepare(*settings, **faults), limit)

    def fly_safely(self, flight: FaultRun, limit: float = 120.0) -> FaultRun:
        """Fly the mission, at most until `limit` [s]; check that it was safe and was completed."""
        flight.fly_mission(limit)
        self.safe(flight)
        self.done(flight)
        return flight

    def safe(self, flight: FaultRun, excused: str = "") -> None:
        """Add whether the flight broke an invariant but `excused`, and the hash of its records."""
        breaches = [breach for breach in flight.breaches() if breach.kind != excused]
        self.same("breaches of an invariant", len(breaches), 0)
        for breach in breaches:
            self.true(f"{breach.kind} at {breach.time:.3f} s: {breach.text}", False)
        new = flight.sha256()
        both = f"{self.sha256} {new}".encode()
        self.sha256 = hashlib.sha256(both).hexdigest() if self.sha256 else new

    def done(self, flight: FaultRun) -> None:
        """Check that the mission was completed, with each waypoint reached once and in order."""
        self.true("mission done", flight.mission.state == "done")
        reached = [event.waypoint for event in flight.events("reached")]
        self.true("each waypoint reached once, in order", reached == list(range(len(reached))))

    def rejected(self, flight: FaultRun, *reasons: str) -> None:
        """Check that world has rejected at least one datagram or command for each reason."""
        for reason in reasons:
            self.least(f"rejected as {reason}", flight.count(reason), 1)

    def no_hold(self, flight: FaultRun, text: str = "HOLDs") -> None:
        """Check that the guard never changed to HOLD before the mission's end."""
        self.same(text, len(held(flight)), 0)

    def held_in_time(self, flight: FaultRun, text: str = "HOLD after") -> None:
        """Check that every HOLD began within one step after the last command became too old."""
        self.most(text, basis_age_at_hold(flight), AGE_MAX, "s")


Inject: TypeAlias = Callable[[Outcome], None]
"""Function that injects a fault into flights with the seed of an outcome, and adds checks."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault, how to inject it, and the reaction that the robot has to show."""

    number: int  # 13 for F13
    name: str  # such as cloud-killed
    injects: str
    expects: str  # what the robot does, and within what time
    inject: Inject

    @property
    def id(self) -> str:
        """Number of the fault with its letter, such as F13."""
        return f"F{self.number}"

    def run(self, seed: int) -> Outcome:
        """Inject the fault into flights with this seed, and measure how the robot reacts."""
        outcome = Outcome(seed=seed)
        self.inject(outcome)
        return outcome


def scenario(number: int, name: str, *, injects: str, expects: str) -> Callable[[Inject], Scenario]:
    """Decorate a function that injects a fault: convert it to a `Scenario` with these values."""
    return partial(Scenario, number, name, injects, expects)


# Measurements in a flight.


# The guard.


def changes_into(flight: FaultRun, state: GuardState) -> list[GuardChange]:
    """Return the guard's changes that lead to `state`, except the HOLD at a mission's end."""
    return [c for c in flight.changes if c.state is state and c.cause != ENDED]


def first_into(flight: FaultRun, state: GuardState, since: float = 0.0) -> float:
    """Return when the guard first changed to `state`, from `since` on [s]; NaN if it never did."""
    times = (change.stamp_ns * 1e-9 for change in changes_into(flight, state))
    return next((time for time in times if time >= since - 1e-9), nan)


def held(flight: FaultRun) -> list[GuardChange]:
    """Return the guard's changes to HOLD, without the HOLD at the end of a mission."""
    return changes_into(flight, GuardState.HOLD)


def basis_age_at_hold(flight: FaultRun) -> float:
    """Return the largest age that the commands' newest odometry had when a HOLD began [s]."""
    applied, ages = flight.of(CommandApplied), []
    for change in held(flight):
        before = [each.basis_stamp_ns for each in applied if each.stamp_ns <= change.stamp_ns]
        ages += [(change.stamp_ns - max(before)) * 1e-9] if before else []
    return max(ages, default=nan)


def busiest_second(changes: Sequence[GuardChange]) -> int:
    """Return the largest number of changes between TRACK and HOLD within one second."""
    flown = (GuardState.TRACK, GuardState.HOLD)
    times_ns = [b.stamp_ns for a, b in pairwise(changes) if a.state in flown and b.state in flown]
    return max((sum(t <= u < t + WINDOW_NS for u in times_ns) for t in times_ns), default=0)


# What the user is told.


def told(records: Iterable[Record], code: str) -> list[Fault]:
    """Return the `Fault` records with this code."""
    return [each for each in records if isinstance(each, Fault) and each.code == code]


def events_of_missions(flight: FaultRun, name: str) -> list[dict[str, Any]]:
    """Return the events called `name` in teleop's log; none if teleop does not run now."""
    service = flight.teleop.service
    events = service.book.events_after(0) if service is not None else []
    return [event for event in events if event["event"] == name]


# The path.


def calm_after(flight: FaultRun, start: float, end: float) -> float:
    """Return the time [s] from `start` [s] to the end of the robot's last motion before `end` [s].

    Return 0 if the robot did not move.
    """
    path = [(r.stamp_ns * 1e-9, hypot(*r.odometry.velocity)) for r in flight.of(GroundTruth)]
    fast = [time for time, speed in path if start <= time < end and speed >= STANDS]
    return fast[-1] + SAMPLE - start if fast else 0.0


def drift(flight: FaultRun, start: float, end: float) -> float:
    """Return the robot's largest distance [m] from its position at `start` [s], until `end` [s]."""
    path = [r.odometry for r in flight.of(GroundTruth) if start <= r.stamp_ns * 1e-9 <= end]
    return max((dist(path[0].position, each.position) for each in path), default=nan)


def number(flight: FaultRun, name: str) -> float:
    """Return a metric of the flight's report, in the metric's unit; NaN if there is none."""
    recording = Recording.from_records(flight.of_world, flight.of_cloud)
    numbers = assess(recording, flight.experiment, Run("virtual", "virtual")).numbers
    return numbers[name].value if name in numbers else nan


# Commands, sessions, missions.


def epochs(flight: FaultRun) -> list[int]:
    """Return the epochs of the sessions that world began, in order."""
    opened = flight.of(SessionOpened)
    return [record.epoch for record in opened if record.end == "world"]
