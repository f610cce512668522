# SPDX-License-Identifier: Apache-2.0

"""Say where the controller should run, by flights with disturbances at several places.

In calm air a place hardly matters: a controller that knows the robot needs no news. So the flights
have wind and a robot that is heavier than its model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, product
from operator import itemgetter
from pathlib import Path
from statistics import mean, median
from typing import Any

from cloudrc.base.outside.reuse import reuse_results
from cloudrc.base.statistics import LEVEL, PAIRS_MIN, sign_test
from cloudrc.base.text import cells, escape, table
from cloudrc.config.overrides import parse_settings
from cloudrc.flight.trials.fleet import plan_fleet
from cloudrc.flight.trials.plan import PlannedFlight
from cloudrc.flight.trials.rows import Row

DISTURBANCES = {
    "world.wind.velocity_mps": "[1, 0]",
    "world.wind.gust_mps": "1",
    "world.plant.mass_factor": "1.1",
    "criteria.settle_m": "0.3",
}
"""Setting -> value in flights that are not calm: a light breeze, and a payload.

A controller without an integral part then rests beside its setpoint, hence the last one.
"""
AXES = {
    "compute_ms": "cloud.compute_ms",
    "robots": "fleet.robots",
    "place": "cloud.place",
}
"""Axis -> its key."""
SHOWN = "age_ms", "age_p99_ms", "hold_s", "cross_track_mm", "settling_s"
"""Numbers of a fleet's report that the table shows: the median over the robots."""
JUDGED = {
    "hold_s": ("time in HOLD", "{:.1f} s", 0.1),
    "cross_track_mm": ("cross-track error", "{:.0f} mm", 1.0),
    "settling_s": ("settling time", "{:.2f} s", 0.01),
}
"""Number that decides between places where equally many robots succeed, the first one first -> its
name, its form, and a difference that counts as none [unit of the number]. Less is better."""
SAME = 0.05
"""Relative difference that counts as none."""
TOO_FEW = f"fewer than {PAIRS_MIN} seeds cannot decide between places"
"""Why no place loses."""
TABLE = {
    "compute [ms]": "{compute_ms:g}",
    "robots": "{robots}",
    "place": "{name}",
    "success": "{succeeded}/{flown}",
    "age [ms]": "{age_ms:.0f}",
    "age p99 [ms]": "{age_p99_ms:.0f}",
    "HOLD [s]": "{hold_s:.2f}",
    "cross-track [mm]": "{cross_track_mm:.0f}",
    "settling [s]": "{settling_s:.2f}",
    "kbit/s": "{rate_kbit:.0f}",
    "why": "{why}",
}
"""Head -> cell of the table."""


@dataclass(frozen=True)
class PlaceStudy:
    """The question of `cloudrc place`."""

    experiment: str  # name or path
    set: Sequence[str]  # KEY=VALUE
    compute: Sequence[float]  # computing times of a command on the reference [ms]
    robots: Sequence[int]
    places: Sequence[str]  # names or paths
    seeds: int
    calm: bool

    @property
    def disturbances(self) -> dict[str, str]:
        """Setting -> value that the person has not set."""
        given = [".".join(path) for path in parse_settings(self.set)]
        return {
            key: value
            for key, value in DISTURBANCES.items()
            if not self.calm and not any(f"{key}.".startswith(f"{own}.") for own in given)
        }

    @property
    def settings(self) -> list[str]:
        """All settings of the flights, as KEY=VALUE, but those of the axes."""
        return [*self.set, *(f"{key}={value}" for key, value in self.disturbances.items())]

    def plan(self) -> list[list[PlannedFlight]]:
        """Check all flights; return those of each point, in the order of the table."""
        points = list[list[PlannedFlight]]()
        with reuse_results():
            for values in product(self.compute, self.robots, self.places):
                own = (f"{key}={value}" for key, value in zip(AXES.values(), values, strict=True))
                settings, point = [*self.settings, *own], dict(zip(AXES, values, strict=True))
                first = plan_fleet(self.experiment, settings, point, until_failure=False)
                points.append([first._replace(seed=1 + n) for n in range(self.seeds)])
        return points


def describe(points: Iterable[Sequence[PlannedFlight]], rows: Mapping[str, Row]) -> dict[str, Any]:
    """Return a row for each point that has flown, and which place wins, as values for JSON."""
    shown = [
        _describe_point(trials[0], [rows[trial.key] for trial in trials])
        for trials in points
        if all(trial.key in rows for trial in trials)
    ]
    axes = "compute_ms", "robots"
    groups = groupby(shown, itemgetter(*axes))
    best = [{**dict(zip(axes, values, strict=True)), **judge([*own])} for values, own in groups]
    return {"points": shown, "best": best}


