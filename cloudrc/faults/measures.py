"""Measure a flight by its records."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from math import dist, hypot, nan
from typing import Any

from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, generator
from cloudrc.messages import Cause, GuardState
from cloudrc.record.columns import Recording
from cloudrc.records import CommandApplied, Fault, GuardChange, Record, SessionOpened
from cloudrc.report.document import Run
from cloudrc.report.write import assess

AGE_MAX = 0.252 + 1e-9
"""Largest age of the newest command's odometry when a HOLD begins [s]: the limit
guard.command_age_max_ms plus one step."""
STANDS = 0.05  # speed up to which the robot stands [m/s]
SAMPLE = 0.01  # time between two records of the ground truth [s]
WINDOW_NS = 1_000_000_000  # window in which changes of the guard are counted [ns]
ENDED = Cause.ENDED.words  # cause of a HOLD that the operator has requested


def instant(seed: int, first: float = 4.0, last: float = 24.0) -> float:
    """Choose a time from `first` to `last` [s]; by default, the robot is among the pipes then."""
    return float(generator(seed, 77).uniform(first, last))


def refused(outcome: Outcome, flight: Flight, *reasons: str) -> None:
    """Check that world has refused at least one datagram or command for each reason."""
    for reason in reasons:
        outcome.least(f"refused as {reason}", flight.count(reason), 1)


# The guard.


def changes_into(flight: Flight, state: GuardState) -> list[GuardChange]:
    """Return the guard's changes that lead to `state`, except the HOLD at a mission's end."""
    return [c for c in flight.changes if c.state is state and c.cause != ENDED]


def first_into(flight: Flight, state: GuardState) -> float:
    """Return when the guard first changed to `state` [s]; NaN if it never did."""
    return next((c.stamp_ns * 1e-9 for c in changes_into(flight, state)), nan)


def held(flight: Flight) -> list[GuardChange]:
    """Return the guard's changes to HOLD, without the HOLD at the end of a mission."""
    return changes_into(flight, GuardState.HOLD)


def held_in_time(outcome: Outcome, flight: Flight, text: str = "HOLD after") -> None:
    """Check that every HOLD began within one step after the last command became too old.

    `text` names the check in the outcome.
    """
    outcome.most(text, basis_age_at_hold(flight), AGE_MAX, "s")


def basis_age_at_hold(flight: Flight) -> float:
    """Return the largest age that the commands' newest odometry had when a HOLD began [s]."""
    applied = [(r.stamp_ns, r.basis_stamp_ns) for r in flight.of_world if type(r) is CommandApplied]
    ages = []
    for change in held(flight):
        before = [basis_ns for stamp_ns, basis_ns in applied if stamp_ns <= change.stamp_ns]
        ages += [(change.stamp_ns - max(before)) * 1e-9] if before else []
    return max(ages, default=nan)


def resumed_after(flight: Flight, back: float) -> float:
    """Return the time from `back` [s] until the guard next changed to TRACK [s]; NaN if never."""
    delays = [c.stamp_ns * 1e-9 - back for c in changes_into(flight, GuardState.TRACK)]
    return next((delay for delay in delays if delay >= -1e-9), nan)


def busiest_second(changes: Sequence[GuardChange]) -> int:
    """Return the largest number of changes between TRACK and HOLD within one second."""
    flown = (GuardState.TRACK, GuardState.HOLD)
    times_ns = [b.stamp_ns for a, b in pairwise(changes) if a.state in flown and b.state in flown]
    return max((sum(t <= u < t + WINDOW_NS for u in times_ns) for t in times_ns), default=0)


# What the user is told.


def told(records: Iterable[Record], code: str) -> list[Fault]:
    """Return the `Fault` records with this code."""
    return [each for each in records if isinstance(each, Fault) and each.code == code]


def events_of_missions(flight: Flight, name: str) -> list[dict[str, Any]]:
    """Return the events called `name` in teleop's log; none if teleop does not run now."""
    service = flight.teleop.service
    events = service.book.events_after(0) if service is not None else []
    return [event for event in events if event["event"] == name]


# The path.


def calm_after(flight: Flight, start: float, end: float) -> float:
    """Return the time [s] from `start` [s] to the end of the robot's last motion before `end` [s].

    Return 0 if the robot did not move.
    """
    path = [(r.stamp_ns * 1e-9, hypot(*r.odometry.velocity)) for r in flight.trajectory()]
    fast = [time for time, speed in path if start <= time < end and speed >= STANDS]
    return fast[-1] + SAMPLE - start if fast else 0.0


def drift(flight: Flight, start: float, end: float) -> float:
    """Return the robot's largest distance [m] from its position at `start` [s], until `end` [s]."""
    path = [r.odometry for r in flight.trajectory() if start <= r.stamp_ns * 1e-9 <= end]
    return max((dist(path[0].position, each.position) for each in path), default=nan)


def number(flight: Flight, name: str) -> float:
    """Return a metric of the flight's report, in the metric's unit; NaN if there is none."""
    recording = Recording.from_records(flight.of_world, flight.of_cloud)
    numbers = assess(recording, flight.experiment, Run("virtual", "virtual")).numbers
    return numbers[name].value if name in numbers else nan


# Commands, sessions, missions.


def epochs(flight: Flight) -> list[int]:
    """Return the epochs of the sessions that world began, in order."""
    opened = [r for r in flight.of_world if isinstance(r, SessionOpened)]
    return [record.epoch for record in opened if record.end == "world"]


def done(outcome: Outcome, flight: Flight) -> None:
    """Check that the mission was completed, with each waypoint reached once and in order."""
    outcome.true("mission done", flight.mission.state == "done")
    reached = [event.waypoint for event in flight.events("reached")]
    outcome.true("each waypoint reached once, in order", reached == list(range(len(reached))))


def fly_safely(outcome: Outcome, flight: Flight, limit: float = 120.0) -> Flight:
    """Fly the mission, at most until `limit` [s]; check that it was safe and was completed."""
    flight.fly_mission(limit)
    safe(outcome, flight)
    done(outcome, flight)
    return flight


def safe(outcome: Outcome, flight: Flight) -> None:
    """Add to `outcome`: whether the flight broke an invariant, and the hash of its records."""
    outcome.same("breaches of an invariant", flight.watch.counts.total(), 0)
    for breach in flight.watch.breaches:
        outcome.true(f"{breach.kind} at {breach.time:.3f} s: {breach.text}", False)
    outcome.flown(flight.sha256())
