"""SweepPlan flights: a grid of settings of an experiment (conditions), each with several seeds.

docs/sweeps.md describes the file of a sweep. A *point* has one value of each axis. Every point is
loaded and checked before the first flight.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain, groupby, product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import Field

from cloudrc import files, source
from cloudrc.config import problems, shipped
from cloudrc.config.load import load_experiment
from cloudrc.config.overrides import Settings, collect_settings, parse_settings
from cloudrc.config.problems import ConfigProblem, ProblemsError, validate
from cloudrc.config.resolved import ResolvedExperiment, local_files
from cloudrc.config.schema import Link
from cloudrc.config.section import Section
from cloudrc.errors import BadInputError
from cloudrc.metrics import measure
from cloudrc.outside.document import Document, Source, parse_yaml, read_document, write_yaml
from cloudrc.outside.reuse import reuse, reuse_results
from cloudrc.runs import flight
from cloudrc.runs.experiment import check_alone, check_world
from cloudrc.trials.fingerprint import experiment_facts, fingerprint, key_of
from cloudrc.trials.rows import Row
from cloudrc.trials.summary import RATIO

SEED_MAX, SEEDS_MAX = 2**53 - 1, 10_000
"""Largest seed, and largest number of seeds."""
COLUMNS = ("key", "seed", "verdict", "failures", "code", "physics_steps")
"""Columns of the table besides the axes and the numbers."""
Entry = tuple[str, Any, Source]
"""A setting's key and value, and their place in the file."""
Choice = tuple[Any, list[Entry]]
"""A value of an axis, or its name, and the settings that it means."""


class SweepFile(Section):
    """The content of a sweep file, as YAML keys."""

    experiment: str = "paper"
    """Name or path of the experiment"""
    set: dict[str, Any] = Field(default_factory=dict)
    """Settings of all points"""
    grid: dict[str, Any] = Field(default_factory=dict)
    """Axes: a key and a list of its values, or a name and a mapping of named settings"""
    seeds: Any = 1
    """Number of seeds, which begin with 1, or a list of seeds"""
    cost: bool = False
    """Whether to fly every point without a network, too, which gives the number J/J0"""
    folder: str | None = None
    """Folder in which relative paths start (default: that of the file)"""


class PlannedFlight(NamedTuple):
    """One flight: a point (one value per axis), flown with one seed."""

    fingerprint: str  # of the point
    point: dict[str, Any]  # axis -> value or name
    seed: int
    resolved: ResolvedExperiment  # experiment of the point; its seed is not used

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
        return self.row(flight.fly_point(self.experiment))

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


class Draft(NamedTuple):
    """A plan whose points are not checked yet."""

    name: str  # of the file, for errors
    file: dict[str, Any]  # its content
    experiment: str
    common: list[Entry]
    axes: dict[str, list[Choice]]
    seeds: tuple[int, ...]
    cost: bool = False

    @property
    def flights(self) -> int:
        """Number of all flights."""
        return prod(map(len, self.axes.values())) * len(self.seeds)

    @property
    def size(self) -> str:
        """How many points, seeds and flights there are, in words."""
        seeds = len(self.seeds)
        return f"{self.flights // seeds:,} points x {seeds:,} seeds: {self.flights:,} flights"

    def points(self) -> Iterable[tuple[dict[str, Any], list[Entry]]]:
        """Yield each point in the order of the grid, with its settings."""
        for choices in product(*self.axes.values()):
            labels = [label for label, _ in choices]
            entries = chain(self.common, *(entries for _, entries in choices))
            yield dict(zip(self.axes, labels, strict=True)), [*entries]

    def resolve(self, entries: Iterable[Entry]) -> ResolvedExperiment:
        """Return the checked experiment of a point."""
        settings = collect_settings(entries)
        if ("seed",) in settings:
            label = settings["seed",].source.label
            raise BadInputError(
                f"{label}: seed: each flight has its own seed; give the seeds with --seeds, or "
                "with the key 'seeds' of a sweep"
            )
        resolved = load_experiment(self.experiment, settings)
        check_alone(resolved)
        try:
            check_world(resolved.world, turns=resolved.mission.turns)
        except ProblemsError as error:
            lines = [f"{_label(settings, problem)}{problem}" for problem in error.problems]
            raise BadInputError("; ".join(lines)) from error
        own = resolved.report.metrics
        reuse(("metrics", own), lambda: measure.check(own))
        return resolved


def _label(settings: Settings, problem: ConfigProblem) -> str:
    """Return the place of the setting that caused a problem, as "FILE:LINE: "; "" if none did."""
    path = problem.path
    paths = [path[:length] for length in range(len(path), 0, -1)]
    paths += [key for key in settings if key[: len(path)] == path]  # of a part of the value
    return next((f"{settings[key].source.label}: " for key in paths if key in settings), "")


def read_plan(given: Path | Mapping[str, Any]) -> SweepPlan:
    """Read a sweep, the path of its file or its content, and check all of its points.

    Raises:
        BadInputError: If the sweep or one of its points has problems, with file and line of each,
            or with the key of the content.
    """
    return check(read_draft(given))


def check(draft: Draft) -> SweepPlan:
    """Check the points of a draft; raise a BadInputError."""
    points, flights = list[ResolvedExperiment](), dict[str, PlannedFlight]()
    baselines = dict[str, PlannedFlight]()
    own_files = dict[str, str]()
    with reuse_results():
        for point, entries in draft.points():
            points.append(draft.resolve(entries))
            facts = experiment_facts(points[-1])
            own_files |= facts[-1]
            first = PlannedFlight(fingerprint(facts), point, draft.seeds[0], points[-1])
            if (same := flights.get(first.key)) is not None:
                text = f"{point} is the same experiment as {same.point}; change one of them"
                raise BadInputError(f"{draft.name}: {text}")
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


