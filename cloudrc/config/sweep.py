# SPDX-License-Identifier: Apache-2.0

"""Read the file of a sweep: a grid of settings of an experiment, each with several seeds.

docs/sweeps.md describes the file. A *point* has one value of each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from itertools import chain, product
from math import prod
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias

from pydantic import Field, ValidatorFunctionWrapHandler, field_validator

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.document import plain_document, read_document
from cloudrc.config import problems, shipped
from cloudrc.config.overrides import (
    Given,
    Settings,
    check_no_seed,
    collect_settings,
    parse_settings,
)
from cloudrc.config.problems import ConfigProblem
from cloudrc.config.schema import Seed
from cloudrc.config.section import Section

SEEDS_MAX = 10_000
"""Largest number of seeds."""
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
    seeds: Annotated[list[Seed], Field(min_length=1, max_length=SEEDS_MAX)] = [1]  # noqa: RUF012
    """Number of seeds, which begin with 1, or a list of seeds"""
    cost: bool = False
    """Whether to fly every point without a network, too, which gives the number J/J0; where the
    setpoint waits for the robot, off_ideal_path and T/T0"""
    folder: str | None = None
    """Folder in which relative paths start (default: that of the file)"""

    @field_validator("seeds", mode="wrap")
    @classmethod
    def _list(cls, given: Any, check: ValidatorFunctionWrapHandler) -> list[int]:
        """List the seeds if their number is given."""
        is_number = type(given) is int
        seeds: list[int] = check([*range(1, min(given, SEEDS_MAX + 1) + 1)] if is_number else given)
        if len({*seeds}) < len(seeds):
            raise ValueError("repeats a seed; give each once")
        return seeds


class Draft(NamedTuple):
    """A sweep whose points are not checked yet."""

    name: str  # of the file, for errors
    file: dict[str, Any]  # its content
    experiment: str
    common: list[Given]
    axes: dict[str, list[Choice]]
    seeds: list[int]
    cost: bool

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
    *,
    cost: bool = False,
) -> Draft:
    """Draft the flights of an experiment with `settings` (KEY=VALUE) and the seeds 1 to `seeds`.

    With `sides`, a name -> further settings, the axis "side" has these names. `cost` is that of a
    file.
    """

    def values(texts: Iterable[str]) -> dict[str, Any]:
        return {".".join(path): each.value for path, each in parse_settings(texts).items()}

    axes = {"side": {name: values(texts) for name, texts in sides.items()}} if sides else {}
    file = {"experiment": experiment, "set": values(settings), "grid": axes, "seeds": seeds}
    return read_draft({**file, "cost": cost}, (), name="--set")


def read_draft(
    given: Path | Mapping[str, Any],
    taken: Container[str],
    flights_max: int | None = None,
    name: str = "sweep",
) -> Draft:
    """Read a sweep, the path of its file or its content, and check all but its points.

    No axis may have one of the names `taken`. `name` is that of a content in errors. Raise a
    BadInputError about all problems, or if there are more than `flights_max` flights.
    """
    if isinstance(given, Path):
        name, start, document = str(given), given.resolve().parent, read_document(given, str(given))
    else:
        start, document = Path.cwd(), plain_document(given, name)
    file = problems.validate(document, SweepFile, name)
    folder = Path(file.folder or start)

    def setting(key: str, value: Any, *path: str) -> Given:
        return key, value, document.source(path)._replace(folder=folder)

    common = [setting(key, value, "set", key) for key, value in file.set.items()]
    axes = {axis: _choices(axis, each, setting) for axis, each in file.grid.items()}
    problems.raise_problems(document, _check_axes(axes, taken), name)
    is_path = shipped.is_path(file.experiment)
    experiment = str(folder / file.experiment) if is_path else file.experiment
    content = document.tree | {"folder": str(folder)}
    draft = Draft(name, content, experiment, common, axes, file.seeds, file.cost)
    if flights_max is not None and draft.flights > flights_max:
        text = f"{draft.size} are more than {flights_max:,}; take fewer values or seeds, or give "
        raise draft.problem(f"{text}--max-flights {draft.flights}")
    return draft


def _choices(axis: str, given: Any, setting: Callable[..., Given]) -> list[Choice]:
    """Return the choices of an axis; [] if they are neither a list nor named settings.

    `setting` makes a setting of a key, a value and its path.
    """
    above = "grid", axis
    if isinstance(given, list):
        return [(value, [setting(axis, value, *above, str(n))]) for n, value in enumerate(given)]
    if isinstance(given, dict) and all(isinstance(each, dict) for each in given.values()):
        return [
            (name, [setting(key, value, *above, name, key) for key, value in each.items()])
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
