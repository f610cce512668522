"""Plan the flights of a sweep: each point is loaded and checked before the first flight."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc import files, source
from cloudrc.config import sweep
from cloudrc.config.resolved import ResolvedExperiment, local_files
from cloudrc.config.schema import Link
from cloudrc.config.sweep import Draft
from cloudrc.errors import StateError
from cloudrc.metrics import measure
from cloudrc.outside.refusal import reading
from cloudrc.outside.reuse import reuse_results
from cloudrc.runs import flight
from cloudrc.runs.experiment import load
from cloudrc.trials.fingerprint import experiment_facts, fingerprint, key_of
from cloudrc.trials.rows import Row
from cloudrc.trials.summary import RATIO

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
    baselines: dict[str, str]  # key of each flight of the grid -> key of the one for J0; or {}
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
            facts = experiment_facts(points[-1])
            own_files |= facts[-1]
            first = PlannedFlight(fingerprint(facts), point, draft.seeds[0], points[-1])
            if (same := flights.get(first.key)) is not None:
                text = f"{point} is the same experiment as {same.point}; change one of them"
                raise draft.problem(text)
            every = [first._replace(seed=seed) for seed in draft.seeds]
            flights |= {each.key: each for each in every}
            if draft.cost:
                bare = _without_network(first)
                baselines |= {each.key: bare._replace(seed=each.seed) for each in every}
    for each in baselines.values():
        flights.setdefault(each.key, each)
    own_metrics = {metric for point in points for metric in point.report.metrics}
    units = flight.units(own_metrics) | ({RATIO: "1"} if draft.cost else {})
    keys = {key: each.key for key, each in baselines.items()}
    return SweepPlan(draft, points, flights, keys, units, own_files)


def _without_network(flown: PlannedFlight) -> PlannedFlight:
    """Return a flight with the same settings and seed over an ideal link; it is of no point."""
    resolved = flown.resolved.model_copy(update={"link": Link(profile="ideal")})
    return PlannedFlight(fingerprint(experiment_facts(resolved)), {}, flown.seed, resolved)


def pack(flights: Iterable[PlannedFlight]) -> bytes:
    """Pack flights into a file for pods, which have none of the user's files.

    The file has each point once, with the seeds of its flights, which follow each other. Equal
    flights give equal bytes.
    """
    points = list[Any]()
    for told, group in groupby(flights, key=lambda each: each.fingerprint):
        first, *more = group
        seeds = [first.seed, *(each.seed for each in more)]
        points.append([told, first.point, first.resolved.model_dump(mode="json"), seeds])
    return gzip.compress(json.dumps(points).encode(), mtime=0)


def unpack(path: Path) -> list[PlannedFlight]:
    """Read the flights from a file made by `pack`.

    Raise a StateError if other code or plug-ins have packed it: the rows would be others.
    """
    flights = list[PlannedFlight]()
    build = "build the image from the code that runs this command, with the same packages"
    with reading(path, f"holds no flights of this version of cloudrc; {build}"), reuse_results():
        for told, point, values, seeds in json.loads(gzip.decompress(files.read(path))):
            resolved = ResolvedExperiment.model_validate_json(json.dumps(values))
            flights += [PlannedFlight(told, point, seed, resolved) for seed in seeds]
            if told != fingerprint(experiment_facts(resolved)):
                text = f"its flights are of other code or plug-ins than code {source.code_hash()}"
                raise StateError(f"{path}: {text}; {build}")
    return flights
