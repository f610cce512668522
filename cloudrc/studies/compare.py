# SPDX-License-Identifier: Apache-2.0

"""Compare two settings, A and B, by pairs of flights that differ in nothing else."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base.errors import CloudrcError, NothingFlownError
from cloudrc.base.outside.refusal import check_names, naming
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.config.problems import problem_at
from cloudrc.config.sweep import draft_of
from cloudrc.flight.in_memory import counts
from cloudrc.flight.trials.plan import SweepPlan, check
from cloudrc.flight.trials.play import run
from cloudrc.flight.trials.rows import Row, Rows
from cloudrc.flight.trials.summary import (
    NO_RATIO,
    OFF_PATH,
    RATIO,
    Pair,
    adjust,
    compare_number,
    compare_success,
    default_numbers,
    normalise,
    pair,
    values_of,
)
from cloudrc.results.metrics.budget import NAMES, NUMBER
from cloudrc.results.metrics.measure import SHIPPED
from cloudrc.studies.sweep import read_flights

METHOD = (
    "B - A: Hodges-Lehmann estimate, 95 % interval and p of the exact Wilcoxon signed-rank test, "
    "which assumes symmetric differences; p sign: the exact sign test, which does not; "
    "success: Clopper-Pearson intervals, p of the exact McNemar test"
)
LEFT_OUT = "a flight that did not end or whose plug-in failed"


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


def plan_sides(
    experiment: str,
    common: Sequence[str],
    a: Sequence[str],
    b: Sequence[str],
    seeds: int,
    names: Sequence[str] = (),
    *,
    cost: bool = False,
) -> SweepPlan:
    """SweepPlan the flights of an experiment with the settings `a` and `b`, both after `common`.

    With `cost`, also plan those without a network.
    """
    plan = check(draft_of(experiment, common, seeds, {"A": a, "B": b}, cost=cost))
    _check_numbers(names, plan.units)
    return plan


def fly_pairs(
    plan: SweepPlan, jobs: int, see: Callable[[Row], None] = lambda row: None
) -> tuple[list[Pair], CloudrcError | None]:
    """Fly both sides in `jobs` processes; call `see` with each row, its key "A", "B" or "J0".

    Return the pairs of flights, and why the work ended early, or None.
    """
    rows = Rows()
    flights = sorted(plan.flights.values(), key=lambda each: each.seed)

    def tell(row: Row) -> None:
        see({**row, "key": row["point"].get("side", "J0")})

    stopped = run(flights, rows, jobs, tell)
    return pair(normalise(rows.kept, plan.baselines).values(), "side", "A", "B"), stopped


def compare(
    pairs: Sequence[Pair], units: Mapping[str, str], names: Sequence[str] = ()
) -> dict[str, Any]:
    """Evaluate success and the metrics `names`; return a JSON document.

    Without names, they are those that matter first.

    A pair is left out if one of its flights did not end or had a plug-in that failed. Where one
    flight of a pair lacks a metric, the pair is left out for this metric. `units`: metric -> unit.
    """
    flown = _valid(pairs)
    known = {n for _, a, b in flown for n in a["numbers"].keys() | b["numbers"].keys()}
    if not {*names} <= {*units, *SHIPPED}:
        _check_numbers(names, known)
    chosen = names or default_numbers(known)
    lacking = {name: _lacking(flown, name) for name in chosen}
    having = [name for name in chosen if lacking[name]["left_out"] < len(flown)]
    success = compare_success(flown)
    numbers = {name: compare_number(flown, name, units[name]) for name in having}
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


def budget_numbers(pairs: Sequence[Pair]) -> list[str]:
    """Return the metrics of the budget that any flight has, and the age; others take 0 s there."""
    rows = [row for _, *both in pairs for row in both if row["numbers"]]
    found = [f"{NUMBER}{name}" for name in NAMES]
    found = [name for name in found if any(name in row["numbers"] for row in rows)]
    for row in rows:
        row["numbers"] = dict.fromkeys(found, 0.0) | row["numbers"]
    return [*found, "age_at_actuator_mean"]


def _valid(pairs: Sequence[Pair]) -> list[Pair]:
    """Return the pairs of which both flights count; there has to be one."""
    valid = [each for each in pairs if counts(each.a) and counts(each.b)]
    if not valid:
        bad = [row["text"] for _, *both in pairs for row in both if not counts(row)]
        why = f"each has {LEFT_OUT}: {bad[0]}" if bad else "none was found"
        raise NothingFlownError(f"no pair of flights to compare: {why}")
    return valid


def _check_numbers(names: Iterable[str], known: Iterable[str]) -> None:
    if RATIO in names and RATIO not in known and OFF_PATH in known:
        raise problem_at("--metric", NO_RATIO)
    check_names("metric", names, sorted(known), "--metric: ")


def _lacking(pairs: Sequence[Pair], name: str) -> dict[str, int]:
    """Count the flights of A and of B without a metric, and the pairs left out for this reason."""
    lacks = [(name not in a["numbers"], name not in b["numbers"]) for _, a, b in pairs]
    a, b = (sum(side) for side in zip(*lacks, strict=True))
    return {"a": a, "b": b, "left_out": sum(map(any, lacks))}


def _flight(row: Row, names: Sequence[str]) -> dict[str, Any]:
    numbers = {name: row["numbers"][name] for name in names if name in row["numbers"]}
    return {"verdict": row["verdict"], "numbers": numbers}


def of_sweep(folder: Path, a: str, b: str) -> Pairs:
    """Pair the rows of a sweep that differ only in one axis: one has the value `a`, the other `b`.

    `a` and `b` are texts: VALUE or AXIS=VALUE.
    """
    sweep = read_flights(folder)
    axes = values_of(sweep.rows)
    with naming(str(folder)):
        axis, first, second = _sides(axes, a, b)
    what = f"{axis} in {folder}" + (f", of which {sweep.missing}" if sweep.missing else "")
    if pooled := ", ".join(name for name, each in axes.items() if name != axis and len(each) > 1):
        what += f", over all values of {pooled}; flights with equal seeds depend on each other, "
        what += "so p is too small"
    return Pairs(pair(sweep.rows, axis, first, second), sweep.units, what)


def _sides(axes: Mapping[str, list[Any]], a: str, b: str) -> tuple[str, Any, Any]:
    """Find the one axis that has both values, of which `a` and `b` are the texts."""

    def values(text: str) -> list[tuple[str, Any]]:
        every = [(axis, value) for axis, each in axes.items() for value in each]
        return [(axis, value) for axis, value in every if text in (f"{value}", f"{axis}={value}")]

    found = [(axis, x, y) for axis, x in values(a) for other, y in values(b) if axis == other]
    if len(found) != 1 or found[0][1] == found[0][2]:
        listed = [f"{axis}: {', '.join(map(str, each))}" for axis, each in axes.items()]
        known = "; ".join(listed) or "none"
        raise InvalidValueError(
            f"A and B must be two values of one axis, VALUE or AXIS=VALUE; axes: {known}"
        )
    return found[0]