def _describe_point(trial: PlannedFlight, rows: Sequence[Row]) -> dict[str, Any]:
    numbers, point, fleet = [row["numbers"] for row in rows], trial.point, trial.resolved
    sent = [each["sent_kbit_median"] for each in numbers if "sent_kbit_median" in each]
    found = {
        **point,
        "name": Path(point["place"]).stem,
        "succeeded": sum(each.get("succeeded", 0) for each in numbers),
        "flown": fleet.fleet.robots * len(rows),
        "by_seed": {
            "succeeded": [each.get("succeeded", 0) for each in numbers],
            **{name: [each.get(f"{name}_median") for each in numbers] for name in SHOWN},
        },
        "rate_kbit": mean(sent) if sent else None,
    }
    for name in SHOWN:
        values = found["by_seed"][name]
        if known := [value for value in values if value is not None]:
            found[name] = median(known)
    if not fleet.link_values:  # on board, nothing leaves the robot
        found["rate_kbit"] = 0.0
    if codes := sorted({code for each in rows for code in each["failures"]}):
        found["why"] = ", ".join(codes)
    return found


def judge(places: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the names of the best of places, several if they do not differ, and by what they win.

    First decides how many robots succeed, then the numbers in `JUDGED`: a place loses if the exact
    sign test over the seeds finds it worse than the best one. All have the same wind with a seed.
    """
    first = max(places, key=itemgetter("succeeded"))
    if first["succeeded"] == 0:
        return {"places": [], "by": "no robot succeeds anywhere"}
    if len(_missed(first)) < PAIRS_MIN:
        return {"places": [each["name"] for each in places], "by": TOO_FEW}
    lost = [each for each in places if _is_worse(_missed(first), _missed(each))]
    best, by = [each for each in places if each not in lost], list[str]()
    if lost:
        shares = (f"{each['succeeded']}/{each['flown']} ({each['name']})" for each in lost)
        by.append(f"{first['succeeded']}/{first['flown']} succeed, not {', '.join(shares)}")
    for name, (words, form, same) in JUDGED.items():
        if not all(name in each for each in best):
            continue
        first = min(best, key=itemgetter(name))
        values = first["by_seed"][name]
        lost = [each for each in best if _is_worse(values, each["by_seed"][name], same, SAME)]
        if lost:
            best = [each for each in best if each not in lost]
            others = (f"{form.format(each[name])} ({each['name']})" for each in lost)
            by.append(f"{words} {form.format(first[name])}, not {', '.join(others)}")
    return {"places": [each["name"] for each in best], "by": "; ".join(by)}


def _missed(place: Mapping[str, Any]) -> list[float]:
    """Return how many robots of a place failed with each seed, up to a constant."""
    return [-each for each in place["by_seed"]["succeeded"]]


def _is_worse(
    first: Sequence[float | None],
    other: Sequence[float | None],
    same: float = 0.0,
    share: float = 0.0,
) -> bool:
    """Return whether the exact sign test finds `other` larger than `first`; one value per seed.

    Values that differ by at most `same`, or by this `share` of the smaller one, count as equal.
    """
    known = [(a, b) for a, b in zip(first, other, strict=True) if a is not None and b is not None]
    larger = sum(b > a + max(same, share * a) for a, b in known)
    smaller = sum(a > b + max(same, share * b) for a, b in known)
    return larger > smaller and sign_test(smaller, larger) < LEVEL


def as_text(document: Mapping[str, Any]) -> str:
    """Format what `describe` returns: the table, and a line for each computing time and number."""
    rows = document["points"]
    count = len({each["place"] for each in rows})
    lines = list[str]()
    for each in document["best"]:
        names, by = each["places"], each["by"]
        all_of_them = "undecided" if by else "anywhere"
        where = all_of_them if len(names) == count > 1 else " or ".join(names) or "nowhere"
        robots = f"{each['robots']} robot{'s' * (each['robots'] > 1)}"
        lines.append(
            escape(f"{each['compute_ms']:g} ms, {robots}: {where}{f': {by}' if by else ''}")
        )
    shown = table(cells(rows, TABLE), right=(0, 1, *range(3, 10)))
    return "\n\n".join([shown, "\n".join(lines)])
