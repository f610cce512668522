# SPDX-License-Identifier: Apache-2.0

"""Find how many robots a cell and a cloud carry: the largest fleet in which all robots succeed.

Success need not fall steadily with the size of the fleet. So the search finds the cliff with one
seed, and then the sizes around it fly with all seeds.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import islice, product
from operator import itemgetter
from statistics import fmean, median_low
from typing import Any

from cloudrc.base.errors import NothingFlownError
from cloudrc.base.statistics import exact_interval, median_interval
from cloudrc.config.compute import compute_times
from cloudrc.config.problems import problem_at
from cloudrc.flight.experiment import load, robots_of
from cloudrc.flight.in_memory import ERROR
from cloudrc.flight.trials.fingerprint import experiment_facts, fingerprint
from cloudrc.flight.trials.fleet import alone, plan_fleet
from cloudrc.flight.trials.plan import PlannedFlight
from cloudrc.flight.trials.play import run
from cloudrc.flight.trials.rows import Row, Rows
from cloudrc.link.model import HEADER_BYTES
from cloudrc.link.profile import DIRECTIONS
from cloudrc.link.waiting import nddd1

SLACK = 1.4
"""Time limit of a mission, as a multiple of its duration alone [1]: a robot in HOLD would fly on
until the limit of the experiment, three times that."""
BASES = 4
"""Smallest number of robots that fly alone first; one may fail by itself."""
GROWTH = 2
"""Growth of the fleet from one size to the next, until one fails [1]."""
RESUME_HZ = 20.0
"""Rate of commands below which a HOLD does not end [1/s].
Source: docs/safety.md, "Leaving HOLD": 10 commands within 500 ms."""
CLOSE = 0.9
"""Share of a limit from which on a number counts as near it [1]."""


@dataclass(frozen=True)
class Sought:
    """The question of `cloudrc capacity`."""

    experiment: str  # name of a shipped experiment, or path of a YAML file
    set: Sequence[str]  # KEY=VALUE
    cell: float | None  # rate of the cell [kbit/s]; None: that of the experiment
    queue: Sequence[str]  # NAME or NAME:PACKETS; []: that of the experiment
    controllers: Sequence[str]  # []: that of the experiment
    seeds: int  # the fleets have the seeds 1 to `seeds`
    max: int  # largest fleet to try

    def conditions(self) -> list[Condition]:
        """Load the experiment under all conditions."""
        pairs = product(self.queue or [""], self.controllers or [""])
        return [Condition(self, queue, controller) for queue, controller in pairs]


def search(start: int, top: int, succeeds: Callable[[int], bool]) -> Iterator[int]:
    """Yield sizes of fleets to try, up to `top`; after each, `succeeds` tells whether it does.

    It ends at a size that succeeds next to one that fails.
    """
    yes, no, size = 0, top + 1, min(start, top)
    while no - yes > 1:
        yield size
        if succeeds(size):
            yes = size
        else:
            no = size
        size = min(top, max(yes + 1, yes * GROWTH)) if no > top else (yes + no) // 2


class Condition:
    """One queue and one controller.

    Attributes:
        point: Axis -> value, without the number of robots.
        bases: Flights alone, with seed 1, of the first robots.
        arithmetic: Number of robots that fill each shared medium; `set_base` finds it.
        theory: The same by queueing theory: the largest number that gets commands in time.
        traffic: What a robot sends in the cell, per direction.
        time_limit: Time limit of the mission [s].
        fleets: The rows of the fleets that have flown: number of robots -> seed -> row.
    """

    def __init__(self, asked: Sought, queue: str, controller: str) -> None:
        """Load the experiment."""
        name, _, packets = queue.partition(":")
        given = {
            "cell.rate_kbit": asked.cell,
            "cell.queue": name,
            "cell.queue_packets": packets,
            "cloud.controller": controller,
        }
        own = [f"{key}={value}" for key, value in given.items() if value]
        self._asked, self._settings = asked, [*asked.set, *own, "fleet.only=null"]
        self.point = dict[str, Any]()
        self.fleet = self.flight(BASES).resolved
        cell, cloud = self.fleet.cell, self.fleet.cloud
        if cell.rate_kbit is None and not (cloud.cores and cloud.compute_ms):
            text = "the robots share nothing; give a rate [kbit/s], or --set cloud.cores=1 with"
            raise problem_at("--cell", f"{text} --set cloud.compute_ms=2")
        shown = cell.queue if cell.queue == "newest" else f"{cell.queue} {cell.queue_packets}"
        shown = shown if cell.rate_kbit else "no cell"
        self.point |= {"queue": shown, "controller": cloud.controller.name}
        self.bases = list[PlannedFlight]()
        kinds = max(BASES, len(self.fleet.fleet.vary))
        settings = [*self._settings, f"fleet.robots={kinds}"]
        fleet = load(asked.experiment, settings, fleets=True)
        for robot in map(alone, robots_of(fleet, asked.experiment, settings)):
            facts = fingerprint(experiment_facts(robot))
            self.bases.append(PlannedFlight(facts, {"robot": robot.fleet.only}, 1, robot))
        self.arithmetic, self.theory = dict[str, float](), dict[str, int]()
        self.traffic = dict[str, dict[str, float]]()
        self.time_limit = self.fleet.criteria.time_limit_s
        self.fleets = defaultdict[int, dict[int, Row]](dict)

    def flight(self, robots: int) -> PlannedFlight:
        """Load a fleet; return its flight with seed 1, until a failure."""
        settings, point = [*self._settings, f"fleet.robots={robots}"], {"robots": robots}
        experiment = self._asked.experiment
        return plan_fleet(experiment, settings, self.point | point, until_failure=True)

    def set_base(self, rows: Sequence[Row]) -> None:
        """Take the flights alone: time limit, arithmetic and theory."""
        numbers = [row["numbers"] for row in rows if row["verdict"] == "success"]
        if not numbers:
            raise NothingFlownError(f"the first robots fail alone, too: {rows[0]['text']}")
        if self.time_limit is None:
            self.time_limit = math.ceil(SLACK * max(each["duration"] for each in numbers))
            self._settings.append(f"criteria.time_limit_s={self.time_limit}")
        cloud, first = self.fleet.cloud, numbers[0]
        if self.fleet.cell.rate_kbit and "packets_sent_uplink" in first:  # a long mission has it
            self._set_cell(first)
        if cloud.cores and cloud.compute_ms:
            mean_ms = fmean(compute_times(cloud.compute_ms))
            whole = cloud.cores * cloud.speed / (mean_ms * 1e-3)  # commands a second for all
            self.arithmetic["cloud"] = whole / cloud.command_rate_hz
            self.theory["closed queue"] = int(whole / RESUME_HZ)

    def _set_cell(self, numbers: Mapping[str, float]) -> None:
        """Set arithmetic and theory of the cell, from the numbers of a robot alone."""
        cell, age = self.fleet.cell, numbers["age_at_actuator_p99"]
        assert cell.rate_kbit is not None, "there is a cell"
        for way in DIRECTIONS:
            packets = numbers[f"packets_sent_{way}"]
            size = numbers[f"bytes_sent_{way}"] / packets + HEADER_BYTES
            rate = packets / numbers["duration"]
            service = size * 8e-3 / cell.rate_kbit + cell.airtime_us * 1e-6
            self.traffic[way] = {"rate_hz": rate, "bytes": size, "service_s": service}
        loads = [each["rate_hz"] * each["service_s"] for each in self.traffic.values()]
        self.arithmetic["cell"] = 1.0 / (sum(loads) if cell.shared else max(loads))
        if not (cell.shared or cell.traffic):
            busiest = max(self.traffic.values(), key=itemgetter("bytes"))
            period, service = 1.0 / busiest["rate_hz"], busiest["service_s"]
            sizes = range(1, self._asked.max + 1)
            late = (n for n in sizes if age + nddd1(n, period, service) >= self.age_max)
            self.theory["N.D/D/1"] = next(late, sizes[-1] + 1) - 1

    @property
    def age_max(self) -> float:
        """The guard's limit on the age of a command [s]."""
        return self.fleet.guard.command_age_max_ms * 1e-3

    def limits(self, numbers: Mapping[str, float]) -> list[str]:
        """Name the limits that a fleet with these numbers has come near to."""
        rate = self.fleet.cloud.command_rate_hz
        near = {
            "command_age": numbers["age_p99_ms_worst"] >= CLOSE * self.age_max * 1e3,
            "hold": numbers["hold_s_worst"] > 0.0 and numbers["rate_hz_worst"] < RESUME_HZ,
            "cloud_rate": numbers.get("cloud_hz", rate) < CLOSE * rate,
        }
        return [name for name, is_near in near.items() if is_near]

    def search(self) -> Iterator[PlannedFlight]:
        """Yield flights with seed 1, each once the one before is in `fleets`."""
        start = int(min(self.arithmetic.values(), default=1)) or 1
        for size in search(start, self._asked.max, lambda size: succeeded(self.fleets[size][1])):
            yield self.flight(size)

    @property
    def around(self) -> list[int]:
        """The sizes that decide: the largest one that succeeds, one less and one more."""
        found = max((n for n, rows in self.fleets.items() if succeeded(rows[1])), default=0)
        return [*range(max(1, found - 1), min(self._asked.max, found + 1) + 1)]

    def decisive(self) -> Iterator[PlannedFlight]:
        """Yield the flights of these sizes with all seeds."""
        for flight in map(self.flight, self.around):
            yield from (flight._replace(seed=1 + n) for n in range(self._asked.seeds))


