"""Draw the figure of a sweep: for each point, medians and success rate with 95 % intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import nan
from statistics import median
from typing import Any

from cloudrc.errors import BadInputError
from cloudrc.metrics import scale
from cloudrc.plugins import unknown_name_text
from cloudrc.renamed import new_key
from cloudrc.report.figures.bands import Panel, Point, draw
from cloudrc.report.figures.style import Look
from cloudrc.runs.compare import NUMBERS, check_names
from cloudrc.runs.flight import Row, counts
from cloudrc.runs.store import values_of
from cloudrc.statistics import exact_interval, median_interval

COLUMN = Look(width=3.5)
"""Look of a figure in one column of a page. Source: IEEE conference template."""
SHOWN = 3
"""Number of metrics that a figure shows by default."""
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
        names: Metrics to show; by default the first three of `compare.NUMBERS`.
        x: Axis of the sweep along x; by default the first numeric axis, else the first axis.
        by: Axis with one line per value; by default another axis, preferably not numeric.
        look: Size of the figure.

    Returns:
        The figure as PDF, PNG and SVG by suffix; and its caption.

    Raises:
        BadInputError: If the sweep lacks an axis or a metric.
    """
    known = sorted({name for row in rows if counts(row) for name in row["numbers"]})
    check_names(names, known)
    values, x, by, pooled = _choose(rows, x, by)
    is_numeric = _is_numeric(values[x])
    along = sorted(values[x]) if is_numeric else values[x]
    groups = {
        str(name): [
            [r for r in rows if r["point"][x] == at and (not by or r["point"][by] == name)]
            for at in along
        ]
        for name in (values[by] if by else [x])
    }
    at = along if is_numeric else range(len(along))
    panels = [_metric(name, units[name], groups, at) for name in names or
              [name for name in NUMBERS if name in known][:SHOWN]]  # fmt: skip
    if any(row["verdict"] != "success" for row in rows):
        panels.append(Panel("success", "%", _lines(groups, at, _rate)))
    caption = (
        "Median of each point, with its 95 % interval from 6 flights on; success: share and "
        "Clopper and Pearson's 95 % interval. Open markers: some flights failed."
        + (f" Each point pools all values of {', '.join(pooled)}." if pooled else "")
    )
    return draw(panels, x, [] if is_numeric else list(map(str, along)), by, look=look), caption


def _choose(
    rows: Sequence[Row], x: str | None, by: str | None
) -> tuple[dict[str, list[Any]], str, str | None, list[str]]:
    """Choose the axis of the sweep for the figure's x axis, and the axis with one line per value.

    `x` and `by` are the user's choices of these two, or None. Return the values of each axis, the x
    axis, the axis of the lines (None if no axis is left), and the other axes.
    """
    values = values_of(rows)
    if not values:
        raise BadInputError(
            "this sweep has no axis; give its file a grid, or see its metrics in table.csv"
        )
    x, by = (axis and new_key(axis) for axis in (x, by))
    for axis in (x, by):
        if axis is not None and axis not in values:
            raise BadInputError(unknown_name_text("axis", axis, sorted(values)))
    free = [axis for axis in values if len(values[axis]) > 1 and axis != by] or list(values)
    numeric = [axis for axis in free if _is_numeric(values[axis])]
    x = x or next(iter(numeric), free[0])
    if x == by:
        raise BadInputError(f"--x and --by are both {x}; name two axes, or leave one out")
    # Axes with names come first: a median of two predictors says less than one of two delays.
    others = sorted((axis for axis in free if axis != x), key=lambda axis: axis in numeric)
    by = by or next(iter(others), None)
    return values, x, by, [axis for axis in free if axis not in (x, by)]


def _is_numeric(values: Sequence[Any]) -> bool:
    return all(type(value) in (int, float) for value in values)


def _metric(name: str, unit: str, groups: Groups, at: Sequence[float]) -> Panel:
    def values(point: Sequence[Row]) -> list[float]:
        return [r["numbers"][name] for r in point if counts(r) and name in r["numbers"]]

    sizes = [
        abs(value) for points in groups.values() for point in points for value in values(point)
    ]
    factor, unit = scale(unit, max(sizes))

    def summarise(point: Sequence[Row]) -> tuple[float, float, float]:
        found = [value * factor for value in values(point)]
        return (median(found), *(median_interval(found) or (nan, nan))) if found else (nan,) * 3

    return Panel(name.replace("_", " "), unit, _lines(groups, at, summarise))


def _rate(point: Sequence[Row]) -> tuple[float, float, float]:
    if not point:
        return nan, nan, nan
    done = sum(row["verdict"] == "success" for row in point)
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
