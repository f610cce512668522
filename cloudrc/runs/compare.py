"""Compare two settings, A and B, by pairs of flights that differ in nothing else."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.metrics import SHIPPED
from cloudrc.rounding import differences
from cloudrc.runs import flight, store
from cloudrc.runs.experiment import load, refuse_seed
from cloudrc.runs.flight import Row, counts
from cloudrc.runs.workers import map_in_order, take_each
from cloudrc.statistics import LEVEL, exact_interval, holm, paired, sign_test
from cloudrc.text import unknown_name_text

NUMBERS = (
    *("prediction_error_rms", "tracking_error_p95", "iae_mean", "settling_time_mean"),
    *("unsettled_steps", "overshoot_mean", "delay_estimate_error_rms", "min_clearance"),
)
"""Metrics that are compared by default."""
METHOD = (
    "B - A: Hodges-Lehmann estimate, 95 % interval and p of the exact Wilcoxon signed-rank test, "
    "which assumes symmetric differences; p sign: the exact sign test, which does not; "
    "success: Clopper-Pearson intervals, p of the exact McNemar test"
)
LEFT_OUT = "a flight that did not end or whose plug-in failed"


class Pair(NamedTuple):
    """Two flights that differ in the compared setting only."""

    label: Mapping[str, Any]  # what both share, such as the seed
    a: Row
    b: Row


class Pairs(NamedTuple):
    """Pairs of flights, with the units of their metrics and a description of the comparison."""

    pairs: list[Pair]
    units: dict[str, str]  # metric -> unit
    what: str  # in words: the compared axis, the folder, and limits of the comparison


def split_settings(text: str) -> list[str]:
    """Split KEY=VALUE[,KEY=VALUE...] into settings KEY=VALUE.

    A comma separates settings only before KEY=, because a list may contain commas.
    """
    return re.split(r",(?=[\w.]+=)", text)


def load_sides(
    experiment: str,
    common: Sequence[str],
    a: Sequence[str],
    b: Sequence[str],
    names: Sequence[str] = (),
) -> tuple[tuple[ResolvedExperiment, ResolvedExperiment], dict[str, str]]:
    """Load an experiment with the settings `a` and with the settings `b`, both after `common`.

    Also return metric -> unit. `names` are metrics that will be compared.

    Raises:
        BadInputError: If a setting, the seed among them, or a metric is refused, or if the
            settings give the same experiment.
    """
    for each in (a, b):
        refuse_seed([*common, *each])
    first, second = (load(experiment, [*common, *each]) for each in (a, b))
    if first == second:
        raise BadInputError("A and B are the same experiment; change one of them")
    unit_of = flight.units({*first.report.metrics, *second.report.metrics})
    check_names(names, unit_of)
    return (first, second), unit_of


def fly_pairs(
    sides: Sequence[ResolvedExperiment],
    seeds: int,
    jobs: int,
    see: Callable[[Row], None] = lambda row: None,
) -> tuple[list[Pair], CloudrcError | None]:
    """Fly both sides with the seeds 1 to `seeds` in `jobs` processes.

    Call `see` with each row; its key is "A" or "B". Return the pairs of flights, and why the work
    ended early, or None.
    """
    work = [side.model_copy(update={"seed": n + 1}) for n in range(seeds) for side in sides]
    flights: list[Row] = []

    def take(row: Row) -> None:
        flights.append(row)
        see({"key": "BA"[len(flights) % 2], **row})

    stopped = take_each(map_in_order(flight.fly_point, work, jobs), take)
    both = zip(flights[::2], flights[1::2], strict=False)
    return [Pair({"seed": n}, a, b) for n, (a, b) in enumerate(both, start=1)], stopped


def compare(
    pairs: Sequence[Pair], units: Mapping[str, str], names: Sequence[str] = ()
) -> dict[str, Any]:
    """Evaluate success and the metrics `names` (default: `NUMBERS`); return a JSON document.

    A pair is left out if one of its flights did not end or had a plug-in that failed. Where one
    flight of a pair lacks a metric, the pair is left out for this metric. `units`: metric -> unit.

    Raises:
        BadInputError: If all pairs are left out, or if no flight can have a metric of `names`.
    """
    flown = _valid(pairs)
    known = {n for _, a, b in flown for n in a["numbers"].keys() | b["numbers"].keys()}
    if not {*names} <= {*units, *SHIPPED}:
        check_names(names, known)
    chosen = names or [name for name in NUMBERS if name in known]
    lacking = {name: _lacking(flown, name) for name in chosen}
    success, numbers = (
        compare_success(flown),
        {
            name: compare_number(flown, name, units[name])
            for name in chosen
            if lacking[name]["left_out"] < len(flown)
        },
    )
    adjust([success, *numbers.values()])
    return {
        "pairs": len(flown),
        "left_out": len(pairs) - len(flown),
        "success": success,
        "numbers": numbers,
        "lacking": {name: each for name, each in lacking.items() if each["left_out"]},
        "method": METHOD,
        "flights": [
            {**label, "a": _flight(a, chosen), "b": _flight(b, chosen)} for label, a, b in pairs
        ],
    }


def _valid(pairs: Sequence[Pair]) -> list[Pair]:
    """Return the pairs of which both flights count; raise a BadInputError if there is none."""
    valid = [pair for pair in pairs if counts(pair.a) and counts(pair.b)]
    if not valid:
        bad = [row["text"] for _, *both in pairs for row in both if not counts(row)]
        why = f"each has {LEFT_OUT}: {bad[0]}" if bad else "none was found"
        raise BadInputError(f"no pair of flights to compare: {why}")
    return valid


def check_names(names: Iterable[str], known: Collection[str]) -> None:
    """Raise a BadInputError if one of the `names` that the user gave is no `known` metric."""
    for name in names:
        if name not in known:
            raise BadInputError(f"--number: {unknown_name_text('number', name, sorted(known))}")


def _lacking(pairs: Sequence[Pair], name: str) -> dict[str, int]:
    """Count the flights of A and of B without a metric, and the pairs left out for this reason."""
    lacks = [(name not in a["numbers"], name not in b["numbers"]) for _, a, b in pairs]
    a, b = (sum(side) for side in zip(*lacks, strict=True))
    return {"a": a, "b": b, "left_out": sum(map(any, lacks))}


def adjust(tests: Sequence[dict[str, Any]]) -> None:
    """Set Holm's p in the results of `compare_number` and `compare_success`, one family."""
    ps = [each["p_mcnemar"] if "p_mcnemar" in each else each["p_wilcoxon"] for each in tests]
    for each, p in zip(tests, holm(ps), strict=True):
        each["p_holm"] = p


