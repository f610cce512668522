# SPDX-License-Identifier: Apache-2.0

"""Define a task for a class: its files, and the tests and points of each part.

A lecturer's own task has tests by flights alone; formulas are those of the exercise of
docs/exercise.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, StringConstraints, model_validator

from cloudrc.base.outside.document import read_document
from cloudrc.config.problems import validate
from cloudrc.config.section import Section

FormulaName = Literal[
    "mean", "hold time", "position", "orientation", "velocity, stamp", "P", "I", "D", "limit"
]
FileName = Annotated[str, StringConstraints(pattern=r"^[\w-]+(\.[\w-]+)*\.\w+$")]


class TestConfig(Section):
    """A test: a flight, or for the files of the exercise a formula."""

    points: Annotated[int, Field(ge=1, le=1000)]
    """Points for a right result"""
    formula: FormulaName | None = None
    """Name of a formula of the exercise, in place of a flight"""
    experiment: str = "steps"
    """Experiment that flies with the student's file: a name, or a file beside that of the task"""
    set: dict[str, Any] = Field(default_factory=dict)
    """Keys of the experiment, such as link.profile, and their values"""
    number: str = ""
    """Number of the report that decides about the points, such as iae_mean"""
    full: float = 0.0
    """Value of the number that gives all points, in its unit"""
    none: float = 0.0
    """Value that gives no points; linear in between"""

    @model_validator(mode="after")
    def _check(self) -> TestConfig:
        if (self.formula is None) == (not self.number):
            raise ValueError("give either a formula, or a number with full and none")
        if self.number and self.full == self.none:
            raise ValueError("full and none are equal; give two different values")
        return self


class PartConfig(Section):
    """A part of a task."""

    file: FileName | None = None
    """Name of the student's file; null: the part flies with the files of all parts"""
    key: str = ""
    """Key of the experiment that gets the file (default: cloud.PART)"""
    tests: Annotated[dict[str, TestConfig], Field(min_length=1)]
    """Name of each test, and what it asks"""


class Task(Section):
    """What students hand in, and how it is scored."""

    parts: Annotated[dict[str, PartConfig], Field(min_length=1)]
    """Name of each part, in order"""

    @model_validator(mode="after")
    def _check_files(self) -> Task:
        if not self.files:
            raise ValueError("parts: no part has a file; students hand in at least one")
        return self

    @property
    def files(self) -> dict[str, str]:
        """Part -> the student's file."""
        return {name: part.file for name, part in self.parts.items() if part.file}

    def key(self, part: str) -> str:
        """Return the key of the experiment that gets the file of a part."""
        return self.parts[part].key or f"cloud.{part}"


def read_task(path: Path) -> Task:
    """Read a task; raise a BadInputError that lists all problems."""
    return validate(read_document(path, str(path)), Task, str(path))