def draft_of(
    experiment: str,
    settings: Iterable[str],
    seeds: int,
    sides: Mapping[str, Iterable[str]] | None = None,
) -> Draft:
    """Draft the flights of an experiment with `settings` (KEY=VALUE) and the seeds 1 to `seeds`.

    With `sides`, a name -> further settings, the axis "side" has these names.
    """

    def entries(texts: Iterable[str]) -> list[Entry]:
        found = parse_settings(texts)
        return [(".".join(path), each.value, each.source) for path, each in found.items()]

    common = entries(settings)
    values = {key: value for key, value, _ in common}
    here = str(Path.cwd())
    file = {"experiment": experiment, "set": values, "seeds": seeds, "folder": here}
    axes = {"side": [(name, entries(texts)) for name, texts in sides.items()]} if sides else {}
    return Draft("--set", file, experiment, common, axes, tuple(range(1, seeds + 1)))


def read_draft(given: Path | Mapping[str, Any], flights_max: int | None = None) -> Draft:
    """Read a sweep, and check all but its points; raise a BadInputError.

    Refuse a sweep of more than `flights_max` flights.
    """
    if isinstance(given, Path):
        name, start, document = str(given), given.resolve().parent, read_document(given, str(given))
    else:
        name, start = "sweep", Path.cwd()
        tree, _ = parse_yaml(write_yaml(dict(given)), name)
        document = Document(tree, {(): Source(name, start)})
    file = validate(document, SweepFile, name)
    folder = Path(file.folder or start)
    found, seeds = list[ConfigProblem](), _seeds(file.seeds)
    if not seeds:
        text = f"must be a number of seeds, 1 to {SEEDS_MAX}, or a list of different seeds"
        found.append(ConfigProblem(("seeds",), problems.in_words(file.seeds), text))
    common, axes = _entries(document, file, folder, found)
    problems.raise_problems(document, found, name)
    is_path = shipped.is_path(file.experiment)
    experiment = str(folder / file.experiment) if is_path else file.experiment
    content = document.tree | {"folder": str(folder)}
    draft = Draft(name, content, experiment, common, axes, seeds, file.cost)
    if flights_max is not None and draft.flights > flights_max:
        text = f"{draft.size} are more than {flights_max:,}; take fewer values or seeds, or give "
        raise BadInputError(f"{name}: {text}--max-flights {draft.flights}")
    return draft


def _seeds(given: Any) -> tuple[int, ...]:
    """Convert the value of the key `seeds`; return () if the value is invalid."""
    if type(given) is int:
        return tuple(range(1, given + 1)) if given <= SEEDS_MAX else ()
    values = given if isinstance(given, list) else []
    valid = all(type(seed) is int and 0 <= seed <= SEED_MAX for seed in values)
    return tuple(values) if valid and len({*values}) == len(values) <= SEEDS_MAX else ()


def _entries(
    document: Document, file: SweepFile, folder: Path, found: list[ConfigProblem]
) -> tuple[list[Entry], dict[str, list[Choice]]]:
    """Return the settings that all points share, and axis -> its choices.

    Problems of the axes are added to `found`.
    """

    def entry(key: str, value: Any, *path: str) -> Entry:
        source = document.source(path)
        if path not in document.sources:  # no file, so no line
            source = source._replace(label=f"{source.label}: {path[0]}")
        return key, value, source._replace(folder=folder)

    def choices_of(axis: str, given: Any) -> list[Choice]:
        above = "grid", axis
        if isinstance(given, list):
            return [(v, [entry(axis, v, *above, str(n))]) for n, v in enumerate(given)]
        if isinstance(given, dict) and all(isinstance(each, dict) for each in given.values()):
            return [
                (name, [entry(key, value, *above, name, key) for key, value in each.items()])
                for name, each in given.items()
            ]
        return []

    axes = {axis: choices_of(axis, given) for axis, given in file.grid.items()}
    for axis, choices in axes.items():
        if not choices:
            text = "must be a list of values, or names, each with a mapping of keys to values"
            found.append(ConfigProblem(("grid", axis), "", text))
        if axis in {*COLUMNS, *measure.SHIPPED}:
            text = "is the name of another column; rename the axis"
            found.append(ConfigProblem(("grid", axis), "", text))
    return [entry(key, value, "set", key) for key, value in file.set.items()], axes


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
    """Read the flights from a file made by `pack`; raise a BadInputError if it is unusable.

    It is also unusable if other code or plug-ins have packed it: the rows would be others.
    """
    text, flights = "is not a file of flights of this version of cloudrc", list[PlannedFlight]()
    try:
        points = json.loads(gzip.decompress(files.read(path)))
        with reuse_results():
            for told, point, values, seeds in points:
                resolved = ResolvedExperiment.model_validate_json(json.dumps(values))
                flights += [PlannedFlight(told, point, seed, resolved) for seed in seeds]
                if told != fingerprint(experiment_facts(resolved)):
                    text = "the flights come from other code or plug-ins than those of this image"
                    raise ValueError(f"code {source.code_hash()}")
    except (OSError, EOFError, ValueError, LookupError, TypeError) as error:
        raise BadInputError(
            f"{path}: {text} ({error}); build the image from the code that runs this command, and "
            "install the same packages in both"
        ) from error
    return flights
