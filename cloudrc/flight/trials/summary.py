# SPDX-License-Identifier: Apache-2.0

"""Summarise rows: verdicts, medians, success rates, and differences in pairs of equal seeds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import asdict
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from cloudrc.base.rounding import differences
from cloudrc.base.statistics import (
    LEVEL,
    exact_interval,
    holm,
    median_interval,
    paired,
    sign_test,
)
from cloudrc.base.text import FAILED_MARK, FAILED_NOTE, format_number, table
from cloudrc.flight.in_memory import counts
from cloudrc.flight.trials.rows import Row

NUMBERS = (
    "prediction_error_rms",
    "tracking_error_p95",
    "iae_mean",
    "settling_time_mean",
    "unsettled_steps",
    "overshoot_mean",
    "delay_estimate_error_rms",
    "min_clearance",
)
"""Metrics that are compared and drawn by default."""
COST, RATIO = "control_cost", "J/J0"
"""Number of a flight: its `control_cost` relative to that of the same flight without a network."""
OFF_PATH, TIME_RATIO = BESIDE_IDEAL = "off_ideal_path", "T/T0"
"""Numbers of a flight beside the same flight without a network, in place of J/J0 where the setpoint
waits for the robot: how far its path is off, and how much longer its mission takes."""
NO_RATIO = (
    f"{OFF_PATH} and {TIME_RATIO} stand in place of {RATIO}: in this mission the setpoint waits "
    "for the robot; a failed flight counts as worse than every success"
)
"""Why there is no J/J0, and how the numbers in its place are compared."""
BEHIND = 1.0 + 1e-6
"""Value of a failed flight, relative to that of the worst success, if its own is not larger [1]."""
COSTS = (RATIO, *BESIDE_IDEAL, "bytes_sent_uplink", "bytes_sent_downlink")
"""Metrics that come first where the flights without a network are known: what control costs, and
what it sends for that."""
METHOD = "95 % interval of the median, by order statistics"


def count_verdicts(rows: Iterable[Row]) -> str:
    """Return how many rows have which verdict, such as "9 success, 1 failure"."""
    numbers = Counter(row["verdict"] for row in rows)
    return ", ".join(f"{n} {verdict}" for verdict, n in sorted(numbers.items())[::-1]) or "none"


def count_successes(rows: Iterable[Row]) -> int:
    """Return how many rows have the verdict "success"."""
    return sum(row["verdict"] == "success" for row in rows)


def values_of(rows: Sequence[Row]) -> dict[str, list[Any]]:
    """Return a mapping: axis -> its different values in `rows`, in the order of `rows`."""
    axes = rows[0]["point"]
    return {axis: list(dict.fromkeys(row["point"][axis] for row in rows)) for axis in axes}


def default_numbers(known: Container[str]) -> list[str]:
    """Return those of the `known` metrics that matter first."""
    first = COSTS if RATIO in known or OFF_PATH in known else ()
    return [name for name in (*first, *NUMBERS) if name in known]


def normalise(rows: Mapping[str, Row], baselines: Mapping[str, str]) -> dict[str, Row]:
    """Return the rows of the grid, with J/J0 where the flight without a network succeeded.

    Both are the arguments of a plan: key -> row, and key -> key of the flight without a network.
    """
    for key, base in baselines.items():
        own, bare = rows.get(key), rows.get(base)
        if not own or not bare or bare["verdict"] != "success" or COST not in own["numbers"]:
            continue
        if bare_cost := bare["numbers"].get(COST):
            own["numbers"][RATIO] = own["numbers"][COST] / bare_cost
    without_point = added(baselines)
    return {key: row for key, row in rows.items() if key not in without_point}


def added(baselines: Mapping[str, str]) -> set[str]:
    """Return the keys of the flights that are of no point of the grid; see `normalise`."""
    return {*baselines.values()} - baselines.keys()


# Medians.


def summarise(rows: Sequence[Row], units: Mapping[str, str]) -> dict[str, Any]:
    """Count all runs and successful runs; compute the median of each measurement.

    Each median has a confidence interval. A run whose plug-in failed is counted, but its
    measurements are left out. `units`: metric -> unit.
    """
    valid = [row for row in rows if counts(row)]
    names = dict.fromkeys(name for row in valid for name in row["numbers"])
    numbers = {name: _summarise_one(valid, name, units[name]) for name in names}
    done = count_successes(rows)
    return {"done": done, "count": len(rows), "method": METHOD, "numbers": numbers}


def _summarise_one(rows: Iterable[Row], name: str, unit: str) -> dict[str, Any]:
    """Return median and interval of a measurement, of how many runs, and how many had failed."""
    having = [row for row in rows if name in row["numbers"]]
    found = [row["numbers"][name] for row in having]
    return {
        "median": median(found),
        "interval": median_interval(found),
        "unit": unit,
        "count": len(found),
        "failed": len(having) - count_successes(having),
    }


def as_table(summary: Mapping[str, Any], planned: int = 0) -> str:
    """Format the result of `summarise` as a table; the last line counts the successful runs.

    `planned` is the number of runs to fly, if it is larger than that of the runs that have flown.
    """
    rows = [("number", "median", "95 % interval", "unit")]
    for name, entry in summary["numbers"].items():
        rows.append(_row(name, entry, summary["count"]))
    method = METHOD if summary["count"] >= 6 else "an interval needs 6 seeds or more"
    if any(entry["failed"] for entry in summary["numbers"].values()):
        method += f"\n{FAILED_NOTE}"
    count = planned or summary["count"]
    return f"{table(rows, right=(1, 2))}\n\n{method}\ndone {summary['done']}/{count}"


def _row(name: str, entry: Mapping[str, Any], count: int) -> tuple[str, str, str, str]:
    """Return the row of a number; `count` is that of all runs."""
    between = " .. ".join(map(format_number, entry["interval"] or ())) or "-"
    unit = "" if entry["unit"] == "1" else entry["unit"]
    note = "" if entry["count"] == count else f"  ({entry['count']} runs)"
    mark = FAILED_MARK if entry["failed"] else ""
    return name, format_number(entry["median"]) + mark, between, unit + note


# Pairs.


class Pair(NamedTuple):
    """Two rows that differ in the compared setting only."""

    label: Mapping[str, Any]  # what both share, such as the seed
    a: Row
    b: Row


def pair(rows: Iterable[Row], axis: str, first: Any, second: Any) -> list[Pair]:
    """Pair the rows that differ only in `axis`: one has the value `first`, the other `second`."""
    found: dict[str, tuple[dict[str, Any], dict[Any, Row]]] = {}
    for row in rows:
        rest = {name: value for name, value in row["point"].items() if name != axis}
        shared = {**rest, "seed": row["seed"]}
        found.setdefault(repr(shared), (shared, {}))[1][row["point"][axis]] = row
    return [
        Pair(shared, sides[first], sides[second])
        for shared, sides in found.values()
        if first in sides and second in sides
    ]


def compare_number(pairs: Sequence[Pair], name: str, unit: str) -> dict[str, Any]:
    """Evaluate a number of pairs of which at least one has it on both sides; return JSON."""
    known = [each for each in pairs if name in each.a["numbers"] and name in each.b["numbers"]]
    first, second = ([row["numbers"][name] for row in side] for side in _sides(known))
    failed = [len(known) - count_successes(side) for side in _sides(known)]
    return {
        "unit": unit,
        "a_median": median(first),
        "b_median": median(second),
        **asdict(paired(_differences(known, name))),
        "a_failed": failed[0],
        "b_failed": failed[1],
        "left_out": len(pairs) - len(known),
    }


def _differences(pairs: Sequence[Pair], name: str) -> list[float]:
    """Return B - A of a number that both flights of each pair have.

    Beside the flight without a network, a failed flight is worse than every success: a robot that
    stops at once has a short time and a small error. Between two failures there is no difference.
    """
    sides = _sides(pairs)
    values = np.array([[row["numbers"][name] for row in side] for side in sides])
    if name in BESIDE_IDEAL:
        failed = np.array([[row["verdict"] != "success" for row in side] for side in sides])
        worst = BEHIND * values[~failed].max(initial=0.0)
        values = np.where(failed, np.maximum(values, worst), values)
        values[:, failed.all(axis=0)] = worst
    return list(map(float, differences(*values)))


def _sides(pairs: Sequence[Pair]) -> tuple[list[Row], list[Row]]:
    return [each.a for each in pairs], [each.b for each in pairs]


def compare_success(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Evaluate the successes of pairs; return JSON."""
    count = len(pairs)
    a, b = map(count_successes, _sides(pairs))
    both = sum(count_successes((each.a, each.b)) == 2 for each in pairs)
    p = sign_test(a - both, b - both)
    return {
        "count": count,
        "a": a,
        "a_interval": exact_interval(a, count),
        "b": b,
        "b_interval": exact_interval(b, count),
        "only_a": a - both,
        "only_b": b - both,
        "p_mcnemar": p,
        "decided": p < LEVEL,
    }


def adjust(tests: Sequence[dict[str, Any]]) -> None:
    """Set Holm's p in the results of `compare_number` and `compare_success`, one family."""
    ps = [each["p_mcnemar"] if "p_mcnemar" in each else each["p_wilcoxon"] for each in tests]
    for each, p in zip(tests, holm(ps), strict=True):
        each["p_holm"] = p
