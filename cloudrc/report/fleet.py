"""Summarise the flight of a fleet: each robot, the worst and the median one, cell and cloud."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import inf, isfinite
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloudrc import source
from cloudrc.config.resolved import ResolvedExperiment, fingerprint
from cloudrc.config.scene import scene_of
from cloudrc.drivers.fleet import SharedCores
from cloudrc.link.cell import Cell, Usage
from cloudrc.link.waiting import md1, nddd1
from cloudrc.record.columns import Recording
from cloudrc.report.document import SCHEMA_VERSION
from cloudrc.report.summary import COLOURS
from cloudrc.text import Paint, escape, list_some, plain, table

GRID_NS = 10_000_000
"""Time between two instants at which robots are compared [ns]: the period of the ground truth."""
AWAY = 0.5
"""Distance from the spawn from which on a robot may be near another [m]: all begin at the spawn."""
COLUMNS = {
    "age_at_actuator_mean": ("age", "ms", 1e3, 0),
    "age_at_actuator_p99": ("age p99", "ms", 1e3, 0),
    "hold_time": ("HOLD", "s", 1.0, 2),
    "tracking_rms_measured": ("tracking RMS", "m", 1.0, 3),
    "loss_uplink": ("lost up", "%", 1e2, 2),
    "loss_downlink": ("lost down", "%", 1e2, 2),
    "cell_dropped": ("cell drops", "", 1.0, 0),
}
"""Number of a robot -> title of its column, unit, factor from the SI unit, decimals. The largest
one is the worst."""
SHOWN = 10
"""Largest fleet of which the terminal shows each robot."""


class CellRow(NamedTuple):
    """What a cell did in a period."""

    now_ns: int  # its end [ns]
    way: str
    usage: Usage


class CellLog:
    """What the cells of a fleet do, period by period."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        """Take the cells of uplink and downlink, or the one that both share."""
        ways = ("both",) if len(cells) == 1 else ("uplink", "downlink")
        self.cells = dict(zip(ways, cells, strict=False))
        self.rows: list[CellRow] = []

    def take(self, now_ns: int) -> None:
        """End a period at `now_ns` [ns]."""
        for way, cell in self.cells.items():
            self.rows.append(CellRow(now_ns, way, cell.usage))
            cell.usage = Usage()

    def dropped(self, way: str) -> Counter[int]:
        """Return robot -> number of its packets that were dropped; robots below 0 are others."""
        found = Counter[int]()
        for row in self.of(way):
            found.update(row.usage.dropped)
        return found

    def of(self, way: str) -> list[CellRow]:
        """Return the rows of a way."""
        return [row for row in self.rows if row.way == way]

    def as_csv(self) -> str:
        """Return the rows as the text of a CSV file."""
        lines = ["time_s,direction,packets,bytes,busy_s,wait_mean_s,wait_max_s,waiting_max,dropped"]
        for now_ns, way, usage in self.rows:
            mean = usage.waited_ns / usage.packets * 1e-9 if usage.packets else 0.0
            values = f"{usage.busy_ns * 1e-9:.6f},{mean:.6f},{usage.longest_ns * 1e-9:.6f}"
            count = sum(usage.dropped.values())
            head = f"{now_ns * 1e-9:.1f},{way},{usage.packets},{usage.size}"
            lines.append(f"{head},{values},{usage.most},{count}")
        return "\n".join([*lines, ""])


@dataclass(frozen=True, slots=True)
class RobotFlown:
    """What the fleet's report needs of a robot's flight."""

    number: int
    document: Mapping[str, Any]  # its report.json
    stamps_ns: NDArray[np.int64]  # of its positions [ns], shape (n,)
    positions: NDArray[np.float64]  # true ones [m], world frame, shape (n, 3)
    spawn: tuple[float, float, float]  # [m], world frame

    @staticmethod
    def of(
        recording: Recording, robot: ResolvedExperiment, document: Mapping[str, Any]
    ) -> RobotFlown:
        """Take what is needed from the recording and the report of a robot."""
        truth, number = recording["/ground_truth"], robot.fleet.only or 0
        spawn = scene_of(robot.world).spawn
        return RobotFlown(number, document, truth["stamp_ns"], truth["position"], spawn)

    def value(self, name: str, log: CellLog) -> float | None:
        """Return a number of `COLUMNS` in SI units; None if it is unknown."""
        if name == "cell_dropped":
            return sum(log.dropped(way)[self.number] for way in log.cells) if log.cells else None
        found = self.document["numbers"].get(name)
        return None if found is None else float(found["value"])


@dataclass(frozen=True, slots=True)
class FleetFlown:
    """A fleet that has flown."""

    experiment: ResolvedExperiment
    robots: Sequence[RobotFlown]
    log: CellLog
    cores: SharedCores | None
    now_ns: int  # end of the flight [ns]


def fleet_document(flown: FleetFlown) -> dict[str, Any]:
    """Return the content of the fleet's report.json."""
    experiment, robots = flown.experiment, flown.robots
    outcomes = [robot.document["verdict"] for robot in robots]
    failed = [
        f"robot {robot.number} ({', '.join(_codes(robot)) or robot.document['verdict']})"
        for robot in robots
        if robot.document["verdict"] != "success"
    ]
    text = f"{len(failed)} of {len(robots)} robots failed: {list_some(failed, 5)}"
    order = ("interrupted", "invalid", "failure", "success")
    separation = separation_min(robots)
    return {
        "schemaVersion": SCHEMA_VERSION,
        "verdict": next(outcome for outcome in order if outcome in outcomes),
        "failures": [{"code": "robots_failed", "text": text}] if failed else [],
        "experiment": experiment.name,
        "config_sha256": fingerprint(experiment),
        "code": source.code_hash(),
        "mode": "virtual",
        "seed": experiment.seed,
        "succeeded": len(robots) - len(failed),
        "robots": [
            {
                "robot": robot.number,
                "verdict": robot.document["verdict"],
                "failures": _codes(robot),
                **{name: robot.value(name, flown.log) for name in COLUMNS},
                "records_sha256": robot.document["records_sha256"],
            }
            for robot in robots
        ],
        "median": {name: _over(flown, name, median) for name in COLUMNS},
        "worst": {name: _over(flown, name, max) for name in COLUMNS},
        "cell": {way: _cell(flown, way) for way in flown.log.cells},
        "cloud": _cloud(flown),
        "separation_min": separation if isfinite(separation) else None,
    }


