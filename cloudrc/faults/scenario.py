"""Define a named fault, the checks of the required reaction, and the result as JSON."""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import partial
from math import isfinite
from typing import Any, Literal, TypeAlias

import numpy as np

from cloudrc.errors import describe_error

Relation: TypeAlias = Literal["<=", ">=", "=="]
_COMPARE = {"<=": operator.le, ">=": operator.ge, "==": operator.eq}
YES = "yes"  # unit of a check that is a statement: its value is 1 if the statement holds, else 0


def generator(seed: int, use: int) -> np.random.Generator:
    """Make a random generator from a seed; different `use` give independent sequences."""
    return np.random.Generator(np.random.PCG64([seed, use]))


@dataclass(frozen=True, slots=True)
class Check:
    """One check of a reaction: compares `measured` with `limit`, both in `unit`."""

    text: str
    measured: float  # [any unit]
    relation: Relation
    limit: float  # [any unit]
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether `measured` complies with `limit`; False if `measured` is NaN (not measured)."""
        known = isfinite(self.measured)
        return known and bool(_COMPARE[self.relation](self.measured, self.limit))

    def show(self) -> str:
        """Format the check on one line: its text, the measured value and the limit."""
        if self.unit == YES:
            return f"{self.text}: {'yes' if self.measured else 'NO'}"
        unit = f" {self.unit}" if self.unit else ""
        sign = "" if self.relation == "==" else f"{self.relation} "
        return f"{self.text}: {self.measured:.4g}{unit} ({sign}{self.limit:.4g})"


@dataclass(slots=True)
class Outcome:
    """Result of a scenario: its checks in order."""

    checks: list[Check] = field(default_factory=list)
    sha256: str = ""  # hash of the records of all its flights
    seconds: float = 0.0  # how long it ran [s]
    error: str = ""  # the exception that ended it, if any

    def flown(self, sha256: str) -> None:
        """Add the hash of one flight's records."""
        both = f"{self.sha256} {sha256}".encode()
        self.sha256 = hashlib.sha256(both).hexdigest() if self.sha256 else sha256

    def most(self, text: str, measured: float, limit: float, unit: str = "") -> None:
        """Check `measured` <= `limit`, both in `unit` [any unit]; `text` says what is measured."""
        self.checks.append(Check(text, measured, "<=", limit, unit))

    def least(self, text: str, measured: float, limit: float) -> None:
        """Check `measured` >= `limit`, both without a unit [1]; `text` says what is measured."""
        self.checks.append(Check(text, measured, ">=", limit))

    def same(self, text: str, measured: float, limit: float) -> None:
        """Check that `measured` equals `limit`, both counts [1]; `text` says what is counted."""
        self.checks.append(Check(text, measured, "==", limit))

    def true(self, text: str, holds: bool) -> None:
        """Check that the statement `text` is true; `holds` tells whether it is."""
        self.checks.append(Check(text, float(holds), "==", 1.0, YES))

    @property
    def passed(self) -> bool:
        """Whether the scenario ran to its end, with at least one check, and all checks passed."""
        return not self.error and bool(self.checks) and all(each.passed for each in self.checks)

    @property
    def word(self) -> str:
        """The result as a word for a table, passed or FAILED."""
        return "passed" if self.passed else "FAILED"


Inject: TypeAlias = Callable[[Outcome, int], None]
"""Function that injects a fault into a flight with a seed, and adds checks to an outcome."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault, how to inject it, and the reaction that the robot has to show."""

    number: int  # in docs/reference/faults.md: 13 for F13
    name: str  # on the command line: cloud-killed
    injects: str
    expects: str  # what the robot does, and within what time
    inject: Inject

    @property
    def id(self) -> str:
        """Number of the fault with its letter, such as F13."""
        return f"F{self.number}"

    def run(self, seed: int) -> Outcome:
        """Inject the fault, and check the reaction; an exception becomes the outcome's `error`."""
        outcome = Outcome()
        try:
            self.inject(outcome, seed)
        except Exception as error:  # the other scenarios still run
            outcome.error = describe_error(error)
        return outcome

    def as_json(self, outcome: Outcome) -> dict[str, Any]:
        """Return one result of this scenario as values for a JSON document."""
        return {
            "id": self.id,
            "name": self.name,
            "mode": "virtual",
            "result": outcome.word.lower(),
            "reason": outcome.error,
            "seconds": round(outcome.seconds, 3),
            "records_sha256": outcome.sha256,
            "checks": [asdict(check) | {"passed": check.passed} for check in outcome.checks],
        }


def scenario(number: int, name: str, *, injects: str, expects: str) -> Callable[[Inject], Scenario]:
    """Decorate a function that injects a fault: convert it to a `Scenario` with these values."""
    return partial(Scenario, number, name, injects, expects)
