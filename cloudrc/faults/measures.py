"""Measure what happened in a flight, from its records and from the metrics of its processes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from math import dist, hypot, nan
from typing import Any

from cloudrc.exposition.live import LiveMetrics
from cloudrc.exposition.parts import Histogram
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, generator
from cloudrc.messages import Cause, GuardState
from cloudrc.record.columns import Recording
from cloudrc.records import (
    CommandApplied,
    Fault,
    GuardChange,
    Record,
    SessionOpened,
    TelemetrySent,
)
from cloudrc.report.document import Run
from cloudrc.report.write import assess
from cloudrc.teleop.service import NO_CLOUD, NOT_HEARD

AGE_MAX = 0.252 + 1e-9
"""When a HOLD begins, the odometry behind the newest command is at most this old [s]: the limit
guard.command_age_max_ms plus one tick."""
SOON = 5.0  # time within which a fault has to show in its metric [s]
STANDS = 0.05  # speed up to which the robot stands [m/s]
SAMPLE = 0.01  # time between two records of the ground truth [s]
WINDOW_NS = 1_000_000_000  # window in which changes of the guard are counted [ns]
ENDED = Cause.ENDED.words  # cause of a HOLD that the operator has requested


def instant(seed: int, first: float = 4.0, last: float = 24.0) -> float:
    """Choose a random time from `first` to `last` [s]; by default, a time among the pipes."""
    return float(generator(seed, 77).uniform(first, last))


# Metrics.


def seen_by(flight: Flight, role: str, until: float | None = None) -> list[Record]:
    """Return the records of `role`: world, cloud or teleop; up to the virtual time `until` [s]."""
    records: Iterable[Record] = flight.of_world if role == "world" else flight.of_cloud
    records = flight.teleop.events if role == "teleop" else records
    if until is None:
        return list(records)
    until_ns = (flight.world if role == "world" else flight.cloud).clock.at(round(until * 1e9))
    return [record for record in records if record.stamp_ns <= until_ns]


def reading(
    flight: Flight, role: str, name: str, *labels: str, until: float | None = None
) -> float:
    """Return a metric's value at `until` [s], for a histogram its mean; NaN if there is none."""
    shown = _read(flight, role, name, until)
    if isinstance(shown, Histogram):
        count = shown.cumulative()[-1]
        return shown.total / count if count else nan
    return float(shown.get(labels, nan))


def above(
    flight: Flight, role: str, name: str, bound: float, until: float | None = None
) -> tuple[int, float]:
    """Return number and share of a histogram's values above `bound`, at the time `until` [s]."""
    shown: Histogram = _read(flight, role, name, until)
    counts = shown.cumulative()
    count = counts[-1] - counts[shown.bounds.index(bound)]
    return count, count / counts[-1] if counts[-1] else nan


def _read(flight: Flight, role: str, name: str, until: float | None) -> Any:
    live = LiveMetrics(role)
    live.see(seen_by(flight, role, until))
    return live.read().get(f"cloudrc_{name}", {})


def moves(
    outcome: Outcome, flight: Flight, *metrics: str, since: float, over: float | None = None
) -> None:
    """Check that metrics change within 5 s after a fault that begins at `since` [s].

    If the fault ends at `over` [s], the 5 s begin at its end: a frozen process exports no metrics,
    and losses are known only when newer datagrams arrive. Each metric is written as role, name and
    labels, such as "world guard_transitions_total hold".
    """
    last = (since if over is None else over) + SOON
    end = "" if over is None else " of its end"
    for metric in metrics:
        role, *name = metric.split()
        before, after = (reading(flight, role, *name, until=each) for each in (since, last))
        moved = after == after and before != after  # a new metric counts as changed
        outcome.true(f"metric {' '.join(name)} moves within {SOON:g} s{end}", moved)


# The guard.


def changes_into(flight: Flight, state: GuardState) -> list[GuardChange]:
    """Return the guard's changes to a state, without the HOLD at the end of a mission."""
    return [c for c in flight.changes if c.state is state and c.cause != ENDED]


def first_into(flight: Flight, state: GuardState) -> float:
    """Return when the guard first changed to a state [s]; NaN if never."""
    return next((c.stamp_ns * 1e-9 for c in changes_into(flight, state)), nan)


def held(flight: Flight) -> list[GuardChange]:
    """Return the guard's changes to HOLD, without the HOLD at the end of a mission."""
    return changes_into(flight, GuardState.HOLD)


def held_in_time(outcome: Outcome, flight: Flight, text: str = "HOLD after") -> None:
    """Check that every HOLD began before the last command was too old."""
    outcome.most(text, basis_age_at_hold(flight), AGE_MAX, "s")


def basis_age_at_hold(flight: Flight) -> float:
    """Return the largest age that the last command's odometry had when a HOLD began [s]."""
    return max((age for _, age in _ages_at_hold(flight) if age == age), default=nan)


