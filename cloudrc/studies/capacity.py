"""Find how many robots a cell and a cloud carry: the largest fleet in which all robots succeed.

Success need not fall steadily with the size of the fleet. So the search finds the cliff with one
seed, and then the sizes around it fly with all seeds.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from statistics import fmean, median_low
from typing import Any

from cloudrc.config.compute import compute_times
from cloudrc.config.problems import problem_at
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.errors import NothingFlownError
from cloudrc.link.model import HEADER_BYTES
from cloudrc.link.waiting import nddd1
from cloudrc.runs.experiment import check_no_seed, check_world, load, robots_of
from cloudrc.runs.flight import ERROR
from cloudrc.statistics import exact_interval, median_interval
from cloudrc.trials.fingerprint import experiment_facts, fingerprint
from cloudrc.trials.fleet import FleetTrial, alone
from cloudrc.trials.plan import PlannedFlight
from cloudrc.trials.play import run
from cloudrc.trials.rows import Row, Rows

SLACK = 1.4
"""Time limit of a mission, as a multiple of its duration alone [1]: a robot in HOLD would fly on
until the limit of the experiment, three times that."""
BASES = 4
"""Smallest number of robots that fly alone first; one may fail by itself."""
GROWTH = 2
"""Growth of the fleet from one size to the next, until one fails [1]."""
FILL = 4
"""Number of fleets that fly beside those of a search, so that no core waits for it."""
RESUME_HZ = 20.0
"""Rate of commands below which a HOLD does not end [1/s].
Source: docs/reference/plant.md, "Leaving HOLD": 10 commands within 500 ms."""
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


def search(start: int, top: int) -> Generator[int, bool, int]:
    """Yield sizes of fleets to try, up to `top`, and get whether each succeeds.

    Return the largest size that succeeds next to one that fails; 0 if none does.
    """
    yes, no, size = 0, top + 1, min(start, top)
    while no - yes > 1:
        if (yield size):
            yes = size
        else:
            no = size
        size = min(top, max(yes + 1, yes * GROWTH)) if no > top else (yes + no) // 2
    return yes


class Condition:
    """One queue and one controller.

    Attributes:
        point: Axis -> value, without the number of robots.
        bases: Flights alone, with seed 1, of the first robots.
        arithmetic: Number of robots that fill each shared medium; `set_base` finds it.
        theory: The same by queueing theory: the largest number that gets commands in time.
        traffic: What a robot sends in the cell, per direction.
        time_limit: Time limit of the mission [s].
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
        settings = [*asked.set, *(f"{key}={value}" for key, value in given.items() if value)]
        check_no_seed(settings)
        own = self._load(asked.experiment, settings, 1)
        kinds = len(own.fleet.vary) or 1
        self.fleet = self._load(asked.experiment, settings, kinds)
        self._kinds = robots_of(self.fleet, asked.experiment, [*settings, f"fleet.robots={kinds}"])
        for robot in self._kinds:
            check_world(robot.world, turns=robot.mission.turns)
        cell, cloud = self.fleet.cell, self.fleet.cloud
        if cell.rate_kbit is None and not (cloud.cores and cloud.compute_ms):
            text = "the robots share nothing; give a rate [kbit/s], or --set cloud.cores=1 with"
            raise problem_at("--cell", f"{text} --set cloud.compute_ms=2")
        shown = cell.queue if cell.queue == "newest" else f"{cell.queue} {cell.queue_packets}"
        shown = shown if cell.rate_kbit else "no cell"
        self.point = {"queue": shown, "controller": cloud.controller.name}
        self.bases = list[PlannedFlight]()
        first = FleetTrial("", {}, 1, self.fleet, self._kinds)
        for number in range(max(BASES, kinds)):
            robot = alone(first.robot(number))
            facts = fingerprint(experiment_facts(robot))
            self.bases.append(PlannedFlight(facts, {"robot": number}, 1, robot))
        self.arithmetic, self.theory = dict[str, float](), dict[str, int]()
        self.traffic = dict[str, dict[str, float]]()
        self.time_limit: float | None = self.fleet.criteria.time_limit_s

    @staticmethod
    def _load(name: str, settings: Sequence[str], robots: int) -> ResolvedExperiment:
        more = f"fleet.robots={robots}", "fleet.only=null"
        return load(name, [*settings, *more], fleets=True)

    def set_base(self, rows: Sequence[Row], top: int) -> None:
        """Take the flights alone: time limit, arithmetic and theory, up to `top` robots."""
        numbers = [row["numbers"] for row in rows if row["verdict"] == "success"]
        if not numbers:
            raise NothingFlownError(f"the first robots fail alone, too: {rows[0]['text']}")
        if self.time_limit is None:
            self.time_limit = math.ceil(SLACK * max(each["duration"] for each in numbers))
        cell, cloud, first = self.fleet.cell, self.fleet.cloud, numbers[0]
        spare = self.age_max - first["age_at_actuator_p99"]
        if cell.rate_kbit is not None and "packets_sent_uplink" in first:  # a long mission has it
            for way in ("uplink", "downlink"):
                packets = first[f"packets_sent_{way}"]
                size = first[f"bytes_sent_{way}"] / packets + HEADER_BYTES
                rate = packets / first["duration"]
                service = size * 8e-3 / cell.rate_kbit + cell.airtime_us * 1e-6
                self.traffic[way] = {"rate_hz": rate, "bytes": size, "service_s": service}
            loads = [each["rate_hz"] * each["service_s"] for each in self.traffic.values()]
            self.arithmetic["cell"] = 1.0 / (sum(loads) if cell.shared else max(loads))
            if not (cell.shared or cell.traffic):
                busiest = max(self.traffic.values(), key=lambda way: way["bytes"])
                fits = (
                    nddd1(n, 1 / busiest["rate_hz"], busiest["service_s"]) < spare
                    for n in range(1, top + 1)
                )
                self.theory["N.D/D/1"] = next((n for n, fit in enumerate(fits) if not fit), top)
        if cloud.cores and cloud.compute_ms:
            mean_ms = fmean(compute_times(cloud.compute_ms))
            whole = cloud.cores * cloud.speed / (mean_ms * 1e-3)  # commands a second for all
            self.arithmetic["cloud"] = whole / cloud.command_rate_hz
            self.theory["closed queue"] = int(whole / RESUME_HZ)

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

    def trial(self, robots: int, seed: int) -> FleetTrial:
        """Return the flight of a fleet; not before `set_base`."""
        judged = self.fleet.criteria.model_copy(update={"time_limit_s": self.time_limit})
        own = self.fleet.fleet.model_copy(update={"robots": robots})
        fleet = self.fleet.model_copy(update={"criteria": judged, "fleet": own})
        kinds = [each.model_copy(update={"criteria": judged}) for each in self._kinds]
        facts = [experiment_facts(each) for each in (fleet, *kinds)]
        point = self.point | {"robots": robots}
        return FleetTrial(fingerprint(facts), point, seed, fleet, kinds, until_failure=True)


