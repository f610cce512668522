# SPDX-License-Identifier: Apache-2.0

"""Judge the paper's statements by the rows of flights, and say what is not reproduced, and why.

Source: the paper, section on experiments, and the code that its authors published.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from statistics import median
from typing import Any, NamedTuple, TypeAlias

from cloudrc.base.statistics import sign_test
from cloudrc.flight.trials.rows import Row
from cloudrc.studies.reproduce.flights import ALL, HALVED, LINKS, PUBLISHED, RAISED, WORST

Cells: TypeAlias = Mapping[tuple[str, str, str], Sequence[Row]]
"""Order, column and limit of a hover ("": the mission) -> the rows of these flights."""
Cell: TypeAlias = Callable[[Sequence[Row]], str]
"""Function that returns the text of a cell of the table for the flights of its condition."""
WAYPOINTS = 7
"""Number of waypoints of the mission."""
SMALL = 1e-3
"""The paper's "0.1 cm" [m]."""
NEAR = 0.05
"""Largest relative difference between offered and measured delay of a link that is as asked [1]."""
PAPER = (*LINKS, ALL)
"""Columns of the paper's own links."""


class Statement(NamedTuple):
    """What the paper states, whether the flights show it, and where they differ."""

    number: int
    claim: str  # in our words
    holds: Callable[[Cells], bool]
    found: Callable[[Cells], str]  # numbers of the published scheme, if it names no other
    differs: str  # what differs from the paper, and why


class TableRow(NamedTuple):
    """A row of the table for each order."""

    statement: int
    label: str
    cell: Cell
    hover: str = ""  # limit of the onboard integral term in these flights [m]; "": the mission


def group(rows: Iterable[Row]) -> Cells:
    """Group rows by their conditions."""
    found = dict[tuple[str, str, str], list[Row]]()
    for row in rows:
        point = row["point"]
        found.setdefault((point["order"], point["column"], point["hover"]), []).append(row)
    return found


def values(rows: Iterable[Row], name: str) -> list[Any]:
    """Return a number of each flight that has it; lists of several flights become one."""
    found = list[Any]()
    for row in rows:
        value = row.get("measured", {}).get(name, row["numbers"].get(name))
        found += value if isinstance(value, list) else [value]
    return [each for each in found if each is not None]


def _measured(row: Row, name: str) -> list[Any]:
    """Return a list that was measured in a flight; [] if the flight has none."""
    found: list[Any] = row.get("measured", {}).get(name, [])
    return found


def middle(name: str, form: str, factor: float = 1.0) -> Cell:
    """Return the median of a number of the flights, multiplied by `factor` [1]."""

    def cell(rows: Sequence[Row]) -> str:
        found = values(rows, name)
        return format(factor * median(found), form) if found else "-"

    return cell


def span(name: str, form: str, factor: float = 1.0) -> Cell:
    """Return the range of a number over all flights, multiplied by `factor` [1]."""

    def cell(rows: Sequence[Row]) -> str:
        found = values(rows, name)
        ends = [format(factor * end(found), form) for end in (min, max)] if found else []
        return " to ".join(dict.fromkeys(ends)) or "-"

    return cell


def delays(name: str) -> Cell:
    """Return mean and half of the range of delays, the median over the flights [ms], by part."""

    def cell(rows: Sequence[Row]) -> str:
        parts = zip(*filter(None, (_measured(row, name) for row in rows)), strict=False)
        shown = (
            "±".join(f"{round(1e3 * median(each), 1):g}" for each in zip(*part, strict=True))
            for part in parts
        )
        return ", ".join(shown) or "-"

    return cell


def offered(factor: float) -> Cell:
    """Return delay and jitter of a link of the paper [ms], multiplied by `factor` [1]."""

    def cell(rows: Sequence[Row]) -> str:
        column = rows[0]["point"]["column"]
        names = [column] if column in LINKS else [*LINKS] if column in (ALL, HALVED) else []
        scale = factor * (0.5 if column == HALVED else 1.0)
        links = [LINKS[name] for name in names]
        shown = (f"{scale * delay:g}±{scale * jitter:g}" for delay, jitter in links)
        return ", ".join(shown) or "-"

    return cell


def half_after(rows: Sequence[Row]) -> str:
    """Return the median time after which half of each change is seen [s], or "never"."""
    flights = [_measured(row, "half_after") for row in rows]
    shown = []
    for each in zip(*flights, strict=False):
        known = [time for time in each if time is not None]
        shown.append(f"{median(known):.1f}" if len(known) > len(each) / 2 else "never")
    return ", ".join(shown) or "-"


def lower(rows: Sequence[Row]) -> str:
    """Count the flights in which the estimated error is below the measured one; exact sign test."""
    pairs = _pairs(rows)
    less = sum(estimated < measured for measured, estimated in pairs)
    more = sum(estimated > measured for measured, estimated in pairs)
    return f"{less}/{len(pairs)}, p {sign_test(less, more):.2g}" if pairs else "-"


