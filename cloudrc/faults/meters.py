"""What the metrics of a flight's processes would show, and when they begin to move."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import nan

from cloudrc.exposition.live import Live
from cloudrc.exposition.parts import Histogram
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome
from cloudrc.records import Counted, Record

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
    live = Live(role)
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
    live = Live(role)
    live.see(records)
    shown = live.read()[f"cloudrc_{name}"]
    assert isinstance(shown, Histogram)
    counts = shown.cumulative()
    return counts[shown.bounds.index(bound)], counts[-1]


def shown(flight: Flight, role: str) -> dict[str, object]:
    """Read every metric that a process shows at the end of a flight; of a histogram its counts."""
    live = Live(role)
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
