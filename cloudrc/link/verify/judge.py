"""Judge one direction: rows of what was requested, applied and measured.

A row is "ok" within what honest links measure, widened by a tolerance, and "off" beyond; "open" if
chance could hide more than that; "told" is for information only.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import isnan, nan
from typing import NamedTuple

from cloudrc.link.model import Stream
from cloudrc.link.verify.expect import Expected, Plan

TOLERANCES = {
    "mean": (2e-3, 0.05),
    "round_trip": (2e-3, 0.05),
    "deviation": (5e-4, 0.10),
    "distribution": (0.05, 0.0),
    "rate": (0.0, 0.25),
}
"""Quantity -> how far it may be off: in its unit, and as a share of the requested value [1]."""
SHARE_TOLERANCE = (0.02, 0.25)
"""Likewise of loss, order and copies."""
UNITS = {"mean": "s", "round_trip": "s", "deviation": "s", "rate": "bit/s"}
"""Quantity -> unit; that of a share is "1"."""
FEWEST, CHANCE_MAX = 300, 1.5
"""Datagrams that a verdict takes at least [1]; tolerances that chance may hide in it [1]."""


class Row(NamedTuple):
    """One quantity of one direction; an unknown value is NaN.

    Attributes:
        name: Quantity, as in `Plan.quantities`, or "round_trip".
        unit: Of the numbers: "s", "1" or "bit/s".
        asked: Mean on links of the requested profile [unit].
        applied: Likewise of the profile that the shaper says is in force [unit].
        measured: Measured value [unit].
        low: Lowest value that is believed [unit].
        high: Highest value that is believed [unit].
        verdict: "ok", "off", "open" or "told".
    """

    name: str
    unit: str
    asked: float
    applied: float
    measured: float
    low: float
    high: float
    verdict: str


def judge(
    plan: Plan, measured: Stream, expected: Expected, applied: Mapping[str, float]
) -> list[Row]:
    """Judge a stream by what honest links measure; `applied` has the values of the one in force."""
    rows = [
        judge_value(name, expected, value, applied.get(name, nan))
        for name, value in plan.quantities(measured, expected.pooled).items()
        if name in expected.bands
    ]
    enough = len(measured.sent) >= FEWEST
    return rows if enough else [row._replace(verdict="open") for row in rows]


def judge_value(name: str, expected: Expected, value: float, applied: float = nan) -> Row:
    """Judge one value [unit] beside the `applied` one [unit].

    Where the draws are known, a jitter may be off by half as much.
    """
    mean, low, high = expected.bands[name]
    half = expected.known and name == "deviation"
    slack = max(TOLERANCES[name][0], 0.5 * tolerance(name, mean)) if half else tolerance(name, mean)
    low, high = max(0.0, low - slack), high + slack
    verdict = "ok" if low <= value <= high else "off"
    if isnan(value) or (verdict == "ok" and hidden(name, expected) > CHANCE_MAX):
        verdict = "open"
    return Row(name, UNITS.get(name, "1"), mean, applied, value, low, high, verdict)


def tolerance(name: str, asked: float) -> float:
    """Return how far a quantity may be off from what was asked, in its unit [unit]."""
    floor, share = TOLERANCES.get(name, SHARE_TOLERANCE)
    return max(floor, share * asked)


def hidden(name: str, expected: Expected) -> float:
    """Return how much chance hides of a quantity, in tolerances [1]."""
    mean, low, high = expected.bands[name]
    return 0.5 * (high - low) / tolerance(name, mean)


def needed(plan: Plan) -> int:
    """Return how many datagrams it takes until chance hides no more than the tolerances."""
    most = max(hidden(name, plan.chance) for name in plan.chance.bands)
    return round(len(plan.links[0].sent) * max(1.0, most**2))


def look_twice(first: Sequence[Row], second: Sequence[Row]) -> list[Row]:
    """Combine two looks at a link: only what is off in both is off."""
    again = {row.name: row for row in second}
    return [again.get(row.name, row) if row.verdict == "off" else row for row in first]


def verdict_of(rows: Iterable[Row]) -> str:
    """Sum up rows: "off" if one is, else "open" if one is or none is judged, else "ok"."""
    verdicts = {row.verdict for row in rows} - {"told"}
    return "off" if "off" in verdicts else "ok" if verdicts == {"ok"} else "open"
