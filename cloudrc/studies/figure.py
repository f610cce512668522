# SPDX-License-Identifier: Apache-2.0

"""Draw the figure of a sweep: for each point, medians and success rate with 95 % intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import nan, sqrt
from statistics import median
from typing import Any

from cloudrc.base.outside.refusal import check_names
from cloudrc.base.statistics import exact_interval, median_interval
from cloudrc.flight.in_memory import counts
from cloudrc.flight.trials.rows import Row
from cloudrc.flight.trials.summary import RATIO, count_successes, default_numbers, values_of
from cloudrc.results.metrics.measure import SHIPPED, scale
from cloudrc.results.report.figures.bands import Panel, Point, draw
from cloudrc.results.report.figures.style import Look

COLUMN = Look(width=3.5)
"""Look of a figure in one column of a page. Source: IEEE conference template."""
WIDE = 100.0
"""Ratio of the largest to the smallest value from which the axis is logarithmic."""
SHOWN = 3
"""Number of metrics that a figure shows by default."""
CAPTION = (
    "Median of each point, with its 95 % interval from 6 flights on; success: share and "
    "Clopper and Pearson's 95 % interval. Hollow markers: a flight failed."
)
Groups = Mapping[str, Sequence[Sequence[Row]]]
"""Name of a line -> flights of each point."""
Summary = Callable[[Sequence[Row]], tuple[float, float, float]]
"""Function that returns a value and its interval."""


def draw_sweep(
    rows: Sequence[Row],
    units: Mapping[str, str],
    names: Sequence[str] = (),
    x: str | None = None,
    by: str | None = None,
    look: Look = COLUMN,
) -> tuple[dict[str, bytes], str]:
    """Draw a panel per metric and, if flights failed, one with the share of successes.

    Args:
        rows: All flights of the sweep.
        units: Metric -> unit.
        names: Metrics to show; by default the three that matter first.
        x: Axis of the sweep along x; by default the first numeric axis, else the first axis.
        by: Axis with one line per value; by default another axis, preferably not numeric.
        look: Size of the figure.

    Returns:
        The figure as PDF, PNG and SVG by suffix; and its caption.

    Raises:
        CloudrcError: If the sweep lacks an axis or a metric.
    """
    shown, values = _shown(rows, names), values_of(rows)
    x, by = _choose(values, x, by)
    is_numeric = _is_numeric(values[x])
    along = sorted(values[x]) if is_numeric else values[x]
    at = along if is_numeric else range(len(along))
    lines = {x: rows} if by is None else {str(each): _with(rows, by, each) for each in values[by]}
    groups = {name: [_with(line, x, each) for each in along] for name, line in lines.items()}
    panels = [_metric(name, units[name], groups, at) for name in shown]
    if any(row["verdict"] != "success" for row in rows):
        panels.append(Panel("success", "%", _lines(groups, at, _rate)))
    pooled = [axis for axis, each in values.items() if len(each) > 1 and axis not in (x, by)]
    more = f" Each point pools all values of {', '.join(pooled)}." if pooled else ""
    more += f" {RATIO}: cost of control relative to that without a network." * (RATIO in shown)
    return draw(
        panels, x, [] if is_numeric else list(map(str, along)), by, look=look
    ), CAPTION + more


def _shown(rows: Sequence[Row], names: Sequence[str]) -> Sequence[str]:
    """Return the metrics to show, of which some flight has each."""
    known = sorted({name for row in rows if counts(row) for name in row["numbers"]})
    check_names("metric", names, known, "--metric: ")
    return names or default_numbers(known)[:SHOWN]


def _choose(
    values: Mapping[str, list[Any]], x: str | None, by: str | None
) -> tuple[str, str | None]:
    """Choose the figure's x axis and the axis with one line per value; None if no axis is left.

    `values` are those of each axis, `x` and `by` the user's choices of these two, or None.
    """
    check_names("axis", filter(None, (x, by)), values)
    free = [axis for axis in values if len(values[axis]) > 1 and axis != by] or list(values)
    # Axes with names come first: a median of two predictors says less than one of two delays.
    names_first = sorted(free, key=lambda axis: _is_numeric(values[axis]))
    x = x or next((axis for axis in free if _is_numeric(values[axis])), free[0])
    lines = [by] if by else names_first
    return x, next((axis for axis in lines if axis != x), None)


def _with(rows: Sequence[Row], axis: str, value: Any) -> list[Row]:
    return [row for row in rows if row["point"][axis] == value]


def _is_numeric(values: Sequence[Any]) -> bool:
    return all(type(value) in (int, float) for value in values)


def _metric(name: str, unit: str, groups: Groups, at: Sequence[float]) -> Panel:
    def values(point: Sequence[Row]) -> list[float]:
        return [r["numbers"][name] for r in point if counts(r) and name in r["numbers"]]

    all_of = [value for points in groups.values() for point in points for value in values(point)]
    least, most = min(all_of), max(map(abs, all_of))
    is_log = 0 < least < most / WIDE
    factor, unit = scale(unit, sqrt(least * most) if is_log else most)

    def summarise(point: Sequence[Row]) -> tuple[float, float, float]:
        found = [value * factor for value in values(point)]
        return (median(found), *(median_interval(found) or (nan, nan))) if found else (nan,) * 3

    metric = SHIPPED.get(name)
    title = metric.label if metric and metric.label else name.replace("_", " ")
    return Panel(title, unit, _lines(groups, at, summarise), is_log=is_log)


def _rate(point: Sequence[Row]) -> tuple[float, float, float]:
    if not point:
        return nan, nan, nan
    done = count_successes(point)
    low, high = exact_interval(done, len(point))
    return 100 * done / len(point), 100 * low, 100 * high


def _lines(groups: Groups, at: Sequence[float], summarise: Summary) -> dict[str, list[Point]]:
    return {
        name: [
            Point(x, *summarise(point), any(row["verdict"] != "success" for row in point))
            for x, point in zip(at, points, strict=True)
        ]
        for name, points in groups.items()
    }
