"""Questions that many scenarios ask about a flight.

What the metrics of a flight's processes would show, and when they begin to move.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from math import dist, hypot, inf, nan
from typing import Any

from cloudrc.exposition.live import LiveMetrics
from cloudrc.exposition.parts import Histogram
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome
from cloudrc.messages import Cause, GuardState
from cloudrc.record.columns import Recording
from cloudrc.records import (
    CommandApplied,
    Counted,
    Fault,
    GuardChange,
    Record,
    SessionOpened,
    TelemetrySent,
)
from cloudrc.report.document import Run
from cloudrc.report.write import assess
from cloudrc.teleop.service import NO_CLOUD, NOT_HEARD

SOON = 5.0
"""By when a fault has to show in its metric [s]."""


def reading(role: str, records: Iterable[Record], name: str, *labels: str) -> float:
    """Read a metric [any unit] after some records; of a histogram the mean; NaN if it is absent.

    Args:
        role: Of the process: "world", "cloud" or "teleop".
        records: That it has seen, oldest first.
        name: Of the metric, without its prefix.
        labels: Values of its labels.
    """
    live = LiveMetrics(role)
    live.see(records)
    shown = live.read().get(f"cloudrc_{name}", {})
    if isinstance(shown, Histogram):
        count = shown.cumulative()[-1]
        return shown.total / count if count else nan
    return float(shown.get(labels, nan))


def share_within(role: str, records: Iterable[Record], name: str, bound: float) -> float:
    """Read which share [1] of a histogram is at most a bound of its buckets; NaN if it is empty.

    Args:
        role: Of the process.
        records: That it has seen, oldest first.
        name: Of the metric, without its prefix.
        bound: Of one of its buckets [unit of the metric].
    """
    within, values = _within(role, records, name, bound)
    return within / values if values else nan


def above(role: str, records: Iterable[Record], name: str, bound: float) -> int:
    """Read how many values of a histogram are above a bound of its buckets.

    Args:
        role: Of the process.
        records: That it has seen, oldest first.
        name: Of the metric, without its prefix.
        bound: Of one of its buckets [unit of the metric].
    """
    within, values = _within(role, records, name, bound)
    return values - within


def _within(role: str, records: Iterable[Record], name: str, bound: float) -> tuple[int, int]:
    """How many values of a histogram are at most a bound of its buckets, and how many there are."""
    live = LiveMetrics(role)
    live.see(records)
    shown = live.read()[f"cloudrc_{name}"]
    assert isinstance(shown, Histogram)
    counts = shown.cumulative()
    return counts[shown.bounds.index(bound)], counts[-1]


def shown(flight: Flight, role: str) -> dict[str, object]:
    """Read every metric that a process shows at the end of a flight; of a histogram its counts."""
    live = LiveMetrics(role)
    live.see(flight.of_world if role == "world" else flight.of_cloud)
    return {
        name: (each.total, each.cumulative()) if isinstance(each, Histogram) else each
        for name, each in live.read().items()
    }


def seen_by(flight: Flight, role: str, until: float) -> list[Record]:
    """List what a process has recorded.

    Args:
        flight: Which.
        role: Of the process.
        until: Instant of virtual time [s].
    """
    if role == "teleop":
        records: Iterable[Record] = flight.desk.events
    else:
        records = flight.of_world if role == "world" else flight.of_cloud
    clock = flight.world.clock if role == "world" else flight.cloud.clock
    until_ns = clock.at(round(until * 1e9))
    return [record for record in records if record.stamp_ns <= until_ns]


def moves(
    outcome: Outcome,
    flight: Flight,
    role: str,
    name: str,
    *labels: str,
    since: float,
    over: float | None = None,
) -> None:
    """Check that a metric reads otherwise within 5 s of a fault.

    Args:
        outcome: Of the scenario.
        flight: Which.
        role: Of the process that shows the metric.
        name: Of the metric, without its prefix.
        labels: Values of its labels.
        since: When the fault begins [s].
        over: When it ends [s], if that is what counts: who stands still shows nothing, and what is
            lost is known to be when newer things arrive.
    """
    last = since if over is None else over
    sights = [seen_by(flight, role, until) for until in (since, last + SOON)]
    _judge(outcome, role, sights, (name, *labels), "" if over is None else " of its end")


def moves_among(
    outcome: Outcome, role: str, records: Sequence[Record], name: str, *labels: str, since: float
) -> None:
    """Likewise of a process that is no end of the flight.

    Args:
        outcome: Of the scenario.
        role: Of the process that shows the metric.
        records: What it has told its metrics, stamped in virtual time.
        name: Of the metric, without its prefix.
        labels: Values of its labels.
        since: When the fault begins [s].
    """
    ends_ns = [round(until * 1e9) for until in (since, since + SOON)]
    sights = [[each for each in records if each.stamp_ns <= end_ns] for end_ns in ends_ns]
    _judge(outcome, role, sights, (name, *labels))


def _judge(
    outcome: Outcome,
    role: str,
    sights: Sequence[Sequence[Record]],
    metric: Sequence[str],
    end: str = "",
) -> None:
    """Compare a metric, its name and labels, after two lists of records, one longer than before."""
    before, after = (reading(role, seen, *metric) for seen in sights)
    moved = after == after and before != after  # absent before is as good as another value
    outcome.true(f"metric {' '.join(metric)} moves within {SOON:g} s{end}", moved)


def counts(outcome: Outcome, role: str, counted: str, total: int, name: str, *labels: str) -> None:
    """Check that what teleop's API or journal has counted shows in a metric, and is not zero.

    They are no part of a flight: its records do not tell of them, nor when they are told.

    Args:
        outcome: Of the scenario.
        role: Of the process.
        counted: Its own name for it.
        total: How often it has happened.
        name: Of the metric, without its prefix.
        labels: Values of its labels.
    """
    value = reading(role, [Counted(0, role, counted, total)], name, *labels)
    metric = " ".join((name, *labels))
    outcome.least(f"metric {metric} shows what was counted", value, 1)
    outcome.same(f"metric {metric}: shown too many or too few", value - total, 0)


OTHERS = ("rest", "latch", "hold", "order", "error")
"""Kinds of breach that no scenario asks for on its own."""
STANDS = 0.05
"""Below this speed the robot counts as standing [m/s]."""
WINDOW_NS = 1_000_000_000
"""In which transitions are counted [ns]."""
ALONE = "held for 60 s without the cloud"
"""The cause of a LAND that ends a long HOLD."""
ENDED = Cause.ENDED.words
"""The cause of a HOLD that the operator's end has asked for."""


