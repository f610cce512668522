"""Run the queries of the chart's dashboards in Prometheus, and draw the panels as Grafana would.

The end-to-end tests use this module: they need no Grafana, and draw build/e2e/dashboards.webp.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

STEP = 5
"""Time between two points of a curve [s]; Prometheus scrapes as often."""
RATE_INTERVAL = "20s"
"""Value of Grafana's variable `$__rate_interval`: four scrapes, as in Grafana."""
UNITS = {
    **{"s": "s", "lengthm": "m", "velocityms": "m/s", "forceN": "N", "bytes": "B", "cps": "/s"},
    "percentunit": "share",
}
"""Name of a unit in Grafana -> its symbol."""
COLUMNS = 3

Dashboard = Mapping[str, Any]
Ask = Callable[[str], Sequence[Mapping[str, Any]]]
"""A function that returns the result of a query, as in Prometheus' API."""


class Curve(NamedTuple):
    """One curve of a panel: its text in the legend, and its points (Unix time [s], value)."""

    legend: str
    points: list[tuple[float, float]]


Curves = dict[tuple[str, str], list[Curve]]
"""(Title of a panel, legend text of a query) -> curves that the query returned."""


def expressions(dashboard: Dashboard, panel: Mapping[str, Any]) -> dict[str, str]:
    """Return legend -> query of a panel; variables have the values that Grafana selects first."""
    values = {"__rate_interval": RATE_INTERVAL}
    for variable in dashboard["templating"]["list"]:
        values[variable["name"]] = variable.get("current", {}).get("value", "")
    targets = panel["targets"]
    return {each["legendFormat"]: _fill(each["expr"], r"\$(\w+)", values) for each in targets}


def _fill(text: str, pattern: str, values: Mapping[str, str]) -> str:
    return re.sub(pattern, lambda found: values[found[1]], text)


def fetch(dashboard: Dashboard, ask: Ask, duration: int) -> Curves:
    """Return the curves of all panels over the last `duration` [s]."""
    found = {}
    for panel in dashboard["panels"]:
        for legend, query in expressions(dashboard, panel).items():
            found[panel["title"], legend] = [
                Curve(
                    _fill(legend, r"{{(\w+)}}", one["metric"]),
                    [(time, float(text)) for time, text in one["values"] if text != "NaN"],
                )
                for one in ask(f"({query})[{duration}s:{STEP}s]")
            ]
    return found


def draw(shown: Sequence[tuple[Dashboard, Curves]], path: Path) -> None:
    """Draw all panels into a picture; the x axis is the time relative to the newest value [min]."""
    from matplotlib.figure import Figure

    rows = [-(-len(dashboard["panels"]) // COLUMNS) for dashboard, _ in shown]
    figure = Figure(figsize=(12, 1.75 * sum(rows) + 0.5 * len(rows)), layout="constrained")
    heights = [n + 0.25 for n in rows]
    parts = figure.subfigures(len(rows), 1, squeeze=False, height_ratios=heights).flat
    for (dashboard, curves), n, part in zip(shown, rows, parts, strict=True):
        part.suptitle(dashboard["title"], weight="bold")
        axes = part.subplots(n, COLUMNS, sharex=True, squeeze=False).flat
        for axis, panel in zip(axes, dashboard["panels"], strict=False):
            of_panel = [each for key, each in curves.items() if key[0] == panel["title"]]
            _draw_panel(axis, panel, [*chain(*of_panel)])
    figure.savefig(path, dpi=100, pil_kwargs={"lossless": True})


def _draw_panel(axis: Any, panel: Mapping[str, Any], curves: list[Curve]) -> None:
    defaults = panel["fieldConfig"]["defaults"]
    end = max((time for _, points in curves for time, _ in points), default=0.0)
    for legend, points in curves:
        minutes, values = [(time - end) / 60 for time, _ in points], [value for _, value in points]
        axis.plot(minutes, values, label=legend, linewidth=1, drawstyle="steps-post")
    unit = UNITS.get(defaults.get("unit"), "")
    axis.set_title(panel["title"] + (f" ({unit})" if unit else ""), fontsize=8, loc="left")
    axis.tick_params(labelsize=7)
    axis.grid(alpha=0.3)
    if mappings := defaults.get("mappings"):
        states = mappings[0]["options"]
        axis.set_yticks([*map(int, states)], [state["text"] for state in states.values()])
        axis.set_ylim(-0.5, len(states) - 0.5)
    axis.legend(fontsize=7, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.15))
