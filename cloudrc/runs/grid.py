"""Read the file of a sweep: a grid of settings of an experiment, flown with several seeds.

docs/sweeps.md describes the file. A *point* has one value of each axis. Every point is loaded and
checked before its first flight.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from itertools import chain, product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from pydantic import Field

from cloudrc import files, metrics, source
from cloudrc.config import problems, shipped
from cloudrc.config.load import load_experiment
from cloudrc.config.overrides import Settings, collect_settings
from cloudrc.config.problems import ConfigProblem, ProblemsError, validate
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.section import Section
from cloudrc.errors import BadInputError
from cloudrc.outside.document import Document, Source, parse_yaml, read_document, write_yaml
from cloudrc.outside.reuse import reuse, reuse_results
from cloudrc.runs.experiment import check_world
from cloudrc.runs.flight import Row, units
from cloudrc.runs.installed import installed_code
from cloudrc.runs.own_files import hash_all

SEED_MAX, SEEDS_MAX = 2**53 - 1, 10_000
"""Largest seed, and largest number of seeds."""
COLUMNS = ("key", "seed", "verdict", "failures", "code", "physics_steps")
"""Columns of the table besides the axes and the numbers."""
_Entry: TypeAlias = tuple[str, Any, Source]
"""A setting's key and value, and their place in the file."""
_Point: TypeAlias = tuple[dict[str, Any], tuple[tuple[Any, list[_Entry]], ...]]
"""A point with its choice of each axis: the label with its settings."""


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
    folder: str | None = None
    """Folder in which relative paths start (default: that of the file)"""


class SweepPoint(NamedTuple):
    """One flight of a sweep: a point (one value per axis), flown with one seed."""

    key: str  # 16 hexadecimal digits; equal keys mean equal flights
    point: dict[str, Any]  # axis -> value or name
    seed: int
    resolved: ResolvedExperiment  # experiment of the point; its seed is not used

    @property
    def experiment(self) -> ResolvedExperiment:
        """The experiment of the point, with the seed of this flight."""
        return self.resolved.model_copy(update={"seed": self.seed})

    def row(self, flown: Row) -> Row:
        """Return the flight's row in the sweep; `flown` has the results, such as the verdict."""
        of = {"key": self.key, "point": self.point, "seed": self.seed}
        return {**of, **flown, "code": source.code_hash()}


@dataclass(frozen=True, slots=True)
class Grid:
    """A checked sweep: the content of its file, its points, and the flights of each point.

    In a shard, only the points of its flights may be checked.
    """

    file: dict[str, Any]  # content of the file, with `folder`
    axes: dict[str, list[Any]]  # axis -> its values or names
    seeds: tuple[int, ...]
    name: str  # of the experiment
    units: dict[str, str]  # metric -> unit
    files: dict[str, str]  # path of each of the user's files on which a flight depends -> its hash
    point_of: dict[str, dict[str, Any]]  # key of each flight -> its point, in the grid's order
    points: list[ResolvedExperiment]  # those that are checked
    flights: dict[str, SweepPoint]  # key -> flight of a checked point


class UncheckedGrid(NamedTuple):
    """The content of a sweep's file, whose points are not checked yet."""

    name: str
    file: dict[str, Any]
    experiment: str
    common: list[_Entry]
    axes: dict[str, list[tuple[Any, list[_Entry]]]]
    seeds: tuple[int, ...]

    @property
    def flights(self) -> int:
        """Number of all flights."""
        return prod(len(choices) for choices in self.axes.values()) * len(self.seeds)

    @property
    def size(self) -> str:
        """How many points, seeds and flights the sweep has, in words."""
        seeds = len(self.seeds)
        return f"{self.flights // seeds:,} points x {seeds:,} seeds: {self.flights:,} flights"

    def points(self) -> list[_Point]:
        """Return all points in the order of the grid."""
        return [
            ({axis: label for axis, (label, _) in zip(self.axes, choices, strict=True)}, choices)
            for choices in product(*self.axes.values())
        ]

    def resolve(self, choices: Iterable[tuple[Any, list[_Entry]]]) -> ResolvedExperiment:
        """Return the checked experiment of a point, which has one choice of each axis."""
        return _resolve(self.experiment, chain(self.common, *(entries for _, entries in choices)))


def read_grid(given: Path | Mapping[str, Any]) -> Grid:
    """Read a sweep, the path of its file or its content, and check all of its points.

    Raises:
        BadInputError: If the sweep or one of its points has problems, with file and line of each,
            or with the key of the content.
    """
    grid = read_unchecked(given)
    return check(grid)


