"""Read the file of a sweep: a grid of settings of an experiment, flown with several seeds.

    experiment: steps                    # name, or path of a file
    set: {link.profile: paper-p3}        # settings of all points
    grid:
      cloud.predictor: [constant_velocity, constant_acceleration]
      link.both.delay_ms: [0, 20, 40]    # an axis: a key and its values
      tuning:                            # an axis of named settings
        slow: {cloud.controller.gain_p: [1, 1, 1]}
        fast: {cloud.controller.gain_p: [2, 2, 2]}
    seeds: 20                            # 1 to 20, or a list

A point has one value of each axis. Every point is loaded and checked before the first flight. A
flight is one point with one seed; its key is a hash of its resolved experiment with the seed.
Relative paths start at the folder of the file, or at `folder` if the file gives it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, product
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from pydantic import Field

from cloudrc import metrics
from cloudrc.config import problems, shipped
from cloudrc.config.document import Document, KeyPath, Source, read_document
from cloudrc.config.load import ResolvedExperiment, load_experiment, validate
from cloudrc.config.overrides import collect_settings
from cloudrc.config.problems import Problem
from cloudrc.config.schema import Section
from cloudrc.errors import BadInputError

SEED_MAX, SEEDS_MAX = 2**53 - 1, 10_000
"""Largest seed, and largest number of seeds."""


class SweepFile(Section):
    """The keys of the file."""

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


class Flight(NamedTuple):
    """One point with one seed."""

    key: str  # 16 hexadecimal digits
    point: dict[str, Any]  # axis -> value or name
    experiment: ResolvedExperiment  # with the seed


@dataclass(frozen=True, slots=True)
class Plan:
    """A sweep whose points have been checked."""

    file: dict[str, Any]  # content of the file, with `folder`
    axes: dict[str, list[Any]]  # axis -> its values or names
    seeds: tuple[int, ...]
    points: list[tuple[dict[str, Any], ResolvedExperiment]]
    keys: list[str]  # of all flights: point by point, each with all seeds

    @property
    def experiment(self) -> ResolvedExperiment:
        """The experiment of the first point."""
        return self.points[0][1]

    def flight(self, number: int) -> Flight:
        """Return a flight by its place in `keys`."""
        at, nth = divmod(number, len(self.seeds))
        point, experiment = self.points[at]
        return Flight(
            self.keys[number], point, experiment.model_copy(update={"seed": self.seeds[nth]})
        )


_Entry: TypeAlias = tuple[str, Any, Source]
"""A key, its value, and where both are from."""
_Axis: TypeAlias = list[tuple[Any, list[_Entry]]]
"""The choices of an axis: each a value or a name, and the settings."""


def read_plan(path: Path) -> Plan:
    """Read the file of a sweep, and check all of its points.

    Raises:
        BadInputError: If the file or one of its points has problems, with file and line of each.
    """
    name, document = str(path), read_document(path, str(path))
    file = validate(document, SweepFile, name)
    folder = Path(file.folder or path.resolve().parent)
    found, seeds = list[Problem](), _seeds(file.seeds)
    if not seeds:
        text = f"must be a number of seeds, 1 to {SEEDS_MAX}, or a list of different seeds"
        found.append(Problem(("seeds",), problems.in_words(file.seeds), text))
    common = _entries(document, folder, ("set",), file.set)
    axes = {key: _axis(document, folder, key, choices, found) for key, choices in file.grid.items()}
    problems.raise_problems(document, found, name)
    is_path = shipped.is_path(file.experiment)
    experiment = str(folder / file.experiment) if is_path else file.experiment
    points, keys = list[tuple[dict[str, Any], ResolvedExperiment]](), dict[str, dict[str, Any]]()
    for choices in product(*axes.values()):
        point = {key: label for key, (label, _) in zip(axes, choices, strict=True)}
        resolved = _resolve(experiment, [*common, *chain(*(entries for _, entries in choices))])
        points.append((point, resolved))
        for key in _keys(resolved, seeds):
            if key in keys:
                raise BadInputError(f"{name}: {point} is the same as {keys[key]}; remove one")
            keys[key] = point
    values = {key: [label for label, _ in choices] for key, choices in axes.items()}
    return Plan(document.tree | {"folder": str(folder)}, values, seeds, points, [*keys])


def _seeds(given: Any) -> tuple[int, ...]:
    """Return the seeds of the file's value; none if the value is invalid."""
    if type(given) is int:
        return tuple(range(1, given + 1)) if given <= SEEDS_MAX else ()
    values = given if isinstance(given, list) else []
    valid = all(type(seed) is int and 0 <= seed <= SEED_MAX for seed in values)
    return tuple(values) if valid and len({*values}) == len(values) <= SEEDS_MAX else ()


def _axis(document: Document, folder: Path, key: str, choices: Any, found: list[Problem]) -> _Axis:
    """Return the choices of an axis, and add its problems to `found`."""
    path = ("grid", key)
    if not choices or not isinstance(choices, list | dict):
        text = "must be a list of values, or a mapping of names to settings; give at least one"
        found.append(Problem(path, "", text))
        return []
    if isinstance(choices, list):
        sources = [document.source((*path, str(n))) for n in range(len(choices))]
        sources = [source._replace(folder=folder) for source in sources]
        pairs = zip(choices, sources, strict=True)
        return [(value, [(key, value, source)]) for value, source in pairs]
    wrong = [name for name, settings in choices.items() if not isinstance(settings, dict)]
    text = "must be a mapping of keys to values"
    found += [Problem((*path, name), problems.in_words(choices[name]), text) for name in wrong]
    return [
        (name, _entries(document, folder, (*path, name), settings))
        for name, settings in choices.items()
        if name not in wrong
    ]


def _entries(
    document: Document, folder: Path, above: KeyPath, settings: dict[str, Any]
) -> list[_Entry]:
    return [
        (key, value, document.source((*above, key))._replace(folder=folder))
        for key, value in settings.items()
    ]


def _resolve(experiment: str, entries: list[_Entry]) -> ResolvedExperiment:
    settings = collect_settings(entries)
    if ("seed",) in settings:
        source = settings["seed",].source
        raise BadInputError(f"{source.label}: seed: give the seeds with the key 'seeds'")
    resolved = load_experiment(experiment, settings)
    metrics.check(resolved.report.metrics)
    return resolved


def _keys(experiment: ResolvedExperiment, seeds: Iterable[int]) -> Iterator[str]:
    """Yield the keys of an experiment's flights: equal keys mean equal flights."""
    values = experiment.model_dump(mode="json")
    for seed in seeds:
        text = json.dumps(values | {"seed": seed}, sort_keys=True)
        yield hashlib.sha256(text.encode()).hexdigest()[:16]
