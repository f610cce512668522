# SPDX-License-Identifier: Apache-2.0

"""Run the queries of the chart's dashboards in Prometheus, as Grafana would.

The end-to-end tests use this module: they need no Grafana.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

STEP = 5
"""Time between two points of a curve [s]; Prometheus scrapes as often."""
RATE_INTERVAL = "20s"
"""Value of Grafana's variable `$__rate_interval`: four scrapes, as in Grafana."""
UNITS = {
    "s": "s",
    "lengthm": "m",
    "velocityms": "m/s",
    "forceN": "N",
    "bytes": "B",
    "cps": "/s",
    "percentunit": "share",
}
"""Name of a unit in Grafana -> its symbol."""

Dashboard = Mapping[str, Any]
Ask = Callable[[str], Sequence[Mapping[str, Any]]]
"""A function that returns the result of a query, as in Prometheus' API."""


def expressions(dashboard: Dashboard, panel: Mapping[str, Any]) -> dict[str, str]:
    """Return legend -> query of a panel; variables have the values that Grafana selects first."""
    values = {"__rate_interval": RATE_INTERVAL}
    for variable in dashboard["templating"]["list"]:
        values[variable["name"]] = variable.get("current", {}).get("value", "")
    return {
        each["legendFormat"]: re.sub(r"\$(\w+)", lambda found: values[found[1]], each["expr"])
        for each in panel["targets"]
    }


def counts(dashboard: Dashboard, ask: Ask, duration: int) -> dict[tuple[str, str], int]:
    """Return (title of a panel, legend) -> number of points over the last `duration` [s]."""
    found = {}
    for panel in dashboard["panels"]:
        for legend, query in expressions(dashboard, panel).items():
            points = [each["values"] for each in ask(f"({query})[{duration}s:{STEP}s]")]
            found[panel["title"], legend] = sum(
                text != "NaN" for values in points for _, text in values
            )
    return found
