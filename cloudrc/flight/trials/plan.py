# SPDX-License-Identifier: Apache-2.0

"""Plan the flights of a sweep: each point is loaded and checked before the first flight."""

from __future__ import annotations

import gzip
import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base import files, source
from cloudrc.base.errors import CloudrcError, StateError
from cloudrc.base.outside.refusal import reading
from cloudrc.base.outside.reuse import reuse_results
from cloudrc.config import sweep
from cloudrc.config.resolved import ResolvedExperiment, local_files
from cloudrc.config.sweep import Draft
from cloudrc.flight import in_memory as flight
from cloudrc.flight.experiment import load
from cloudrc.flight.trials.beside_ideal import fly_beside_ideal, setpoint_waits, without_network
from cloudrc.flight.trials.fingerprint import experiment_facts, fingerprint, key_of
from cloudrc.flight.trials.rows import Row
from cloudrc.flight.trials.summary import OFF_PATH, RATIO, TIME_RATIO
from cloudrc.results.metrics import measure

COLUMNS = ("seed", "verdict", "failures", "code", "physics_steps")
"""Columns of the table besides the key, the axes and the numbers."""


class PlannedFlight(NamedTuple):
    """One flight: a point (one value per axis), flown with one seed."""

    fingerprint: str  # of the point
    point: dict[str, Any]  # axis -> value or name
    seed: int
    resolved: ResolvedExperiment  # experiment of the point; its seed is not used
    fly: Callable[[ResolvedExperiment], Row] = flight.fly_point

    @property
    def key(self) -> str:
        """16 hexadecimal digits; equal keys mean equal flights."""
        return key_of(self.fingerprint, self.seed)

    @property
    def is_beside_ideal(self) -> bool:
        """Whether its row has the numbers beside its flight over an ideal link."""
        return self.fly is fly_beside_ideal

    @property
    def experiment(self) -> ResolvedExperiment:
        """The experiment of the point, with the seed of this flight."""
        return self.resolved.model_copy(update={"seed": self.seed})

    def play(self) -> Row:
        """Fly; return the row."""
        return self.row(self.fly(self.experiment))

    def row(self, flown: Row) -> Row:
        """Return the flight's row; `flown` has the results, such as the verdict."""
        of = {"key": self.key, "point": self.point, "seed": self.seed}
        return {**of, **flown, "code": source.code_hash()}


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """Checked flights: the content of the file of a sweep, its points, and their flights."""

    draft: Draft
    points: list[ResolvedExperiment]
    flights: dict[str, PlannedFlight]  # key -> flight, in the order of the grid, then those for J0
    baselines: dict[str, str]  # key of a flight that has J/J0 -> key of the one for J0
    units: dict[str, str]  # metric -> unit
    files: dict[str, str]  # path of each of the user's files on which a flight depends -> its hash

    @property
    def name(self) -> str:
        """Name of the experiment."""
        return self.points[0].name if self.points else ""

    @property
    def axes(self) -> dict[str, list[Any]]:
        """Axis -> its values or names."""
        return {axis: [label for label, _ in each] for axis, each in self.draft.axes.items()}

    @property
    def speed_caps(self) -> str:
        """Where settings changed the guard's speed cap, in words; "" if nowhere.

        A longer limit of the age of commands, or a longer plan, makes the guard allow less speed.
        """
        try:
            before = f"{load(self.draft.experiment, []).guard.speed_max_mps:.3g}"
        except CloudrcError:  # the experiment flies with the settings alone
            return ""
        places = defaultdict[str, list[list[str]]](list)
        for (labels, _), point in zip(self.draft.points(), self.points, strict=True):
            named = [f"{axis}={label}" for axis, label in labels.items()]
            places[f"{point.guard.speed_max_mps:.3g}"].append(named)
        places.pop(before, None)
        caps = list[str]()
        for cap, each in places.items():  # named by what its points share
            shared = [name for name in each[0] if all(name in named for named in each)]
            count = f"{len(each)} of {len(self.points)} points"
            caps.append(f"{cap} m/s ({', '.join(shared) or count})")
        text = f"the settings change the guard's speed cap from {before} m/s to {', '.join(caps)}"
        return text if caps else ""

    @property
    def own_files(self) -> list[str]:
        """Paths of the user's files on which a flight depends, as they are named and found."""
        named = (local_files(each.model_dump(mode="json")) for each in self.points)
        return sorted({*self.files, *(path for each in named for path in each.values())})