def changes_into(flight: Flight, state: GuardState, before: float = inf) -> list[float]:
    """When the guard went into a state in a mission [s].

    Args:
        flight: Which.
        state: Of the guard.
        before: Only up to this instant [s].
    """
    changes = [c for c in flight.changes if c.state is state and c.cause != ENDED]
    return [at for change in changes if (at := change.stamp_ns * 1e-9) < before]


def held(flight: Flight) -> list[GuardChange]:
    """HOLDs that are not a mission's end."""
    held = [change for change in flight.changes if change.state is GuardState.HOLD]
    return [change for change in held if change.cause != ENDED]


def basis_age_at_hold(flight: Flight) -> float:
    """Largest age [s] that the newest applied command's basis had when the guard went to HOLD."""
    return max((age for _, age in _ages_at_hold(flight) if age == age), default=nan)


def _ages_at_hold(flight: Flight) -> list[tuple[GuardChange, float]]:
    """Every HOLD in a mission with that age [s]; NaN before the first command."""
    applied = [r for r in flight.of_world if isinstance(r, CommandApplied)]
    ages = []
    for change in held(flight):
        before = [r.basis_stamp_ns for r in applied if r.stamp_ns <= change.stamp_ns]
        age = (change.stamp_ns - max(before)) * 1e-9 if before else nan
        ages.append((change, age))
    return ages