class Capacity:
    """Finds the capacity of each condition.

    Attributes:
        found: Number of each condition -> largest fleet that succeeds with seed 1.
        rows: The rows of all fleets that have flown.
    """

    def __init__(self, asked: Sought) -> None:
        """Load the experiment under all conditions."""
        self._asked = asked
        pairs = product(asked.queue or [""], asked.controllers or [""])
        self.conditions = [Condition(asked, *pair) for pair in pairs]
        self.found = dict[int, int]()
        self.rows = dict[str, Row]()

    def fly(self, rows: Rows, see: Callable[[Row], None] = lambda row: None) -> None:
        """Fly what has no row in `rows`; raise the reason if that ends early.

        Call `see` with the row of each fleet that has flown.
        """
        self._rows, self._see = rows, see
        bases = {each.key: each for one in self.conditions for each in one.bases}
        self._play(bases.values(), lambda row: None)
        for each in self.conditions:
            each.set_base([self._rows.kept[base.key] for base in each.bases], self._asked.max)
        starts = [int(min(each.arithmetic.values(), default=1)) or 1 for each in self.conditions]
        searches = [search(start, self._asked.max) for start in starts]
        asked, wanted = {n: next(each) for n, each in enumerate(searches)}, list[FleetTrial]()
        while asked:
            trials = {n: self.conditions[n].trial(size, 1) for n, size in asked.items()}
            self._fly([*trials.values(), *wanted[:FILL]])
            del wanted[:FILL]
            for n, trial in trials.items():
                try:
                    asked[n] = searches[n].send(succeeded(self.rows[trial.key]))
                except StopIteration as end:
                    self.found[n] = end.value
                    wanted += self._around(self.conditions[n], end.value)
                    del asked[n]
        self._fly(sorted(wanted, key=lambda each: -each.fleet.fleet.robots))

    def _around(self, condition: Condition, largest: int) -> Iterator[FleetTrial]:
        for size in range(max(1, largest - 1), min(self._asked.max, largest + 1) + 1):
            for seed in range(1, self._asked.seeds + 1):
                yield condition.trial(size, seed)

    def _fly(self, trials: Iterable[FleetTrial]) -> None:
        trials = [*trials]
        self._play(trials, self._see)
        self.rows |= {each.key: self._rows.kept[each.key] for each in trials}

    def _play(self, trials: Iterable[Any], see: Callable[[Row], None]) -> None:
        trials = [*trials]
        if stopped := run(trials, self._rows, len(trials), see, in_order=False):
            raise stopped


def succeeded(row: Row) -> bool:
    """Return whether all robots of a fleet succeeded; a fleet that cannot fly is an error."""
    if row["verdict"] == ERROR:
        raise NothingFlownError(row["text"])
    return bool(row["verdict"] == "success")


def capacity_of(fleets: Mapping[int, Mapping[int, bool]], top: int) -> dict[str, Any]:
    """Return the capacity over seeds: its median, and the interval of this median.

    `fleets` are seed -> number of robots -> whether the fleet succeeded. The capacity of a seed is
    the largest flown size up to which all succeed. If the smallest one fails, it is lower; if the
    largest one succeeds, it may be higher, up to `top`.
    """
    sizes = sorted({size for each in fleets.values() for size in each})
    values = list[int]()
    for each in fleets.values():
        last = sizes[0] - 1
        for size in sizes:
            if not each[size]:
                break
            last = size
        values.append(last)
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


def describe(found: Capacity, asked: Sought) -> dict[str, Any]:
    """Return the result as values for JSON."""
    return {
        **asdict(asked),
        "conditions": [
            _describe(each, found.found[number], [*found.rows.values()], asked)
            for number, each in enumerate(found.conditions)
        ],
    }


def _describe(
    condition: Condition, largest: int, rows: Sequence[Row], asked: Sought
) -> dict[str, Any]:
    groups = dict[int, list[Row]]()
    for row in sorted(rows, key=lambda row: row["point"]["robots"]):
        if condition.point.items() <= row["point"].items():
            groups.setdefault(row["point"]["robots"], []).append(row)
    seeds = {seed: dict[int, bool]() for seed in range(1, asked.seeds + 1)}
    for size, each in groups.items():
        if abs(size - largest) <= 1:
            for row in each:
                seeds[row["seed"]][size] = succeeded(row)
    capacity = capacity_of(seeds, asked.max)
    fleets = [_summary(size, each) for size, each in groups.items()]
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
