# SPDX-License-Identifier: Apache-2.0

"""Tell budgets in words: where the age of the commands comes from."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.text import table
from cloudrc.results.metrics.budget import ENDS

ROUND_TRIPS = {"rtt": "round trip without the time in world", "loop_delay": "with it"}
"""What cloud alone knows -> in words."""
SCAN_AGE = "age of a scan or picture when acted on"


def as_text(budget: Mapping[str, Any]) -> str:
    """Tell the document of a `Loop`."""
    return "\n".join(_lines(budget) if "stages" in budget else _trips(budget))


def _trips(budget: Mapping[str, Any]) -> Iterator[str]:
    yield from (f"  {note}" for note in budget["notes"])
    yield from _table([(ROUND_TRIPS[name], each) for name, each in budget["round_trips"].items()])


def _table(rows: list[tuple[str, Mapping[str, float]]]) -> list[str]:
    width = max((len(text) for text, _ in rows), default=0)
    return [
        f"  {text:<{width}}  mean {1e3 * each['mean']:6.2f}  p99 {1e3 * each['p99']:6.2f} ms"
        for text, each in rows
    ]


def _lines(budget: Mapping[str, Any]) -> Iterator[str]:
    rows = [(each["text"], each) for each in budget["stages"].values()]
    lines = _table([*rows, ("age when it begins to act", budget["age"])])
    if (average := budget["time_average"]) is not None:
        lines[-1] += f"   time average of the age {1e3 * average:.2f} ms"
    yield from lines
    ended = [f"{count} {ENDS[name]}" for name, count in budget["ended"].items()]
    others = f"; the others: {', '.join(ended)}" if ended else ""
    yield f"  of {budget['commands']} commands that the robot followed{others}"
    yield from (f"  {note}" for note in budget["notes"])
    if scans := budget.get("scans"):
        rows = [(each["text"], each) for each in scans["stages"].values()]
        yield from ("", *_table([*rows, (SCAN_AGE, scans["age"])]))
        yield f"  of {scans['commands']} scans or pictures on which the robot acted"


def fleet_text(found: Mapping[str, Any]) -> str:
    """Tell the budgets of a fleet, and how long its packets were in the cell; see `of_fleet`."""
    budgets = {name: each for name, each in found["budgets"].items() if "stages" in each}
    names = dict.fromkeys(name for each in budgets.values() for name in each["stages"])
    rows = [("mean [ms]", *names, "age", "time average")]
    for robot, each in budgets.items():
        stages = [each["stages"].get(name, {}).get("mean") for name in names]
        rows.append((robot, *map(_ms, [*stages, each["age"]["mean"], each["time_average"]])))
    lines = [table(rows, right=range(1, len(rows[0])))]
    for text, shares in found["cell"].items():
        told = ", ".join(f"{name} {_ms(value)}" for name, value in shares.items())
        lines.append(f"{text}, all robots: {told} ms")
    return "\n".join(lines)


def side_by_side(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[dict[str, str]]:
    """Return a table of two runs: of each stage mean and 99th percentile, and the change.

    `a` and `b` are the documents of loops, by the names of their robots; a stage that one of them
    lacks takes no time there. The age comes last; behind it the stages of scans up to the command,
    if both have scans.
    """
    sides = [*a.values()], [*b.values()]
    for side in sides:
        if len(side) > 1 or "stages" not in side[0]:
            raise InvalidValueError("compares two runs of one robot that follow commands")
    (one,), (other,) = sides
    texts = {name: each["text"] for side in (one, other) for name, each in side["stages"].items()}
    nothing = {"mean": 0.0, "p99": 0.0}
    rows: list[tuple[str, Any, Any]] = [
        (text, *(side["stages"].get(name, nothing) for side in (one, other)))
        for name, text in texts.items()
    ]
    rows.append(("age when it begins to act", one["age"], other["age"]))
    if None not in (one["time_average"], other["time_average"]):
        mean, other_mean = ({"mean": side["time_average"], "p99": None} for side in (one, other))
        rows.append(("time average of the age", mean, other_mean))
    if (scans := one.get("scans")) and (other_scans := other.get("scans")):
        rows += [
            (each["text"], each, other_scans["stages"].get(name, nothing))
            for name, each in scans["stages"].items()
            if name not in one["stages"]
        ]
        rows.append((SCAN_AGE, scans["age"], other_scans["age"]))
    return [
        {
            "stage": text,
            "A [ms]": _ms(first["mean"]),
            "B [ms]": _ms(second["mean"]),
            "B - A [ms]": _ms(second["mean"] - first["mean"], "+"),
            "A p99 [ms]": _ms(first["p99"]),
            "B p99 [ms]": _ms(second["p99"]),
        }
        for text, first, second in rows
    ]


def _ms(time: float | None, sign: str = "") -> str:
    return "-" if time is None else f"{1e3 * time:{sign}.2f}"
