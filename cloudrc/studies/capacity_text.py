# SPDX-License-Identifier: Apache-2.0

"""Show how many robots a cell and a cloud carry: a table and a figure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from math import nan
from typing import Any

from cloudrc.base.text import cells, table
from cloudrc.flight.trials.rows import Row
from cloudrc.results.report.figures.bands import Panel, Point, draw
from cloudrc.results.report.figures.style import Look

COLUMNS = {
    "queue": "{queue}",
    "controller": "{controller}",
    "robots": "{robots}",
    "fleets ok": "{success}/{fleets}",
    "95 % interval": "{low:.0%} .. {high:.0%}",
    "age p99 [ms]": "{age_p99_ms_median:.0f}",
    "worst": "{age_p99_ms_worst:.0f}",
    "commands [Hz]": "{rate_hz_median:.0f}",
    "worst ": "{rate_hz_worst:.0f}",
    "HOLD [s]": "{hold_s_worst:.1f}",
    "lost up": "{loss_uplink_worst:.0%}",
    "cloud [Hz]": "{cloud_hz:.0f}",
    "load": "{load:.2f}",
    "wait [ms]": "{wait_mean_ms:.1f}",
    "N.D/D/1": "{nddd1_ms:.1f}",
    "fail alone": "{fail_alone}",
}
"""Head -> cell of the table; numbers are medians over the fleets."""
LIMITS = {
    "command_age": "command age {age_p99_ms_worst:.0f} of {age_max_ms:.0f} ms "
    "(guard.command_age_max_ms)",
    "hold": "HOLD for {hold_s_worst:.0f} s: it ends after 10 fresh commands within 500 ms, and "
    "{rate_hz_worst:.0f} a second arrive",
    "cloud_rate": "the cloud computes {cloud_hz:.0f} commands a second for a robot",
}
"""Limit that a fleet has come near to -> how."""
Values = tuple[float, float, float]
"""A value and its band."""
CAPTION = (
    "Success: share of fleets in which all robots succeed that succeed alone, and Clopper and "
    "Pearson's 95 % interval. Age and commands: the worst robot of a fleet, median over the "
    "fleets; the band ends at the median robot. Commands are those that reach the onboard "
    "controller; a fleet that fails is measured up to then."
)


def _name(condition: Mapping[str, Any]) -> str:
    return f"{condition['queue']}, {condition['controller']}"


def rows_of(document: Mapping[str, Any]) -> list[Row]:
    """Return a flat row for each condition and size of a fleet."""
    names = "queue", "controller", "robots", "fleets", "success"
    rows = ({**each, **fleet} for each in document["conditions"] for fleet in each["fleets"])
    return [
        {
            **{name: row[name] for name in names},
            **dict(zip(("low", "high"), row["interval"], strict=True)),
            **row["numbers"],
        }
        for row in rows
    ]


def in_words(row: Row) -> str:
    """Say how a fleet has flown."""
    where = ", ".join(f"{value}" for value in row["point"].values())
    return (
        f"{where} robots, seed {row['seed']}: {row['verdict']}{row['text'] and ', '}{row['text']}"
    )


def as_text(document: Mapping[str, Any]) -> str:
    """Format the result: what a robot needs, the table, capacities, and what limits them."""
    rows = cells(rows_of(document), COLUMNS)
    lines = [*dict.fromkeys(_needs(document)), "", table(rows, right=range(2, len(rows[0]))), ""]
    for each in document["conditions"]:
        lines += [_capacity(each, _name(each)), *_binding(each)]
    return "\n".join(lines)


def _needs(document: Mapping[str, Any]) -> Iterator[str]:
    for each in document["conditions"]:
        for medium, robots in each["arithmetic"].items():
            text = f"{medium}: {robots:.1f} robots by arithmetic"
            if medium == "cell":
                ways = ", ".join(
                    f"{way} {own['rate_hz'] * own['bytes'] * 8e-3:.0f} kbit/s "
                    f"({own['rate_hz']:.0f} Hz, {own['bytes']:.0f} bytes with headers)"
                    for way, own in each["traffic"].items()
                )
                text += f"; a robot needs {ways}"
            yield text
        for theory, robots in each["theory"].items():
            yield f"theory ({theory}): {robots} robots"
        yield f"time limit of a mission: {each['time_limit_s']:g} s"


def _bound(value: int, each: Mapping[str, Any]) -> str:
    """Return a number of robots; one at the end of the flown sizes stands for those beyond it."""
    mark = {each["at_most"]: "<=", each["at_least"]: ">="}.get(value, "")
    return f"{mark}{value}"


def _capacity(each: Mapping[str, Any], name: str) -> str:
    low, high = (_bound(value, each) for value in each["interval"])
    what = f"{each['interval_is']} over {len(each['of_seeds'])} seeds"
    return f"capacity, {name}: {_bound(each['capacity'], each)} robots [{low}, {high}] ({what})"


def _binding(each: Mapping[str, Any]) -> Iterator[str]:
    if each["breaks_at"] is None:
        yield "  no larger fleet failed; raise --max"
        return
    found = next(fleet for fleet in each["fleets"] if fleet["robots"] == each["breaks_at"])
    text = "; ".join(LIMITS[name] for name in each["limits"]).format(**each, **found["numbers"])
    codes = ", ".join(found["failures"])
    yield f"  breaks at {found['robots']} robots ({codes}){text and ': '}{text}"


def draw_capacity(document: Mapping[str, Any], look: Look) -> dict[str, bytes]:
    """Draw success, age and rate over the number of robots; return the figure by suffix."""
    conditions, first = document["conditions"], document["conditions"][0]
    marks = {f"arithmetic, {name}": value for name, value in first["arithmetic"].items()}
    marks |= {f"theory, {name}": value for name, value in first["theory"].items()}

    def lines(values: Callable[[Row], Values]) -> dict[str, Sequence[Point]]:
        return {
            _name(each): [
                Point(fleet["robots"], *values(fleet), fleet["success"] < fleet["fleets"])
                for fleet in each["fleets"]
            ]
            for each in conditions
        }

    limit, age = first["age_max_ms"], "age of the command, p99; dashed: the guard's limit"
    panels = [
        Panel("fleets that succeed", "%", lines(_share), marks=marks),
        Panel(age, "ms", lines(partial(_worst, "age_p99_ms")), limit),
        Panel("commands", "Hz", lines(partial(_worst, "rate_hz"))),
    ]
    return draw(
        panels, "robots", [], "queue, controller", look=look, hollow="hollow: a fleet failed"
    )


def _share(fleet: Row) -> Values:
    """Return the share of successes and its interval [%]."""
    low, high = fleet["interval"] if fleet["fleets"] > 1 else (nan, nan)
    return 100 * fleet["success"] / fleet["fleets"], 100 * low, 100 * high


def _worst(name: str, fleet: Row) -> Values:
    """Return a number of the worst robot, and the band from it to the median robot."""
    both = [fleet["numbers"].get(f"{name}_{which}", nan) for which in ("worst", "median")]
    return both[0], min(both), max(both)