def causes_told(outcome: Outcome, flight: Flight, what: str = "") -> None:
    """Check that the guard's changes tell why: how old the command was, and what ended the HOLD.

    Args:
        outcome: Of the scenario.
        flight: Which; it has to have held and gone on.
        what: Tells this flight of a scenario from its others.
    """
    ages, limit = _ages_at_hold(flight), flight.experiment.guard.command_age_max_ms * 1e-3
    told = [(c.cause, f"command age {age:.3f} s above {limit:.3f} s") for c, age in ages]
    text = f"{what}: " if what else ""
    right = bool(told) and all(cause == true for cause, true in told)
    outcome.true(f"{text}each HOLD tells the age of its command, to 1 ms", right)
    after = [c for c in flight.changes if ages and c.stamp_ns > ages[0][0].stamp_ns]
    causes = [change.cause for change in after if change.state is GuardState.TRACK]
    right = bool(causes) and all("fresh commands within" in cause for cause in causes)
    outcome.true(f"{text}each TRACK after it tells of fresh commands", right)
    shown = {cause for state, cause in _telemetered(flight) if state is GuardState.HOLD}
    right = Cause.SILENCE in shown <= {Cause.SILENCE, Cause.SESSION, Cause.ENDED}
    outcome.true(f"{text}so does telemetry: {Cause.SILENCE.words}", right)


def landing_told(outcome: Outcome, flight: Flight) -> None:
    """Check that guard and mission tell why the robot has landed: the cloud stayed away."""
    causes = [change.cause for change in flight.changes if change.state is GuardState.LAND]
    outcome.true(f"LAND tells why: {ALONE}", causes[:1] == [ALONE])
    failed, verdict = flight.mission.state == "failed", str(flight.mission.verdict)
    told = f"guard went to LAND ({Cause.ALONE.words})"
    outcome.true("the mission says why it failed", failed and told in verdict)
    assert flight.desk.service is not None
    seen = flight.desk.service.state(flight.run.now_ns)["seen"]
    right = (seen["guard"], seen["cause"]) == ("LAND", Cause.ALONE.words)
    outcome.true(f"the status says so, too: LAND, {Cause.ALONE.words}", right)


def told(records: Iterable[Record], code: str) -> list[Fault]:
    """Find what an end has told under a code."""
    return [each for each in records if isinstance(each, Fault) and each.code == code]


def look(flight: Flight, at: float) -> dict[str, Any]:
    """Ask teleop how things are, as its API shows it, at an instant [s]; the flight fills it in."""
    state: dict[str, Any] = {}

    def ask(now_ns: int) -> None:
        assert flight.desk.service is not None
        state.update(flight.desk.service.state(flight.cloud.clock.at(now_ns)))

    flight.cloud.at(at, ask)
    return state


def silence_told(
    outcome: Outcome, state: dict[str, Any], silent: float, *, cloud: bool, what: str
) -> None:
    """Check that the status in a silence shows no past as present, and tells who is silent.

    Args:
        outcome: Of the scenario.
        state: As it was shown.
        silent: How long the robot had not been heard, but for the way of the last telemetry [s].
        cloud: Whether cloud was to be heard.
        what: Tells this silence of a scenario from its others.
    """
    seen, cloud_age = state["seen"], state["cloud_age_s"]
    wrong = abs(seen["age_s"] - silent)
    outcome.most(f"{what}: the status says for how long, wrong by", wrong, 0.2, "s")
    outcome.true(f"{what}: it shows the guard's state as past", seen["guard_for_s"] is None)
    if cloud:
        outcome.most(f"{what}: it says that cloud was heard before", cloud_age, 0.25, "s")
    else:
        outcome.least(
            f"{what}: it says that cloud is silent, too, for", cloud_age, silent - 0.2, "s"
        )
    who = "the robot, not cloud" if cloud else "cloud"
    right = seen["next_step"] == (NOT_HEARD if cloud else NO_CLOUD)
    outcome.true(f"{what}: its next step is to look after {who}", right)


def _telemetered(flight: Flight) -> set[tuple[GuardState, Cause]]:
    """Which states of the guard, and why, has telemetry told."""
    sent = (r.telemetry for r in flight.of_world if isinstance(r, TelemetrySent))
    return {(telemetry.guard, telemetry.cause) for telemetry in sent}


def stopping_time(flight: Flight, since: float) -> float:
    """How long it takes until the robot is below 0.05 m/s and stays so for 0.2 s [s].

    Args:
        flight: Which.
        since: From when on [s].
    """
    slow_since = nan
    for record in flight.trajectory():
        now = record.stamp_ns * 1e-9
        if now < since:
            continue
        if hypot(*record.odometry.velocity) > STANDS:
            slow_since = nan
        elif slow_since != slow_since:
            slow_since = now
        elif now - slow_since >= 0.2:
            return slow_since - since
    return nan