def _ages_at_hold(flight: Flight) -> list[tuple[GuardChange, float]]:
    """Return each HOLD with the age of the last command's odometry [s]; NaN without a command."""
    applied = [r for r in flight.of_world if isinstance(r, CommandApplied)]
    ages = []
    for change in held(flight):
        before = [r.basis_stamp_ns for r in applied if r.stamp_ns <= change.stamp_ns]
        ages.append((change, (change.stamp_ns - max(before)) * 1e-9 if before else nan))
    return ages


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
    """Return the faults with this code."""
    return [each for each in records if isinstance(each, Fault) and each.code == code]


def events_of_missions(flight: Flight, name: str) -> list[dict[str, Any]]:
    """Return the events with this name in teleop's log; none while teleop is not running."""
    service = flight.teleop.service
    events = service.book.events_after(0) if service is not None else []
    return [event for event in events if event["event"] == name]


def causes_told(outcome: Outcome, flight: Flight, what: str = "") -> None:
    """Check that records and telemetry state the cause of each HOLD and each TRACK.

    The text of each check begins with `what`.
    """
    ages, limit = _ages_at_hold(flight), flight.experiment.guard.command_age_max_ms * 1e-3
    texts = [(c.cause, f"command age {age:.3f} s above {limit:.3f} s") for c, age in ages]
    right = bool(texts) and all(cause == text for cause, text in texts)
    outcome.true(f"{what}each HOLD tells the age of its command, to 1 ms", right)
    changes = changes_into(flight, GuardState.TRACK)
    causes = [c.cause for c in changes if ages and c.stamp_ns > ages[0][0].stamp_ns]
    right = bool(causes) and all("fresh commands within" in cause for cause in causes)
    outcome.true(f"{what}each TRACK after it tells of fresh commands", right)
    sent = [r.telemetry for r in flight.of_world if isinstance(r, TelemetrySent)]
    shown = {telemetry.cause for telemetry in sent if telemetry.guard is GuardState.HOLD}
    right = Cause.SILENCE in shown <= {Cause.SILENCE, Cause.SESSION, Cause.ENDED}
    outcome.true(f"{what}so does telemetry: {Cause.SILENCE.words}", right)


def status(flight: Flight) -> dict[str, Any]:
    """Return teleop's present status, as its API shows it."""
    assert flight.teleop.service is not None
    return flight.teleop.service.state(flight.cloud.clock.at(flight.run.now_ns))


def silence_told(
    outcome: Outcome, flight: Flight, at: float, silent: float, what: str = "", *, cloud: bool
) -> None:
    """Check that teleop's status reports a silence that began at `at` [s], `silent` [s] before.

    The robot is silent. If `cloud` is false, cloud is silent, too. `what` begins each check's text.
    """

    def check(now_ns: int) -> None:
        shown = status(flight)
        seen, wrong = shown["seen"], abs(shown["seen"]["age_s"] - silent)
        outcome.most(f"{what}the status says for how long, off by", wrong, 0.2, "s")
        outcome.true(f"{what}it shows the guard's state as past", seen["guard_for_s"] is None)
        wrong = abs(shown["cloud_age_s"] - (0.0 if cloud else silent))
        outcome.most(f"{what}it says when cloud was heard last, off by", wrong, 0.25, "s")
        right = seen["next_step"] == (NOT_HEARD if cloud else NO_CLOUD)
        outcome.true(f"{what}its next step is to look after the one that is silent", right)

    flight.cloud.at(at + silent, check)


# The path.


def calm_after(flight: Flight, start: float, end: float) -> float:
    """Return the time from `start` [s] to the robot's last motion before `end` [s]; 0 if none."""
    path = [(r.stamp_ns * 1e-9, hypot(*r.odometry.velocity)) for r in flight.trajectory()]
    fast = [time for time, speed in path if start <= time < end and speed >= STANDS]
    return fast[-1] + SAMPLE - start if fast else 0.0


def drift(flight: Flight, start: float, end: float) -> float:
    """Return the robot's largest distance [m] from its position at `start` [s], until `end` [s]."""
    path = [r.odometry for r in flight.trajectory() if start <= r.stamp_ns * 1e-9 <= end]
    return max((dist(path[0].position, each.position) for each in path), default=nan)


def number(flight: Flight, name: str) -> float:
    """Return a metric of the flight's report [any unit]; NaN if it is unknown."""
    recording = Recording.from_records(flight.of_world, flight.of_cloud)
    numbers = assess(recording, flight.experiment, Run("virtual", "virtual")).numbers
    return numbers[name].value if name in numbers else nan


# Commands, sessions, missions.


def applied_in_order(flight: Flight) -> bool:
    """Return whether (epoch, counter) of the applied commands always rises."""
    order = [(r.epoch, r.counter) for r in flight.of_world if isinstance(r, CommandApplied)]
    return all(first < second for first, second in pairwise(order))


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
    """Fly the mission, at most until `limit` [s]; then check `safe` and `done`."""
    flight.fly_mission(limit)
    safe(outcome, flight)
    done(outcome, flight)
    return flight


def safe(outcome: Outcome, flight: Flight) -> None:
    """Check that there was no breach, and add the hash of the flight's records."""
    outcome.same("breaches of an invariant", flight.watch.counts.total(), 0)
    for breach in flight.watch.breaches:
        outcome.true(f"{breach.kind} at {breach.time:.3f} s: {breach.text}", False)
    outcome.flown(flight.sha256())