def _codes(robot: RobotFlown) -> list[str]:
    return [failure["code"] for failure in robot.document["failures"]]


def _over(flown: FleetFlown, name: str, of: Callable[[list[float]], float]) -> float | None:
    values = [robot.value(name, flown.log) for robot in flown.robots]
    known = [value for value in values if value is not None]
    return of(known) if known else None


def _cell(flown: FleetFlown, way: str) -> dict[str, Any]:
    """Return the numbers of a cell in SI units."""
    every, duration = [row.usage for row in flown.log.of(way)], flown.now_ns * 1e-9
    packets, busy = sum(use.packets for use in every), sum(use.busy_ns for use in every) * 1e-9
    dropped = flown.log.dropped(way)
    service = busy / packets if packets else 0.0
    rate = (packets + dropped.total()) / duration if duration else 0.0  # offered [1/s]
    found = {
        "utilisation": busy / duration if duration else 0.0,
        "load": rate * service,
        "packets": packets,
        "dropped": dropped.total(),
        "dropped_of_others": sum(count for flow, count in dropped.items() if flow < 0),
        "wait_mean": sum(use.waited_ns for use in every) * 1e-9 / packets if packets else 0.0,
        "wait_max": max((use.longest_ns for use in every), default=0) * 1e-9,
        "waiting_max": max((use.most for use in every), default=0),
    }
    theory = {"wait_mean_md1": md1(rate * service, service)}
    if packets and way != "both" and not flown.experiment.cell.traffic:
        senders = len(flown.robots)
        theory["wait_mean_nddd1"] = nddd1(senders, senders / rate, service)
    return found | {key: value if value < inf else None for key, value in theory.items()}


def _cloud(flown: FleetFlown) -> dict[str, Any] | None:
    """Return the numbers of the shared cores in SI units; None without shared cores."""
    cores, duration = flown.cores, flown.now_ns * 1e-9
    if cores is None or not cores.count:
        return None
    service, robots = cores.busy_ns * 1e-9 / cores.count, len(flown.robots)
    rate = flown.experiment.cloud.command_rate_hz
    return {
        "utilisation": cores.busy_ns * 1e-9 / (cores.cores * duration),
        "rate": cores.count / robots / duration,
        "rate_expected": min(rate, cores.cores / (robots * service)),
    }