def fly(conditions: Sequence[Condition], rows: Rows, see: Callable[[Row], None]) -> None:
    """Fly what has no row in `rows`; raise the reason if that ends early.

    Call `see` with the row of each fleet that has flown.
    """
    bases = {base.key: base for each in conditions for base in each.bases}
    if stopped := run(bases.values(), rows, len(bases), in_order=False):
        raise stopped
    for each in conditions:
        each.set_base([rows.kept[base.key] for base in each.bases])
    searches = [(each, each.search()) for each in conditions]
    while tried := [(each, flight) for each, own in searches for flight in islice(own, 1)]:
        _fly(tried, rows, see)
    _fly([(each, flight) for each in conditions for flight in each.decisive()], rows, see)


def _fly(
    fleets: Sequence[tuple[Condition, PlannedFlight]], rows: Rows, see: Callable[[Row], None]
) -> None:
    """Fly fleets, and give each condition the rows of its own."""
    if stopped := run((flight for _, flight in fleets), rows, len(fleets), see, in_order=False):
        raise stopped
    for condition, flight in fleets:
        condition.fleets[flight.point["robots"]][flight.seed] = rows.kept[flight.key]


def succeeded(row: Row) -> bool:
    """Return whether all robots of a fleet succeeded; a fleet that cannot fly is an error."""
    if row["verdict"] == ERROR:
        raise NothingFlownError(row["text"])
    return bool(row["verdict"] == "success")


