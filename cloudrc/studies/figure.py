"""Draw the figure of a sweep: for each point, medians and success rate with 95 % intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import nan
from statistics import median
from typing import Any, NamedTuple

from cloudrc.metrics import scale
from cloudrc.outside.refusal import check_names
from cloudrc.report.figures.bands import Panel, Point, draw
from cloudrc.report.figures.style import Look
from cloudrc.runs.flight import counts
from cloudrc.statistics import exact_interval, median_interval
from cloudrc.trials.rows import Row
from cloudrc.trials.summary import NUMBERS, count_successes, values_of

COLUMN = Look(width=3.5)
"""Look of a figure in one column of a page. Source: IEEE conference template."""
SHOWN = 3
"""Number of metrics that a figure shows by default."""
CAPTION = (
    "Median of each point, with its 95 % interval from 6 flights on; success: share and "
    "Clopper and Pearson's 95 % interval. Open markers: some flights failed."
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
        names: Metrics to show; by default the first three of `compare.NUMBERS`.
        x: Axis of the sweep along x; by default the first numeric axis, else the first axis.
        by: Axis with one line per value; by default another axis, preferably not numeric.
        look: Size of the figure.

    Returns:
        The figure as PDF, PNG and SVG by suffix; and its caption.

    Raises:
        CloudrcError: If the sweep lacks an axis or a metric.
    """
    shown = _shown(rows, names)
    axes = _choose(rows, x, by)
    is_numeric = _is_numeric(axes.values[axes.x])
    along = sorted(axes.values[axes.x]) if is_numeric else axes.values[axes.x]
    at = along if is_numeric else range(len(along))
    groups = _grouped(rows, axes, along)
    panels = [_metric(name, units[name], groups, at) for name in shown]
    if any(row["verdict"] != "success" for row in rows):
        panels.append(Panel("success", "%", _lines(groups, at, _rate)))
    caption = CAPTION
    if axes.pooled:
        caption += f" Each point pools all values of {', '.join(axes.pooled)}."
    ticks = [] if is_numeric else list(map(str, along))
    return draw(panels, axes.x, ticks, axes.by, look=look), caption


def _shown(rows: Sequence[Row], names: Sequence[str]) -> Sequence[str]:
    """Return the metrics to show, of which some flight has each."""
    known = sorted({name for row in rows if counts(row) for name in row["numbers"]})
    check_names("number", names, known, "--number: ")
    return names or [name for name in NUMBERS if name in known][:SHOWN]


class _Axes(NamedTuple):
    """The axes of a sweep, and their roles in the figure."""

    values: dict[str, list[Any]]  # axis -> its values
    x: str
    by: str | None  # axis with one line per value; None if no axis is left

    @property
    def pooled(self) -> list[str]:
        """The other axes with more than one value, of which each point has all."""
        values, shown = self.values, (self.x, self.by)
        return [axis for axis in values if len(values[axis]) > 1 and axis not in shown]


def _choose(rows: Sequence[Row], x: str | None, by: str | None) -> _Axes:
    """Choose the figure's x axis and the axis with one line per value.

    `x` and `by` are the user's choices of these two, or None.
    """
    values = values_of(rows)
    check_names("axis", filter(None, (x, by)), values)
    free = [axis for axis in values if len(values[axis]) > 1 and axis != by] or list(values)
    # Axes with names come first: a median of two predictors says less than one of two delays.
    names_first = sorted(free, key=lambda axis: _is_numeric(values[axis]))
    x = x or next((axis for axis in free if _is_numeric(values[axis])), free[0])
    lines = [by] if by else names_first
    return _Axes(values, x, next((axis for axis in lines if axis != x), None))


def _grouped(rows: Sequence[Row], axes: _Axes, along: Sequence[Any]) -> Groups:
    """Group the flights by line and, within a line, by their value on the x axis."""
    lines = {axes.x: rows}
    if axes.by is not None:
        lines = {str(value): _with(rows, axes.by, value) for value in axes.values[axes.by]}
    return {name: [_with(line, axes.x, at) for at in along] for name, line in lines.items()}


def _with(rows: Sequence[Row], axis: str, value: Any) -> list[Row]:
    return [row for row in rows if row["point"][axis] == value]


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
