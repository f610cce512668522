"""Named faults, the checks of what has to follow, and their results as JSON and JUnit XML."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from math import isfinite
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

Relation: TypeAlias = Literal["<=", ">=", "=="]
_COMPARE = {"<=": operator.le, ">=": operator.ge, "==": operator.eq}
YES = "yes"  # unit of a check that is a question: its value is 1 for yes, 0 for no


def generator(seed: int, use: int) -> np.random.Generator:
    """Make the random generator of one use of a seed."""
    return np.random.Generator(np.random.PCG64([seed, use]))


@dataclass(frozen=True, slots=True)
class Check:
    """One thing that has to follow: how `measured` compares with `limit`, both in `unit`."""

    text: str
    measured: float  # [any unit]
    relation: Relation
    limit: float  # [any unit]
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
    """Checks of a scenario, in order, and the hash of all records of its flights."""

    checks: list[Check] = field(default_factory=list)
    sha256: str = ""

    def flown(self, sha256: str) -> None:
        """Add the hash of the records of another flight."""
        both = f"{self.sha256} {sha256}".encode()
        self.sha256 = hashlib.sha256(both).hexdigest() if self.sha256 else sha256

    def most(self, text: str, measured: float, limit: float, unit: str = "") -> None:
        """Check that `measured` is at most its `limit`, both in `unit` [any unit]."""
        self.checks.append(Check(text, measured, "<=", limit, unit))

    def least(self, text: str, measured: float, limit: float, unit: str = "") -> None:
        """Check that `measured` is at least its `limit`, both in `unit` [any unit]."""
        self.checks.append(Check(text, measured, ">=", limit, unit))

    def same(self, text: str, measured: float, limit: float) -> None:
        """Check that a count, `measured`, is exactly its `limit` [1]."""
        self.checks.append(Check(text, measured, "==", limit))

    def true(self, text: str, holds: bool) -> None:
        """Check that a statement holds."""
        self.checks.append(Check(text, float(holds), "==", 1.0, YES))

    @property
    def passed(self) -> bool:
        """Whether every check passed, and there were some."""
        return bool(self.checks) and all(check.passed for check in self.checks)


Inject: TypeAlias = Callable[[Outcome, int], None]
"""Injects a fault with a seed, and adds the checks to an outcome."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault and what must follow from it, in words and as checks."""

    number: int  # in docs/reference/faults.md: 13 for F13
    name: str  # on the command line: cloud-killed
    injects: str
    expects: str  # what the robot does, and within what time
    inject: Inject

    @property
    def id(self) -> str:
        """Name of the fault: F13."""
        return f"F{self.number}"

    def run(self, seed: int) -> Outcome:
        """Inject the fault with a seed, and check."""
        outcome = Outcome()
        self.inject(outcome, seed)
        return outcome


def scenario(number: int, name: str, *, injects: str, expects: str) -> Callable[[Inject], Scenario]:
    """Make a `Scenario` of the function that injects the fault; the arguments are its fields."""
    return partial(Scenario, number, name, injects, expects)


class Result(NamedTuple):
    """A scenario that was run for `seconds` [s]; `error` is the exception that ended it, or ""."""

    scenario: Scenario
    outcome: Outcome
    seconds: float
    error: str = ""

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return not self.error and self.outcome.passed

    @property
    def word(self) -> str:
        """One word for a table."""
        return "passed" if self.passed else "FAILED"

    def as_json(self) -> dict[str, Any]:
        """Return the result as plain values."""
        checks = self.outcome.checks
        return {
            "id": self.scenario.id,
            "name": self.scenario.name,
            "mode": "virtual",
            "result": self.word.lower(),
            "reason": self.error,
            "seconds": round(self.seconds, 3),
            "records_sha256": self.outcome.sha256,
            "checks": [asdict(check) | {"passed": check.passed} for check in checks],
        }


def as_json(results: Sequence[Result], seed: int) -> dict[str, Any]:
    """Return the results of scenarios as plain values."""
    passed, faults = all(each.passed for each in results), [each.as_json() for each in results]
    return {"schemaVersion": 1, "seed": seed, "passed": passed, "faults": faults}