def check(grid: UncheckedGrid) -> Grid:
    """Check the points of a sweep; raise a BadInputError."""
    points, flights = list[ResolvedExperiment](), dict[str, SweepPoint]()
    files = dict[str, str]()
    with reuse_results():
        for point, choices in grid.points():
            points.append(grid.resolve(choices))
            own_files = hash_all(points[-1])
            files |= own_files
            everything = everything_of(points[-1], own_files)
            for seed in grid.seeds:
                key = _key(everything, seed)
                if key in flights:
                    same = f"{point} is the same as {flights[key].point}; remove one of them"
                    raise BadInputError(f"{grid.name}: {same}")
                flights[key] = SweepPoint(key, point, seed, points[-1])
    return Grid(
        file=grid.file,
        axes={axis: [label for label, _ in choices] for axis, choices in grid.axes.items()},
        seeds=grid.seeds,
        name=points[0].name if points else "",
        units=units({metric for point in points for metric in point.report.metrics}),
        files=files,
        point_of={key: flight.point for key, flight in flights.items()},
        points=points,
        flights=flights,
    )


def read_flight(path: Path, point: Mapping[str, Any], seed: int) -> SweepPoint | None:
    """Read one flight of a sweep, without the others; None if the sweep does not have it."""
    grid = read_unchecked(path)
    if point.keys() != grid.axes.keys() or seed not in grid.seeds:
        return None
    choices = []
    for axis, among in grid.axes.items():
        found = [choice for choice in among if choice[0] == point[axis]]
        if not found:
            return None
        choices.append(found[0])
    resolved = grid.resolve(choices)
    everything = everything_of(resolved, hash_all(resolved))
    return SweepPoint(_key(everything, seed), dict(point), seed, resolved)


def read_unchecked(
    given: Path | Mapping[str, Any], flights_max: int | None = None
) -> UncheckedGrid:
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
    grid = UncheckedGrid(name, content, experiment, common, axes, seeds)
    if flights_max is not None and grid.flights > flights_max:
        text = f"{grid.size} are more than {flights_max:,}; take fewer values or seeds, or give "
        raise BadInputError(f"{name}: {text}--max-flights {grid.flights}")
    return grid


def everything_of(point: ResolvedExperiment, files: Mapping[str, str]) -> bytes:
    """Return all that decides a flight, except its seed, as JSON; `files`: path -> hash."""
    code = {"cloudrc": source.code_hash(), "installed": installed_code(point)}
    everything = {**point.model_dump(mode="json"), **code, "files": files}
    return json.dumps(everything, sort_keys=True).encode()


def _key(everything: bytes, seed: int) -> str:
    """Return the key of a flight: a hash of its seed and of everything else that decides it."""
    return sha256(everything + f" seed {seed}".encode()).hexdigest()[:16]


def _seeds(given: Any) -> tuple[int, ...]:
    """Convert the value of the key `seeds`; return () if the value is invalid."""
    if type(given) is int:
        return tuple(range(1, given + 1)) if given <= SEEDS_MAX else ()
    values = given if isinstance(given, list) else []
    valid = all(type(seed) is int and 0 <= seed <= SEED_MAX for seed in values)
    return tuple(values) if valid and len({*values}) == len(values) <= SEEDS_MAX else ()


def _entries(
    document: Document, file: SweepFile, folder: Path, found: list[ConfigProblem]
) -> tuple[list[_Entry], dict[str, list[tuple[Any, list[_Entry]]]]]:
    """Return the settings that all points of the sweep share, and a mapping: axis -> its choices.

    A choice is a label with its settings. Problems of the axes are added to `found`.
    """

    def entry(key: str, value: Any, *path: str) -> _Entry:
        source = document.source(path)
        if path not in document.sources:  # no file, so no line
            source = source._replace(label=f"{source.label}: {path[0]}")
        return key, value, source._replace(folder=folder)

    def choices_of(axis: str, given: Any, *above: str) -> list[tuple[Any, list[_Entry]]]:
        if isinstance(given, list):
            return [(v, [entry(axis, v, *above, str(n))]) for n, v in enumerate(given)]
        if isinstance(given, dict) and all(isinstance(each, dict) for each in given.values()):
            return [
                (name, [entry(key, value, *above, name, key) for key, value in each.items()])
                for name, each in given.items()
            ]
        return []

    axes: dict[str, list[tuple[Any, list[_Entry]]]] = {}
    for axis, given in file.grid.items():
        above = "grid", axis
        axes[axis] = choices_of(axis, given, *above)
        if not axes[axis]:
            text = "must be a list of values, or names, each with a mapping of keys to values"
            found.append(ConfigProblem(above, "", text))
        if axis in {*COLUMNS, *metrics.SHIPPED}:
            found.append(ConfigProblem(above, "", "is the name of another column; rename the axis"))
    return [entry(key, value, "set", key) for key, value in file.set.items()], axes


