# SPDX-License-Identifier: Apache-2.0

"""Summarise the flight of a fleet: each robot, the worst and the median one, cell and cloud."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from math import inf
from operator import attrgetter
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cloudrc.base import source
from cloudrc.base.text import Paint, cells, escape, list_some, plain, table
from cloudrc.config.link_schedule import link_start
from cloudrc.config.resolved import ResolvedExperiment, fingerprint
from cloudrc.link.cell import Usage
from cloudrc.link.waiting import md1, nddd1
from cloudrc.results.metrics.verdict import EXIT_CODES
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.document import SCHEMA_VERSION
from cloudrc.results.report.summary import COLOURS

if TYPE_CHECKING:
    from cloudrc.flight.virtual.fleet import FleetRun

GRID_NS = 10_000_000
"""Time between two instants at which robots are compared [ns]: the period of the ground truth."""
AWAY = 0.5
"""Distance from the spawn from which on a robot may be near another [m]: all begin at the spawn."""
NUMBERS = {
    "age_ms": ("age_at_actuator_mean", 1e3),
    "age_p99_ms": ("age_at_actuator_p99", 1e3),
    "hold_s": ("hold_time", 1.0),
    "tracking_rms_m": ("tracking_rms_measured", 1.0),
    "cross_track_mm": ("cross_track_rms", 1e3),
    "settling_s": ("settling_time_mean", 1.0),
    "loss_uplink": ("loss_uplink", 1.0),
    "loss_downlink": ("loss_downlink", 1.0),
}
"""Number of a robot in the fleet's report -> number in its own report, factor from the SI unit."""
ROBOTS = {
    "robot": "{robot}",
    "age [ms]": "{age_ms:.0f}",
    "age p99 [ms]": "{age_p99_ms:.0f}",
    "HOLD [s]": "{hold_s:.2f}",
    "tracking RMS [m]": "{tracking_rms_m:.3f}",
    "lost up": "{loss_uplink:.2%}",
    "lost down": "{loss_downlink:.2%}",
    "cell drops": "{dropped:.0f}",
    "verdict": "{verdict}",
    "why": "{why}",
}
"""Head -> cell of the table of robots."""
CELL = {
    "cell": "{direction}",
    "load": "{load:.2f}",
    "busy": "{utilisation:.0%}",
    "mean wait [ms]": "{wait_mean_ms:.2f}",
    "N.D/D/1 [ms]": "{nddd1_ms:.2f}",
    "M/D/1 [ms]": "{md1_ms:.2f}",
    "longest wait [ms]": "{wait_max_ms:.2f}",
    "most waiting": "{waiting_max}",
    "dropped": "{dropped}",
}
"""Head -> cell of the table of cells."""
SHOWN = 10
"""Largest fleet of which the terminal shows each robot."""


@dataclass(slots=True)
class FleetFlown:
    """A fleet that has flown."""

    experiment: ResolvedExperiment
    mode: str = "virtual"
    log: list[Usage] = field(default_factory=list)  # what the cell has done
    cloud: Mapping[str, float] | None = None  # numbers of the shared cores, SI units
    robots: list[dict[str, Any]] = field(default_factory=list)  # what the report says of each
    # Of each robot, world frame [m], a row per `GRID_NS`, shape (n, 3).
    paths: list[NDArray[np.float64]] = field(default_factory=list)

    def share(self, fleet: FleetRun) -> None:
        """Take what the cell and the shared cores have done in virtual time."""
        self.log, cores = fleet.log, fleet.cores
        if cores is None or not cores.count:
            return
        duration, rate = fleet.now_ns * 1e-9, self.experiment.cloud.command_rate_hz
        each, busy = cores.count / len(fleet.members), cores.busy_ns * 1e-9 / cores.cores
        self.cloud = {
            "utilisation": busy / duration,
            "rate_hz": each / duration,
            "rate_expected_hz": min(rate, each / busy),
        }

    def add(
        self, recording: Recording, robot: ResolvedExperiment, document: Mapping[str, Any]
    ) -> None:
        """Take what is needed from the recording and the report of a robot."""
        number = robot.fleet.only or 0
        known = {name: each["value"] for name, each in document["numbers"].items()}
        row = {"robot": number, "verdict": document["verdict"]}
        if codes := [failure["code"] for failure in document["failures"]]:
            row |= {"codes": codes, "why": ", ".join(codes)}
        for name, (own, factor) in NUMBERS.items():
            if own in known:
                row[name] = known[own] * factor
        if known.get("duration") and "bytes_sent_uplink" in known:
            sent = known["bytes_sent_uplink"] + known["bytes_sent_downlink"]
            row["sent_kbit"] = sent / known["duration"] * 8e-3
        if self.log:
            row["dropped"] = sum(each.dropped.get(number, 0) for each in self.log)
        self.robots.append(row | {"records_sha256": document["records_sha256"]})
        truth = recording["/ground_truth"]
        if len(truth):
            grid = np.arange(0, truth["stamp_ns"][-1], GRID_NS)
            axes = [np.interp(grid, truth["stamp_ns"], axis) for axis in truth["position"].T]
            self.paths.append(np.stack(axes, axis=1))


def fleet_document(flown: FleetFlown) -> dict[str, Any]:
    """Return the content of the fleet's report.json."""
    experiment = flown.experiment
    # Pictures and scans are no packets of the theory's one size and period, either.
    senses = experiment.camera is not None or experiment.scans
    alone = not experiment.cell.traffic and not senses
    return {
        **judge_robots(flown.robots),
        "experiment": experiment.name,
        "config_sha256": fingerprint(experiment),
        "code": source.code_hash(),
        "mode": flown.mode,
        "seed": experiment.seed,
        "link_start": link_start(experiment),
        "cell": cell_rows(flown.log, len(flown.robots), alone=alone),
        "cloud": flown.cloud,
        "separation_min_m": separation_min(flown.paths, experiment.scene.spawn),
    }