def _pairs(rows: Iterable[Row]) -> list[tuple[float, float]]:
    names = "tracking_rms_measured", "tracking_rms_estimated"
    numbers = [row["numbers"] for row in rows]
    return [(each[names[0]], each[names[1]]) for each in numbers if each.keys() >= {*names}]


def reached(rows: Sequence[Row]) -> str:
    """Return how many waypoints the flights reached, of how many."""
    return f"{sum(values(rows, 'waypoints_reached')):.0f}/{WAYPOINTS * len(rows)}"


def falls(rows: Sequence[Row]) -> str:
    """Count the waypoints of all flights at which the error falls to a tenth of its peak."""
    every = [each for row in rows for each in _measured(row, "fallen")]
    return f"{len(every) - every.count(None)}/{len(every)}"


def _falls(row: Row) -> bool:
    """Whether the error falls to a tenth at each waypoint but the first and the last."""
    between = _measured(row, "fallen")[1:-1]
    return bool(between) and None not in between


def where(rows: Sequence[Row]) -> str:
    """Return ": " and at which waypoints the error falls, if it is all but the ends; else ""."""
    flights = [_measured(row, "fallen") for row in rows]
    ends = [end for fallen in flights for end in (*fallen[:1], *fallen[-1:])]
    is_between = all(map(_falls, rows)) and ends.count(None) == len(ends)
    return ": all but the first and the last" if is_between else ""


def touching(rows: Sequence[Row]) -> str:
    """Count the flights that touch a pipe or another obstacle."""
    return f"{sum(each > 0 for each in values(rows, 'obstacle_contacts'))}/{len(rows)}"


HOVER = span("steady_error_x", ".2f", 1e3)
QUANTITIES = (
    TableRow(1, "one way, offered [ms]", offered(1.0)),
    TableRow(1, "one way, measured [ms]", delays("one_way")),
    TableRow(1, "round trip, offered [ms]", offered(2.0)),
    TableRow(1, "round trip, measured [ms]", delays("round_trip")),
    TableRow(2, "sd of the samples tau_n [ms]", middle("samples_sd", ".1f", 1e3)),
    TableRow(2, "sd of the estimate, eq. (1) [ms]", middle("estimate_sd", ".1f", 1e3)),
    TableRow(2, "half of each change is seen after [s]", half_after),
    TableRow(2, "the estimate is too low at the end by [ms]", middle("behind", ".0f", 1e3)),
    TableRow(3, "waypoints reached", reached),
    TableRow(4, "RMS, reference - measured [m]", middle("tracking_rms_measured", ".3f")),
    TableRow(4, "RMS, reference - estimated [m]", middle("tracking_rms_estimated", ".3f")),
    TableRow(4, "flights in which the second is lower", lower),
    TableRow(4, "RMS, estimated - true [mm]", middle("prediction_error_rms", ".0f", 1e3)),
    TableRow(5, "error at a new waypoint [m]", span("peak", ".2f")),
    TableRow(5, "a tenth of it after [s]", span("fallen", ".1f")),
    TableRow(5, "waypoints at which it is", falls),
    TableRow(6, "error before the next waypoint [mm]", span("left", ".0f", 1e3)),
    *(
        TableRow(6, f"in a hover, integral limit {limit} m, x [mm]", HOVER, limit)
        for limit in (PUBLISHED, RAISED)
    ),
    TableRow(7, "clearance in the pipes [m]", span("min_clearance", ".3f")),
    TableRow(7, "flights that touch a pipe", touching),
    TableRow(8, "speed of the touch [m/s]", span("touch_speed", ".3f")),
    TableRow(8, "force after it [N]", span("steady_contact_force", ".2f")),
)


def missions(cells: Cells) -> list[Row]:
    """Return the missions over the links of the paper, of both orders."""
    own = ((column, hover, rows) for (_, column, hover), rows in cells.items())
    return [row for column, hover, rows in own if column in PAPER and not hover for row in rows]


def at(cells: Cells, cell: Cell, column: str = ALL, hover: str = "") -> str:
    """Return the text of a cell of the published scheme, or of a hover."""
    return cell(cells["newest" if hover else "arrival", column, hover])


def _is_as_offered(cells: Cells) -> bool:
    def is_near(rows: Sequence[Row], asked: Sequence[float]) -> bool:
        parts = values(rows, "one_way")
        return bool(parts) and all(
            abs(1e3 * value / wanted - 1.0) < NEAR
            for part in parts
            for value, wanted in zip(part, asked, strict=True)
        )

    return all(is_near(cells["arrival", name, ""], asked) for name, asked in LINKS.items())


def _is_filtered(cells: Cells) -> bool:
    rows = [row for name in LINKS for row in cells["arrival", name, ""]]
    both = [*zip(values(rows, "samples_sd"), values(rows, "estimate_sd"), strict=True)]
    return bool(both) and all(estimate < samples for samples, estimate in both)


def _is_lower(cells: Cells) -> bool:
    pairs = _pairs(missions(cells))
    return bool(pairs) and all(estimated < measured for measured, estimated in pairs)


