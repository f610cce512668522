"""A fault by name: its injector runs, its checks say whether what has to follow did follow.

All scenarios: the families are found by their files' names, their faults sorted by number.
"""

from __future__ import annotations

import hashlib
import importlib
import operator
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite
from typing import Literal, TypeAlias, get_args

import numpy as np

import cloudrc.faults
from cloudrc.errors import BadInputError
from cloudrc.plugins import suggest_name

Mode: TypeAlias = Literal["virtual", "real", "cluster"]
Relation: TypeAlias = Literal["<=", ">=", "=="]

_COMPARE = {"<=": operator.le, ">=": operator.ge, "==": operator.eq}
YES = "yes"
"""Takes the place of a unit: the check is a question, its measure 1 for yes and 0 for no."""


def generator(seed: int, use: int) -> np.random.Generator:
    """Chance of one use."""
    return np.random.Generator(np.random.PCG64([seed, use]))


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that has to follow.

    Attributes:
        text: What, in words.
        measured: What came out, in `unit` [any unit].
        relation: How it has to compare with the limit.
        limit: As promised, in `unit` [any unit].
        unit: Of both; "" for counts, `YES` for yes (1) or no (0).
    """

    text: str
    measured: float
    relation: Relation
    limit: float
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether it did follow; what could not be measured did not."""
        known = isfinite(self.measured)
        return known and bool(_COMPARE[self.relation](self.measured, self.limit))

    def show(self) -> str:
        """One line: the promise and what was measured."""
        if self.unit == YES:
            return f"{self.text}: {'yes' if self.measured else 'NO'}"
        unit = f" {self.unit}" if self.unit else ""
        sign = "" if self.relation == "==" else f"{self.relation} "
        return f"{self.text}: {self.measured:.4g}{unit} ({sign}{self.limit:.4g})"


@dataclass(slots=True)
class Outcome:
    """What running a scenario showed.

    Attributes:
        checks: In order.
        sha256: Over all records of all its flights; "" where there are none.
        skipped: Why it could not be run here; "" if it was.
    """

    checks: list[Check] = field(default_factory=list)
    sha256: str = ""
    skipped: str = ""

    def flown(self, sha256: str) -> None:
        """Take the hash of one more flight's records over."""
        both = f"{self.sha256} {sha256}".encode()
        self.sha256 = hashlib.sha256(both).hexdigest() if self.sha256 else sha256

    def add(self, other: Outcome) -> None:
        """Take over what another part of the scenario has shown."""
        self.checks += other.checks
        if other.sha256:
            self.flown(other.sha256)

    def most(self, text: str, measured: float, limit: float, unit: str = "") -> None:
        """Check that `measured` is at most its `limit`, both in `unit` [any unit]."""
        self.checks.append(Check(text, measured, "<=", limit, unit))

    def least(self, text: str, measured: float, limit: float, unit: str = "") -> None:
        """Check that `measured` is at least its `limit`, both in `unit` [any unit]."""
        self.checks.append(Check(text, measured, ">=", limit, unit))

    def same(self, text: str, measured: float, limit: float, unit: str = "") -> None:
        """Check that `measured` is exactly its `limit`, both in `unit` [any unit]."""
        self.checks.append(Check(text, measured, "==", limit, unit))

    def true(self, text: str, holds: bool) -> None:
        """Check that something is so."""
        self.checks.append(Check(text, float(holds), "==", 1.0, YES))

    @property
    def passed(self) -> bool:
        """Whether every check passed, and there were some."""
        return bool(self.checks) and all(check.passed for check in self.checks)


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault of the table, and what must follow from it.

    Attributes:
        number: As in the table: 13 for F13.
        name: For the command line: cloud-killed.
        injects: What is done, in words.
        expects: What the robot does and within what time, in words.
        loses: What may be lost.
        shows: What the user sees, or which metric moves.
        run: Brings it about with a seed, and checks.
        mode: Where it runs.
    """

    number: int
    name: str
    injects: str
    expects: str
    loses: str
    shows: str
    run: Callable[[int], Outcome]
    mode: Mode = "virtual"

    @property
    def id(self) -> str:
        """Name of the fault: F13."""
        return f"F{self.number}"


FOLDERS = ("scenarios", "real", "cluster")
"""Folders of `cloudrc.faults` whose modules list scenarios, by mode: virtual, real, cluster."""
MODES = get_args(Mode)


def scenarios(mode: Mode | None = None) -> list[Scenario]:
    """List the faults, sorted.

    Args:
        mode: Only those that run there; None for all.
    """
    found: list[Scenario] = []
    for module in pkgutil.walk_packages(cloudrc.faults.__path__, "cloudrc.faults."):
        if module.name.split(".")[2] in FOLDERS:
            found += getattr(importlib.import_module(module.name), "SCENARIOS", ())
    chosen = [each for each in found if mode is None or each.mode == mode]
    return sorted(chosen, key=lambda each: (each.number, MODES.index(each.mode)))


def find(name: str, mode: Mode) -> Scenario:
    """Give a fault by its name (cloud-killed), or the first of a number (F13).

    Raises:
        BadInputError: If there is none in this mode; names those that there are.
    """
    return called(name, mode)[0]


def called(name: str, mode: Mode) -> list[Scenario]:
    """Give the fault of a name, or all of a number: F31 with real processes are two.

    Raises:
        BadInputError: If there is none in this mode; names those that there are.
    """
    there = scenarios(mode)
    if found := [each for each in there if name.lower() in (each.id.lower(), each.name)]:
        return found
    for other in scenarios():
        if name.lower() in (other.id.lower(), other.name):
            flag = "" if other.mode == "virtual" else f" --{other.mode}"
            raise BadInputError(
                f"{other.id} {other.name} is not in mode {mode}; try:"
                f" cloudrc faults run {other.name}{flag}"
            )
    names = ", ".join(f"{each.id} {each.name}" for each in there) or "none"
    hint = suggest_name(name.lower(), [each.name for each in there])
    raise BadInputError(f"no fault '{name}' in mode {mode}; there are: {names}{hint}")