def judge_robots(robots: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the part of the fleet's report.json about its robots, from what it says of each."""
    failed = [
        f"robot {robot['robot']} ({robot.get('why', robot['verdict'])})"
        for robot in robots
        if robot["verdict"] != "success"
    ]
    text = f"{len(failed)} of {len(robots)} robots did not succeed: {list_some(failed, 5)}"
    numbers = [*NUMBERS, "sent_kbit", "dropped"]
    values = {name: [robot[name] for robot in robots if name in robot] for name in numbers}
    return {
        "schemaVersion": SCHEMA_VERSION,
        "verdict": max((robot["verdict"] for robot in robots), key=EXIT_CODES.__getitem__),
        "failures": [{"code": "robots_failed", "text": text}] if failed else [],
        "succeeded": len(robots) - len(failed),
        "robots": [*robots],
        "median": {name: median(known) for name, known in values.items() if known},
        "worst": {name: max(known) for name, known in values.items() if known},
    }


def by_direction(log: Iterable[Usage]) -> dict[str, list[Usage]]:
    """Return direction -> what its cell has done."""
    found = defaultdict[str, list[Usage]](list)
    for each in log:
        found[each.direction].append(each)
    return found


def cell_rows(log: Iterable[Usage], senders: int, *, alone: bool) -> list[dict[str, Any]]:
    """Return `cell_numbers` of each direction in which packets have left."""
    ways = by_direction(log).values()
    return [cell_numbers(way, senders, alone=alone) for way in ways if any(u.packets for u in way)]


def cell_numbers(done: Sequence[Usage], senders: int, *, alone: bool) -> dict[str, Any]:
    """Return the numbers of the cell of a direction; a wait without end is None.

    `senders` is the number of robots, which are `alone` if telemetry is all that is sent.
    """
    way, duration = done[-1].direction, done[-1].time_s
    names = "packets", "busy_ns", "waited_ns"
    packets, busy_ns, waited_ns = (sum(map(attrgetter(name), done)) for name in names)
    dropped = sum(sum(each.dropped.values()) for each in done)
    service, rate = busy_ns * 1e-9 / packets, (packets + dropped) / duration  # [s], offered [1/s]
    expected = dict[str, float]()
    if way != "both" and alone:
        expected["nddd1_ms"] = nddd1(senders, senders / rate, service)
        expected["md1_ms"] = md1(rate * service, service)
    return {
        "direction": way,
        "load": rate * service,
        "utilisation": busy_ns * 1e-9 / duration,
        "wait_mean_ms": waited_ns * 1e-6 / packets,
        **{name: wait * 1e3 if wait < inf else None for name, wait in expected.items()},
        "wait_max_ms": max(each.longest_ns for each in done) * 1e-6,
        "waiting_max": max(each.most for each in done),
        "packets": packets,
        "dropped": dropped,
    }


def separation_min(
    paths: Sequence[NDArray[np.float64]], spawn: tuple[float, float, float]
) -> float | None:
    """Return the smallest distance of two robots [m], had they flown in one scene.

    `paths` have positions at equal times [m], shapes (n, 3). Instants at which both are within
    `AWAY` of the `spawn` [m] do not count. None if there are no others.
    """
    smallest = inf
    for pair in combinations(paths, 2):
        length = min(map(len, pair))
        one, other = (path[:length] for path in pair)
        away = np.linalg.norm([one - spawn, other - spawn], axis=2).max(axis=0) > AWAY
        smallest = np.linalg.norm(one - other, axis=1)[away].min(initial=smallest)
    return float(smallest) if smallest < inf else None


def tables(document: Mapping[str, Any], most: int = 1000) -> Iterator[list[tuple[str, ...]]]:
    """Yield the tables of robots and cell; of more than `most` robots, only failed ones."""
    robots = document["robots"]
    if len(robots) > most:
        robots = [robot for robot in robots if robot["verdict"] != "success"][:most]
    middle = {"robot": "median", **document["median"], "verdict": ""}
    worst = {"robot": "worst", **document["worst"], "verdict": ""}
    yield cells([middle, worst, *robots], ROBOTS)
    if document["cell"]:
        yield cells(document["cell"], CELL)


def remarks(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield sentences about cell, cloud and the robots' distance."""
    for way in document["cell"]:
        if way["load"] > 1 and way["dropped"]:
            words = f"load {way['load']:.2f}, {way['dropped']} packets dropped"
            yield f"cell overloaded: {way['direction']}, {words}"
    if (cloud := document["cloud"]) is not None:
        yield (
            f"cloud: cores busy {cloud['utilisation']:.0%}, each robot gets "
            f"{cloud['rate_hz']:.0f} commands a second; {cloud['rate_expected_hz']:.0f} by "
            "arithmetic"
        )
    if (nearest := document["separation_min_m"]) is not None:
        yield f"in one scene, two robots would have come within {nearest:.2f} m of each other"


def summarize_fleet(document: Mapping[str, Any], paint: Paint = plain) -> str:
    """Summarize a fleet's report as text."""
    outcome, failures = document["verdict"], document["failures"]
    first = failures[0]["text"] if failures else f"all {len(document['robots'])} robots succeeded"
    head = f"{paint(outcome.upper(), COLOURS[outcome])}: {escape(first)}"
    shown = (table(rows, right=range(1, 9)) for rows in tables(document, SHOWN))
    return "\n\n".join(filter(None, [head, *shown, "\n".join(remarks(document))]))
