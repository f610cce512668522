"""Many reports of one experiment become one table: medians with their intervals."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

from cloudrc.cli.output import number, table

Report: TypeAlias = Mapping[str, Any]
"""A `report.json`."""

CONFIDENCE = 0.95
METHOD = "95 % interval of the median, by order statistics"


def interval(values: Sequence[float]) -> tuple[float, float] | None:
    """Bound the median of what the values were drawn from, without assuming a distribution.

    The k-th smallest and the k-th largest of n values enclose the median with probability
    1 - 2 * sum_{i<k} C(n, i) / 2^n; k is the largest for which that is at least 95 %.

    Source: H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed., 2003, section 7.1.

    Returns:
        Lower and upper bound, or None for fewer than 6 values, which cannot tell.
    """
    ordered, n = sorted(values), len(values)
    outside, k = 0.0, 0
    while k < n // 2:
        outside += 2 * math.comb(n, k) / 2**n
        if 1 - outside < CONFIDENCE:
            break
        k += 1
    return (ordered[k - 1], ordered[n - k]) if k else None


def summarise(reports: Sequence[Report]) -> dict[str, Any]:
    """Give done, count, and per number its median, interval, unit and how many runs have it."""
    units: dict[str, str] = {}
    values: dict[str, list[float]] = {}
    for report in reports:
        for name, entry in report["numbers"].items():
            units[name] = entry["unit"]
            values.setdefault(name, []).append(entry["value"])
    numbers = {
        name: {
            "median": statistics.median(samples),
            "interval": interval(samples),
            "unit": units[name],
            "count": len(samples),
        }
        for name, samples in values.items()
    }
    done = sum(report["verdict"] == "success" for report in reports)
    return {"done": done, "count": len(reports), "method": METHOD, "numbers": numbers}


def as_table(summary: Mapping[str, Any]) -> str:
    """Lay a summary out: number, median, interval, unit, and below how many runs were done."""
    rows = [("number", "median", "95 % interval", "unit")]
    for name, entry in summary["numbers"].items():
        bounds = entry["interval"]
        between = f"{number(bounds[0])} .. {number(bounds[1])}" if bounds else "-"
        unit = "" if entry["unit"] == "1" else entry["unit"]
        note = "" if entry["count"] == summary["count"] else f"  ({entry['count']} runs)"
        rows.append((name, number(entry["median"]), between, unit + note))
    enough = any(entry["interval"] for entry in summary["numbers"].values())
    method = METHOD if enough else "an interval needs 6 seeds or more"
    return f"{table(rows, right=(1, 2))}\n\n{method}\ndone {summary['done']}/{summary['count']}"


def as_csv(reports: Sequence[Report]) -> str:
    """Write one line per run: seed, verdict, and every number that any run has."""
    columns = list(dict.fromkeys(name for report in reports for name in report["numbers"]))
    units = {name: e["unit"] for report in reports for name, e in report["numbers"].items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["seed", "verdict", *(f"{name} [{units[name]}]" for name in columns)])
    for report in reports:
        numbers = report["numbers"]
        values = [numbers[name]["value"] if name in numbers else "" for name in columns]
        writer.writerow([report["seed"], report["verdict"], *values])
    return text.getvalue()