def capacity_of(fleets: Mapping[int, Mapping[int, bool]], top: int) -> dict[str, Any]:
    """Return the capacity over seeds: its median, and the interval of this median.

    `fleets` are number of robots -> seed -> whether the fleet succeeded; the numbers follow each
    other. The capacity of a seed is the largest one up to which all succeed. If the smallest one
    fails, it is lower; if the largest one succeeds, it may be higher, up to `top`.
    """
    sizes = sorted(fleets)
    values = list[int]()
    for seed in fleets[sizes[0]]:
        failed = (size for size in sizes if not fleets[size][seed])
        values.append(next(failed, sizes[-1] + 1) - 1)
    interval = median_interval(values)
    low, high = interval or (min(values), max(values))
    return {
        "capacity": median_low(values),
        "interval": [int(low), int(high)],
        "interval_is": "95 % interval" if interval else "range",
        "at_most": sizes[0] - 1 if sizes[0] > 1 else None,  # this value stands for lower ones, too
        "at_least": sizes[-1] if sizes[-1] < top else None,  # and this one for higher ones
        "of_seeds": values,
    }


def describe(asked: Sought, conditions: Sequence[Condition]) -> dict[str, Any]:
    """Return the result as values for JSON."""
    return {**asdict(asked), "conditions": [_describe(each, asked.max) for each in conditions]}


def _describe(condition: Condition, top: int) -> dict[str, Any]:
    decisive = {
        size: {seed: succeeded(row) for seed, row in sorted(condition.fleets[size].items())}
        for size in condition.around
    }
    capacity = capacity_of(decisive, top)
    fleets = [_summary(size, [*rows.values()]) for size, rows in sorted(condition.fleets.items())]
    failed = [each for each in fleets if each["robots"] > capacity["capacity"] and each["failures"]]
    return {
        **condition.point,
        **capacity,
        "arithmetic": condition.arithmetic,
        "theory": condition.theory,
        "traffic": condition.traffic,
        "time_limit_s": condition.time_limit,
        "age_max_ms": condition.age_max * 1e3,
        "breaks_at": failed[0]["robots"] if failed else None,
        "limits": condition.limits(failed[0]["numbers"]) if failed else [],
        "fleets": fleets,
    }


def _summary(size: int, rows: Sequence[Row]) -> dict[str, Any]:
    """Return the medians of all fleets of a size, and how many succeeded."""
    done, names = sum(map(succeeded, rows)), dict.fromkeys(n for r in rows for n in r["numbers"])
    return {
        "robots": size,
        "fleets": len(rows),
        "success": done,
        "interval": exact_interval(done, len(rows)),
        "failures": sorted({code for row in rows for code in row["failures"]}),
        "numbers": {
            name: median_low([r["numbers"][name] for r in rows if name in r["numbers"]])
            for name in names
        },
    }
