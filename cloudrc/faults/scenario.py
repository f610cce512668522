"""A fault, what brings it about, and the checks of what has to follow."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable
from dataclasses import dataclass, field
from math import isfinite
from typing import Literal, TypeAlias

import numpy as np

Relation: TypeAlias = Literal["<=", ">=", "=="]

_COMPARE = {"<=": operator.le, ">=": operator.ge, "==": operator.eq}
YES = "yes"
"""Unit of a check that is a question: its value is 1 for yes, 0 for no."""


def generator(seed: int, use: int) -> np.random.Generator:
    """Make the random generator of one use of a seed."""
    return np.random.Generator(np.random.PCG64([seed, use]))


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that has to follow.

    Attributes:
        text: The thing in words.
        measured: Measured value [`unit`].
        relation: How the value has to compare with the limit.
        limit: Limit [`unit`].
        unit: Unit of both; "" for counts, `YES` for yes (1) or no (0).
    """

    text: str
    measured: float
    relation: Relation
    limit: float
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether it followed; what could not be measured did not."""
        known = isfinite(self.measured)
        return known and bool(_COMPARE[self.relation](self.measured, self.limit))

    def show(self) -> str:
        """Return one line with the value and its limit."""
        if self.unit == YES:
            return f"{self.text}: {'yes' if self.measured else 'NO'}"
        unit = f" {self.unit}" if self.unit else ""
        sign = "" if self.relation == "==" else f"{self.relation} "
        return f"{self.text}: {self.measured:.4g}{unit} ({sign}{self.limit:.4g})"


@dataclass(slots=True)
class Outcome:
    """Result of a scenario.

    Attributes:
        checks: Checks, in order.
        sha256: Hash of all records of all flights; "" if there are none.
    """

    checks: list[Check] = field(default_factory=list)
    sha256: str = ""

    def flown(self, sha256: str) -> None:
        """Add the hash of the records of another flight."""
        both = f"{self.sha256} {sha256}".encode()
        self.sha256 = hashlib.sha256(both).hexdigest() if self.sha256 else sha256

    def add(self, other: Outcome) -> None:
        """Add the result of another part of the scenario."""
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
        """Check that a statement holds."""
        self.checks.append(Check(text, float(holds), "==", 1.0, YES))

    @property
    def passed(self) -> bool:
        """Whether every check passed, and there were some."""
        return bool(self.checks) and all(check.passed for check in self.checks)


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault and what must follow from it.

    Attributes:
        number: Number in docs/reference/faults.md: 13 for F13.
        name: Name on the command line: cloud-killed.
        injects: What is done, in words.
        expects: What the robot does and within what time, in words.
        loses: What may be lost.
        shows: What the user sees, or which metric moves.
        run: Injects the fault with a seed, and checks.
    """

    number: int
    name: str
    injects: str
    expects: str
    loses: str
    shows: str
    run: Callable[[int], Outcome]

    @property
    def id(self) -> str:
        """Name of the fault: F13."""
        return f"F{self.number}"