def separation_min(robots: Sequence[RobotFlown]) -> float:
    """Return the smallest distance of two robots, had they flown in one scene [m].

    Instants at which both are within `AWAY` of their spawn do not count. Infinite if no two robots
    are in flight together.
    """
    end_ns = max((robot.stamps_ns[-1] for robot in robots if len(robot.stamps_ns)), default=0)
    grid = np.arange(0, end_ns, GRID_NS)
    paths = [_path(robot, grid) for robot in robots if len(robot.stamps_ns)]
    smallest = inf
    for (one, one_away), (other, other_away) in combinations(paths, 2):
        distance = np.linalg.norm(one - other, axis=1)[one_away | other_away]
        smallest = min(smallest, np.nanmin(distance, initial=inf))
    return float(smallest)


def _path(
    robot: RobotFlown, grid: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return positions at the times `grid` [ns], NaN outside of the flight, and which are away."""
    none = {"left": np.nan, "right": np.nan}
    axes = [np.interp(grid, robot.stamps_ns, axis, **none) for axis in robot.positions.T]
    positions = np.stack(axes, axis=1)
    return positions, np.linalg.norm(positions - robot.spawn, axis=1) > AWAY


def robot_rows(document: Mapping[str, Any], most: int | None = None) -> list[list[str]]:
    """Return the table of the robots, with its heads; of more than `most`, only failed ones."""
    shown = [name for name in COLUMNS if document["worst"][name] is not None]
    titles = [COLUMNS[name] for name in shown]
    heads = [f"{title} [{unit}]" if unit else title for title, unit, _, _ in titles]
    rows = [["robot", *heads, "verdict"]]
    robots = document["robots"]
    count = f"{document['succeeded']} of {len(robots)} succeeded"
    rows += [["median", *_digits(document["median"], shown), count]]
    rows += [["worst", *_digits(document["worst"], shown), ""]]
    if most is not None and len(robots) > most:
        robots = [robot for robot in robots if robot["verdict"] != "success"][:most]
    for robot in robots:
        why = ", ".join(robot["failures"]) or robot["verdict"]
        rows.append([str(robot["robot"]), *_digits(robot, shown), why])
    return rows


def _digits(numbers: Mapping[str, Any], shown: Sequence[str]) -> Iterator[str]:
    for name in shown:
        _, _, factor, places = COLUMNS[name]
        value = numbers[name]
        yield "-" if value is None else f"{value * factor:.{places}f}"


def cell_rows(document: Mapping[str, Any]) -> list[list[str]]:
    """Return the table of the cell, with its heads; [] without a cell."""
    heads = ["cell", "load", "busy [%]", "mean wait [ms]", "N.D/D/1 [ms]", "M/D/1 [ms]"]
    rows = [[*heads, "longest wait [ms]", "most waiting", "dropped"]]
    for way, cell in document["cell"].items():
        waits = (
            ("-" if key not in cell else "overload" if cell[key] is None else _ms(cell[key]))
            for key in ("wait_mean", "wait_mean_nddd1", "wait_mean_md1")
        )
        shares = f"{cell['load']:.2f}", f"{cell['utilisation'] * 100:.0f}"
        last = _ms(cell["wait_max"]), str(cell["waiting_max"]), str(cell["dropped"])
        rows.append([way, *shares, *waits, *last])
    return rows if len(rows) > 1 else []


def _ms(value: float) -> str:
    return f"{value * 1e3:.2f}"


def remarks(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences about cloud and the robots' distance."""
    if (cloud := document["cloud"]) is not None:
        yield (
            f"cloud: cores busy {cloud['utilisation'] * 100:.0f} %, each robot gets "
            f"{cloud['rate']:.0f} commands a second; {cloud['rate_expected']:.0f} by arithmetic"
        )
    if (nearest := document["separation_min"]) is not None:
        yield f"in one scene, two robots would have come within {nearest:.2f} m of each other"


def summarize_fleet(document: Mapping[str, Any], paint: Paint = plain) -> str:
    """Summarize a fleet's report as text."""
    outcome, failures = document["verdict"], document["failures"]
    first = failures[0]["text"] if failures else f"all {len(document['robots'])} robots succeeded"
    robots = robot_rows(document, SHOWN)
    parts = [table(robots, right=range(1, len(robots[0]) - 1))]
    if cell := cell_rows(document):
        parts.append(table(cell, right=range(1, len(cell[0]))))
    if lines := "\n".join(remarks(document)):
        parts.append(lines)
    head = f"{paint(outcome.upper(), COLOURS[outcome])}: {escape(first)}"
    return "\n\n".join([head, *parts])