def compare_number(pairs: Sequence[Pair], name: str, unit: str) -> dict[str, Any]:
    """Evaluate a number of pairs of which at least one has it on both sides; return JSON."""
    known = [pair for pair in pairs if name in pair.a["numbers"] and name in pair.b["numbers"]]
    both = [(a["numbers"][name], b["numbers"][name]) for _, a, b in known]
    return {
        "unit": unit,
        "a_median": median(a for a, _ in both),
        "b_median": median(b for _, b in both),
        **asdict(paired(differences(*zip(*both, strict=True)).tolist())),
        "a_failed": sum(pair.a["verdict"] != "success" for pair in known),
        "b_failed": sum(pair.b["verdict"] != "success" for pair in known),
        "left_out": len(pairs) - len(both),
    }


def compare_success(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Evaluate the successes of pairs; return JSON."""
    done = [(a["verdict"] == "success", b["verdict"] == "success") for _, a, b in pairs]
    count = len(pairs)
    a, b = (sum(each) for each in zip(*done, strict=True))
    only_a = sum(a and not b for a, b in done)
    only_b = b - (a - only_a)
    p = sign_test(only_a, only_b)
    return {
        **{"count": count, "a": a, "a_interval": exact_interval(a, count)},
        **{"b": b, "b_interval": exact_interval(b, count)},
        **{"only_a": only_a, "only_b": only_b, "p_mcnemar": p, "decided": p < LEVEL},
    }


def _flight(row: Row, names: Sequence[str]) -> dict[str, Any]:
    numbers = {name: row["numbers"][name] for name in names if name in row["numbers"]}
    return {"verdict": row["verdict"], "numbers": numbers}


def of_sweep(folder: Path, a: str, b: str) -> Pairs:
    """Pair the rows of a sweep that differ only in one axis: one has the value `a`, the other `b`.

    `a` and `b` are texts: VALUE or AXIS=VALUE.

    Raises:
        BadInputError: If not exactly one axis has both values, or if `a` and `b` are equal.
    """
    rows, units, missing = store.read_flights(folder)
    axes = store.values_of(rows)
    axis, first, second = _sides(folder, axes, a, b)
    what = f"{axis} in {folder}" + (f", of which {missing}" if missing else "")
    if pooled := ", ".join(name for name, each in axes.items() if name != axis and len(each) > 1):
        what += f", over all values of {pooled}; flights with equal seeds depend on each other, "
        what += "so p is too small"
    return Pairs(_pairs(rows, axis, first, second), units, what)


def _sides(folder: Path, axes: Mapping[str, list[Any]], a: str, b: str) -> tuple[str, Any, Any]:
    """Find the axis that has both values, of which `a` and `b` are the texts; return it and them.

    Raise a BadInputError if there is no such axis, or more than one.
    """

    def values(text: str) -> list[tuple[str, Any]]:
        every = [(axis, value) for axis, each in axes.items() for value in each]
        return [(axis, value) for axis, value in every if text in (f"{value}", f"{axis}={value}")]

    found = [(axis, x, y) for axis, x in values(a) for other, y in values(b) if axis == other]
    if len(found) != 1 or found[0][1] == found[0][2]:
        listed = [f"{axis}: {', '.join(map(str, each))}" for axis, each in axes.items()]
        known = "; ".join(listed) or "none"
        raise BadInputError(
            f"{folder}: A and B must be two values of one axis, VALUE or AXIS=VALUE; axes: {known}"
        )
    return found[0]


def _pairs(rows: Iterable[Row], axis: str, first: Any, second: Any) -> list[Pair]:
    """Pair the rows that differ only in `axis`: one has the value `first`, the other `second`."""
    flown: dict[str, dict[Any, Row]] = {}
    for row in rows:
        rest = {name: value for name, value in row["point"].items() if name != axis}
        shared = json.dumps({**rest, "seed": row["seed"]})
        flown.setdefault(shared, {})[row["point"][axis]] = row
    return [
        Pair(json.loads(shared), each[first], each[second])
        for shared, each in flown.items()
        if first in each and second in each
    ]