def _resolve(experiment: str, entries: Iterable[_Entry]) -> ResolvedExperiment:
    settings = collect_settings(entries)
    if ("seed",) in settings:
        source = settings["seed",].source
        raise BadInputError(f"{source.label}: seed: give the seeds with the key 'seeds'")
    resolved = load_experiment(experiment, settings)
    try:
        check_world(resolved.world, turns=resolved.mission.turns)
    except ProblemsError as error:
        lines = [f"{_label(settings, problem)}{problem}" for problem in error.problems]
        raise BadInputError("; ".join(lines)) from error
    own = resolved.report.metrics
    reuse(("metrics", own), lambda: metrics.check(own))
    return resolved


def _label(settings: Settings, problem: ConfigProblem) -> str:
    """Return the place of the setting that caused a problem, as "FILE:LINE: "; "" if none did."""
    path = problem.path
    paths = [path[:length] for length in range(len(path), 0, -1)]
    paths += [key for key in settings if key[: len(path)] == path]  # of a part of the value
    return next((f"{settings[key].source.label}: " for key in paths if key in settings), "")


def pack(flights: Iterable[SweepPoint]) -> bytes:
    """Pack flights into a file for pods, which have none of the user's files.

    The file contains each point once, with its resolved experiment. For each flight, it contains
    the index of the point and the seed. Equal flights give equal bytes.
    """
    points: dict[int, int] = {}  # identity of a resolved point -> its index
    shown, chosen, installed = [], [], dict[str, str]()
    with reuse_results():
        for flight in flights:
            if id(flight.resolved) not in points:
                points[id(flight.resolved)] = len(points)
                shown.append([flight.point, flight.resolved.model_dump(mode="json")])
                installed |= installed_code(flight.resolved)
            chosen.append([points[id(flight.resolved)], flight.seed])
    code = {"code": source.code_hash(), "installed": installed}
    text = json.dumps({**code, "points": shown, "flights": chosen})
    return gzip.compress(text.encode(), mtime=0)


def unpack(path: Path) -> list[SweepPoint]:
    """Read the flights from a file made by `pack`; raise a BadInputError if it is unusable.

    It is also unusable if other code has packed it: the rows would not be those of the sweep.
    """
    try:
        content = json.loads(gzip.decompress(files.read(path)))
        _refuse_other_code(content["code"])
        points = list[tuple[dict[str, Any], ResolvedExperiment, bytes]]()
        installed = dict[str, str]()
        with reuse_results():
            for point, values in content["points"]:
                resolved = ResolvedExperiment.model_validate_json(json.dumps(values))
                points.append((point, resolved, everything_of(resolved, hash_all(resolved))))
                installed |= installed_code(resolved)
        _refuse_other_plugins(content["installed"], installed)
        chosen = ((*points[index], seed) for index, seed in content["flights"])
        return [
            SweepPoint(_key(everything, seed), point, seed, resolved)
            for point, resolved, everything, seed in chosen
        ]
    except (OSError, EOFError, ValueError, LookupError, TypeError) as error:
        text = f"is not a file of flights of this version of cloudrc ({type(error).__name__})"
        raise BadInputError(f"{path}: {text}; use an image of the same version") from error


def _refuse_other_code(code: str) -> None:
    """Raise a BadInputError if flights come from another code than that of this image."""
    if code != (own := source.code_hash()):
        text = f"the flights come from code {code}, this image has code {own}"
        raise BadInputError(f"{text}; build the image from the code that runs this command")


def _refuse_other_plugins(theirs: dict[str, str], own: dict[str, str]) -> None:
    """Raise a BadInputError if this image has other installed plug-ins than the flights need."""
    if other := sorted(name for name in theirs.keys() | own if theirs.get(name) != own.get(name)):
        text = f"this image has another version of {', '.join(other)}, or lacks it"
        raise BadInputError(f"{text}; install the same packages here and in the image")