def read_plan(given: Path | Mapping[str, Any]) -> SweepPlan:
    """Read a sweep, the path of its file or its content, and check all of its points."""
    return check(read_draft(given))


def read_draft(given: Path | Mapping[str, Any], flights_max: int | None = None) -> Draft:
    """Read a sweep of at most `flights_max` flights, whose axes are no columns of its table."""
    return sweep.read_draft(given, {*COLUMNS, *measure.SHIPPED}, flights_max)


def check(draft: Draft) -> SweepPlan:
    """Check the points of a draft."""
    points, flights = list[ResolvedExperiment](), dict[str, PlannedFlight]()
    baselines = dict[str, PlannedFlight]()
    own_files = dict[str, str]()
    with reuse_results():
        for point, settings in draft.points():
            points.append(load(draft.experiment, settings))
            own_files |= experiment_facts(points[-1])[-1]
            is_beside = draft.cost and setpoint_waits(points[-1].mission)
            first = _first_flight(point, draft.seeds[0], points[-1], beside_ideal=is_beside)
            if (same := flights.get(first.key)) is not None:
                text = f"{point} is the same experiment as {same.point}; change one of them"
                raise draft.problem(text)
            every = [first._replace(seed=seed) for seed in draft.seeds]
            flights |= {each.key: each for each in every}
            if draft.cost and not is_beside:
                bare = _first_flight({}, first.seed, without_network(first.resolved))
                baselines |= {each.key: bare._replace(seed=each.seed) for each in every}
    for each in baselines.values():
        flights.setdefault(each.key, each)
    own_metrics = {metric for point in points for metric in point.report.metrics}
    units = flight.units(own_metrics) | ({RATIO: "1"} if baselines else {})
    if any(each.is_beside_ideal for each in flights.values()):
        units |= {OFF_PATH: "m", TIME_RATIO: "1"}
    keys = {key: each.key for key, each in baselines.items()}
    return SweepPlan(draft, points, flights, keys, units, own_files)


def _first_flight(
    point: dict[str, Any], seed: int, resolved: ResolvedExperiment, *, beside_ideal: bool = False
) -> PlannedFlight:
    """Return the flight of a point with a seed; `point` is {} for a flight for J0.

    A row with the numbers beside the flight over an ideal link has a key of its own.
    """
    facts = experiment_facts(resolved)
    if beside_ideal:
        known = fingerprint(facts, OFF_PATH)
        return PlannedFlight(known, point, seed, resolved, fly_beside_ideal)
    return PlannedFlight(fingerprint(facts), point, seed, resolved)


def pack(flights: Iterable[PlannedFlight]) -> bytes:
    """Pack flights into a file for pods, which have none of the user's files.

    The file has each point once, with the seeds of its flights, which follow each other. Equal
    flights give equal bytes.
    """
    points = list[Any]()
    for told, group in groupby(flights, key=lambda each: each.fingerprint):
        first, *more = group
        seeds = [first.seed, *(each.seed for each in more)]
        values = first.resolved.model_dump(mode="json")
        points.append([told, first.point, values, seeds, first.is_beside_ideal])
    return gzip.compress(json.dumps(points).encode(), mtime=0)


def unpack(path: Path) -> list[PlannedFlight]:
    """Read the flights from a file made by `pack`.

    Raise a StateError if other code or plug-ins have packed it: the rows would be others.
    """
    flights = list[PlannedFlight]()
    build = "build the image from the code that runs this command, with the same packages"
    with reading(path, f"holds no flights of this version of cloudrc; {build}"), reuse_results():
        points = json.loads(gzip.decompress(files.read(path)))
        for told, point, values, seeds, beside_ideal in points:
            resolved = ResolvedExperiment.model_validate_json(json.dumps(values))
            _ = resolved.robot  # read here, so that workers get it, and share it
            first = _first_flight(point, seeds[0], resolved, beside_ideal=beside_ideal)
            flights += [first._replace(seed=seed) for seed in seeds]
            if told != first.fingerprint:
                text = f"its flights are of other code or plug-ins than code {source.code_hash()}"
                raise StateError(f"{path}: {text}; {build}")
    return flights
