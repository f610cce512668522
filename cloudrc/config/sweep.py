"""Read the file of a sweep: a grid of settings of an experiment, each with several seeds.

docs/sweeps.md describes the file. A *point* has one value of each axis.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from itertools import chain, product
from math import prod
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from pydantic import Field, field_validator

from cloudrc.config import problems, shipped
from cloudrc.config.overrides import (
    Given,
    Settings,
    check_no_seed,
    collect_settings,
    split_settings,
)
from cloudrc.config.problems import ConfigProblem
from cloudrc.config.section import Section
from cloudrc.errors import BadInputError
from cloudrc.outside.document import Document, Source, parse_yaml, read_document, write_yaml

SEED_MAX, SEEDS_MAX = 2**53 - 1, 10_000
"""Largest seed, and largest number of seeds."""
Choice: TypeAlias = tuple[Any, list[Given]]
"""A value of an axis, or its name, and the settings that it means."""


class SweepFile(Section):
    """The content of a sweep file, as YAML keys."""

    experiment: str = "paper"
    """Name or path of the experiment"""
    set: dict[str, Any] = Field(default_factory=dict)
    """Settings of all points"""
    grid: dict[str, Any] = Field(default_factory=dict)
    """Axes: a key and a list of its values, or a name and a mapping of named settings"""
    seeds: list[int] = Field([1])
    """Number of seeds, which begin with 1, or a list of seeds"""
    cost: bool = False
    """Whether to fly every point without a network, too, which gives the number J/J0"""
    folder: str | None = None
    """Folder in which relative paths start (default: that of the file)"""

    @field_validator("seeds", mode="before")
    @classmethod
    def _list(cls, given: Any) -> list[int]:
        """List the seeds if their number is given; they must be different."""
        if type(given) is int:
            given = [*range(1, min(given, SEEDS_MAX + 1) + 1)]
        seeds = given if isinstance(given, list) else []
        if all(type(seed) is int and 0 <= seed <= SEED_MAX for seed in seeds):
            if 0 < len({*seeds}) == len(seeds) <= SEEDS_MAX:
                return seeds
        text = f"must be a number of seeds, 1 to {SEEDS_MAX}, or a list of different seeds"
        raise ValueError(text)


class Draft(NamedTuple):
    """A sweep whose points are not checked yet."""

    name: str  # of the file, for errors
    file: dict[str, Any]  # its content
    experiment: str
    common: list[Given]
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

    def points(self) -> Iterator[tuple[dict[str, Any], Settings]]:
        """Yield each point in the order of the grid, with its settings."""
        for choices in product(*self.axes.values()):
            labels = [label for label, _ in choices]
            settings = collect_settings(chain(self.common, *(given for _, given in choices)))
            check_no_seed(settings)
            yield dict(zip(self.axes, labels, strict=True)), settings

    def problem(self, text: str) -> BadInputError:
        """Return the error about the sweep as a whole."""
        return BadInputError(f"{self.name}: {text}")


def draft_of(
    experiment: str,
    settings: Iterable[str],
    seeds: int,
    sides: Mapping[str, Iterable[str]] | None = None,
) -> Draft:
    """Draft the flights of an experiment with `settings` (KEY=VALUE) and the seeds 1 to `seeds`.

    With `sides`, a name -> further settings, the axis "side" has these names.
    """
    common = split_settings(settings)
    values = {key: value for key, value, _ in common}
    here = str(Path.cwd())
    file = {"experiment": experiment, "set": values, "seeds": seeds, "folder": here}
    axes = {"side": [(name, split_settings(each)) for name, each in (sides or {}).items()]}
    return Draft(
        "--set", file, experiment, common, axes if sides else {}, tuple(range(1, seeds + 1))
    )


def read_draft(
    given: Path | Mapping[str, Any], taken: Container[str], flights_max: int | None = None
) -> Draft:
    """Read a sweep, the path of its file or its content, and check all but its points.

    No axis may have one of the names `taken`. Raise a BadInputError about all problems, or if there
    are more than `flights_max` flights.
    """
    if isinstance(given, Path):
        name, start, document = str(given), given.resolve().parent, read_document(given, str(given))
    else:
        name, start = "sweep", Path.cwd()
        tree, _ = parse_yaml(write_yaml(dict(given)), name)
        document = Document(tree, {(): Source(name, start)})
    file = problems.validate(document, SweepFile, name)
    folder = Path(file.folder or start)
    common = [_given(document, folder, key, value, "set", key) for key, value in file.set.items()]
    axes = {axis: _choices(document, folder, axis, each) for axis, each in file.grid.items()}
    problems.raise_problems(document, _check_axes(axes, taken), name)
    is_path = shipped.is_path(file.experiment)
    experiment = str(folder / file.experiment) if is_path else file.experiment
    content = document.tree | {"folder": str(folder)}
    draft = Draft(name, content, experiment, common, axes, tuple(file.seeds), file.cost)
    if flights_max is not None and draft.flights > flights_max:
        text = f"{draft.size} are more than {flights_max:,}; take fewer values or seeds, or give "
        raise draft.problem(f"{text}--max-flights {draft.flights}")
    return draft


def _given(document: Document, folder: Path, key: str, value: Any, *path: str) -> Given:
    """Return a setting of a document, whose value is at `path`."""
    source = document.source(path)
    if path not in document.sources:  # no file, so no line
        source = source._replace(label=f"{source.label}: {path[0]}")
    return key, value, source._replace(folder=folder)


def _choices(document: Document, folder: Path, axis: str, given: Any) -> list[Choice]:
    """Return the choices of an axis; [] if they are neither a list nor named settings."""

    def setting(key: str, value: Any, *path: str) -> Given:
        return _given(document, folder, key, value, "grid", axis, *path)

    if isinstance(given, list):
        return [(value, [setting(axis, value, str(n))]) for n, value in enumerate(given)]
    if isinstance(given, dict) and all(isinstance(each, dict) for each in given.values()):
        return [
            (name, [setting(key, value, name, key) for key, value in each.items()])
            for name, each in given.items()
        ]
    return []


def _check_axes(axes: Mapping[str, list[Choice]], taken: Container[str]) -> Iterator[ConfigProblem]:
    """Yield the problems of the axes."""
    for axis, choices in axes.items():
        if not choices:
            text = "must be a list of values, or names, each with a mapping of keys to values"
            yield ConfigProblem(("grid", axis), "", text)
        if axis in taken:
            text = "is the name of another column; rename the axis"
            yield ConfigProblem(("grid", axis), "", text)