def drift(flight: Flight, start: float, end: float) -> float:
    """Largest distance from where the robot was at first [m].

    Args:
        flight: Which.
        start: First instant [s].
        end: Last instant [s].
    """
    path = positions(flight, start, end)
    return max((dist(path[0], place) for place in path), default=nan) if path else nan


def positions(flight: Flight, start: float, end: float) -> list[tuple[float, float, float]]:
    """Where the base was [m], every 10 ms.

    Args:
        flight: Which.
        start: First instant [s].
        end: Last instant [s].
    """
    return [r.odometry.position for r in flight.trajectory() if start <= r.stamp_ns * 1e-9 <= end]


def resumed_after(flight: Flight, back: float) -> float:
    """How long it took until the guard was in TRACK again [s].

    Args:
        flight: Which.
        back: From when on [s].
    """
    times = [time for time in changes_into(flight, GuardState.TRACK) if time >= back - 1e-9]
    return times[0] - back if times else nan


def busiest_second(flight: Flight) -> int:
    """Most changes of the guard between TRACK and HOLD within any second."""
    flown = (GuardState.TRACK, GuardState.HOLD)
    changes = pairwise(flight.changes)
    times_ns = [b.stamp_ns for a, b in changes if a.state in flown and b.state in flown]
    return max((sum(t <= u < t + WINDOW_NS for u in times_ns) for t in times_ns), default=0)


def number(flight: Flight, name: str) -> float:
    """A number of the report [its unit is any unit]; NaN if it is not known."""
    recording = Recording.from_records(flight.of_world, flight.of_cloud)
    numbers = assess(recording, flight.experiment, Run("virtual", "virtual")).numbers
    return numbers[name].value if name in numbers else nan


def applied_in_order(flight: Flight) -> bool:
    """Whether the commands applied never step back in (epoch, counter), nor come twice."""
    order = [(r.epoch, r.counter) for r in flight.of_world if isinstance(r, CommandApplied)]
    return all(first < second for first, second in pairwise(order))


def waypoints_in_order(flight: Flight) -> bool:
    """Whether each waypoint was reached exactly once, in its order."""
    reached = [event.waypoint for event in flight.events("reached")]
    return reached == list(range(len(reached)))


def same_path(one: Flight, other: Flight) -> bool:
    """Whether two robots flew the very same way, bit by bit."""
    return one.trajectory() == other.trajectory()


def epochs(flight: Flight) -> list[int]:
    """Every epoch that world opened."""
    records = flight.of_world
    return [r.epoch for r in records if isinstance(r, SessionOpened) and r.end == "world"]


def safe(outcome: Outcome, flight: Flight) -> None:
    """Check the invariants, and take the run's hash over.

    Under a cloud that is not honest no contact is judged, and none is said to have been.
    """
    counts = flight.watch.counts
    breaches = counts["fence"] + counts["cap"] + counts["stop"]
    if flight.honest:
        outcome.same("collisions", counts["collision"], 0)
    outcome.same("breaches of the fence, a cap or the stop rule", breaches, 0)
    others = sum(counts[kind] for kind in OTHERS)
    outcome.same("breaches of what else the search judges in every flight", others, 0)
    outcome.same("ticks flown on stale commands", counts["stale"], 0)
    outcome.same("steps without the guard's tick", counts["tick"], 0)
    outcome.flown(flight.sha256())


def done(outcome: Outcome, flight: Flight) -> None:
    """Check that the mission was flown to its end, every waypoint once and in order."""
    outcome.true("mission done", flight.mission.state == "done")
    outcome.true("each waypoint reached once, in order", waypoints_in_order(flight))


def metric(flight: Flight, end: str, name: str, *labels: str) -> float:
    """What a process of an end would show of a metric at the end of the flight [any unit].

    Args:
        flight: Which.
        end: "world" or "cloud".
        name: Of the metric, without its prefix.
        labels: Values of its labels.
    """
    records = flight.of_world if end == "world" else flight.of_cloud
    return reading(end, records, name, *labels)