def _is_settled(cells: Cells) -> bool:
    rows = cells["newest", WORST, PUBLISHED]
    left = [*values(rows, "steady_error_x"), *values(missions(cells), "left")]
    return bool(left) and max(left) < SMALL


def _every(holds: Callable[[Row], bool]) -> Callable[[Cells], bool]:
    return lambda cells: all(map(holds, missions(cells)))


STATEMENTS = (
    Statement(
        1,
        "delays of 20 to 70 ms, jitter of 10 to 40 ms",
        _is_as_offered,
        lambda cells: (
            f"each way {at(cells, delays('one_way'))} ms; "
            f"round trip {at(cells, delays('round_trip'))} ms"
        ),
        "The paper does not say whether these are of one way or of the round trip; its figure has "
        "the title round trip, and its code plots one way. P1 to P3 read them as one way, `halved` "
        "as the round trip. Only a command that the robot follows has a round trip: where the "
        "newest command wins, late ones are dropped, and the round trips are shorter.",
    ),
    Statement(
        2,
        "eq. (1) filters the peaks of the delay",
        _is_filtered,
        lambda cells: (
            f"standard deviation {at(cells, middle('samples_sd', '.0f', 1e3), WORST)} ms, after "
            f"it {at(cells, middle('estimate_sd', '.1f', 1e3), WORST)} ms ({WORST}); half of the "
            f"changes to P2 and P3 is seen after [s]: {at(cells, half_after)}"
        ),
        "Eq. (1) as printed averages over all samples: after a change it needs as long again as it "
        "has run. The published code counts 500 samples at most and forgets sooner: "
        "cloud.estimator=running_mean_500.",
    ),
    Statement(
        3,
        "all waypoints are reached",
        _every(lambda row: row["numbers"].get("waypoints_reached") == WAYPOINTS),
        lambda cells: f"{reached(missions(cells))} waypoints (both orders)",
        "A script sets the waypoints, in place of a person.",
    ),
    Statement(
        4,
        "the RMS error is lower to the estimated than to the measured position",
        _is_lower,
        lambda cells: (
            f"{at(cells, middle('tracking_rms_estimated', '.2f'))} m and "
            f"{at(cells, middle('tracking_rms_measured', '.2f'))} m; lower in "
            f"{at(cells, lower)}"
        ),
        "The distance to the next waypoint decides both numbers, so that they do not say how good "
        "the estimate is. Its distance from the truth does: the last row.",
    ),
    Statement(
        5,
        "the error jumps at each new waypoint and falls again",
        _every(_falls),
        lambda cells: (
            f"peaks of {at(cells, span('peak', '.1f'))} m; a tenth of that after "
            f"{at(cells, span('fallen', '.1f'))} s, at {at(cells, falls)} waypoints"
            f"{at(cells, where)}"
        ),
        "The first waypoint counts as reached at 0.15 m, before the error is a tenth. At the last "
        "one the board stops the robot 0.1 m before the setpoint.",
    ),
    Statement(
        6,
        "the errors settle below 0.1 cm",
        _is_settled,
        lambda cells: (
            f"{at(cells, HOVER, WORST, PUBLISHED)} mm in a hover (newest), "
            f"{at(cells, HOVER, WORST, RAISED)} mm with a higher onboard integral limit (newest); "
            f"{at(cells, span('left', '.0f', 1e3))} mm before the next waypoint"
        ),
        "The weight of the arm needs 0.204 N in x, and the integral term of the published onboard "
        f"controller ends at 0.1 N: a limit of {RAISED} m in place of {PUBLISHED} m is enough. On "
        "the way, the script goes on at 0.1 m, before the robot has settled. The paper's figure "
        "has an axis in metres.",
    ),
    Statement(
        7,
        "the robot flies through the tubes",
        _every(
            lambda row: (
                row["numbers"].get("min_clearance", 0.0) > 0.0
                and row["numbers"]["obstacle_contacts"] == 0
            )
        ),
        lambda cells: (
            f"{at(cells, span('min_clearance', '.3f'))} m of room; touched in "
            f"{touching(missions(cells))} flights (both orders)"
        ),
        "The paper has no number.",
    ),
    Statement(
        8,
        "the robot touches the target",
        _every(lambda row: row["verdict"] == "success" and "touch_speed" in row["numbers"]),
        lambda cells: (
            f"at {at(cells, span('touch_speed', '.2f'))} m/s, then "
            f"{at(cells, span('steady_contact_force', '.2f'))} N"
        ),
        "The paper has no number. The peak of the force depends on the simulator; speed and steady "
        "force do not.",
    ),
)
MISSING = {
    "Gazebo and RotorS": "MuJoCo, with the masses, rotors and onboard controller of the paper",
    "ROS": "the ends exchange own datagrams; `examples/ros2` has the paper's nodes",
    "tc": "the same delays, drawn in virtual time; `--mode cluster` flies over netem",
    "a person who steers": "a script of waypoints",
    "pictures of the flight": "`cloudrc replay`",
    "limits of CPU and memory": "nothing: the paper has no number for them",
}
"""What is not reproduced -> what stands in its place."""
