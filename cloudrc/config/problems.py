"""What is wrong with a configuration, in words: pydantic's errors in, one line for each out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from cloudrc.config import describe
from cloudrc.config.document import Document
from cloudrc.config.yaml_text import Path
from cloudrc.errors import BadInputError

_LISTED = 50  # a mission of thousands of points in wrong units is wrong thousands of times


@dataclass(frozen=True, slots=True)
class Problem:
    """One thing that is wrong.

    Attributes:
        path: Keys down to the value.
        value: The value in words; empty if it is not there.
        reason: What it must be, and what to do.
    """

    path: Path
    value: str
    reason: str

    def __str__(self) -> str:
        return ": ".join(part for part in (".".join(self.path), self.value, self.reason) if part)


def from_pydantic(
    error: ValidationError, model: type[BaseModel], prefix: Path = (), limit: int | None = None
) -> list[Problem]:
    """Put pydantic's errors into words.

    Args:
        error: As raised by `model`.
        model: Whose keys, ranges and units are named.
        prefix: Keys above the model's own.
        limit: How many problems are put into words; None for all.
    """
    details = error.errors(include_url=False)[:limit]
    return [_problem(detail, model, prefix) for detail in details]


def refuse(document: Document, problems: Iterable[Problem], name: str) -> None:
    """Raise a BadInputError that lists all problems, each with its place; none raises nothing."""
    every = _finest(problems)
    lines = [f"{document.source(problem.path).label}: {problem}" for problem in every[:_LISTED]]
    if len(every) == 1:
        raise BadInputError(lines[0])
    if len(every) > _LISTED:
        lines.append(f"and {len(every) - _LISTED} more")
    if every:
        raise BadInputError("\n  ".join([f"{name} has {len(every)} problems:", *lines]))


def _finest(problems: Iterable[Problem]) -> list[Problem]:
    """Leave out what follows from another problem: a value is wrong where a part of it is.

    A plug-in that lacks a parameter, say, stays a name, and the schema asks for what it would be.
    """
    every = list(problems)
    above = {problem.path[:n] for problem in every for n in range(1, len(problem.path))}
    return [problem for problem in every if problem.path not in above]


def in_words(value: Any) -> str:
    """Show a value from a file, shortened."""
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list" if len(value) > 4 else f"[{', '.join(map(in_words, value))}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _problem(detail: ErrorDetails, model: type[BaseModel], prefix: Path) -> Problem:
    kind, value = detail["type"], in_words(detail["input"])
    keys = tuple(map(str, detail["loc"]))
    # Names of a union's members are tagged with <>: they are no keys. What nobody knows is one.
    unknown = keys[-1:] if kind == "extra_forbidden" else ()
    known = keys[: len(keys) - len(unknown)]
    path = tuple(key for key in known if not key.startswith("<")) + unknown
    if kind == "extra_forbidden":
        return Problem(prefix + path, "", f"unknown key; {describe.nearest_key(model, path)}")
    if kind == "missing":
        expected = describe.expectation(model, path)
        return Problem(prefix + path, "", f"is missing; {expected}")
    if kind == "value_error":
        return Problem(prefix + path, "", str(detail["ctx"]["error"]))
    if kind == "too_long":
        return Problem(prefix + path, "", f"at most {detail['ctx']['max_length']} entries")
    if kind == "string_too_long":
        longest = detail["ctx"]["max_length"]
        return Problem(prefix + path, value, f"must be text of at most {longest} characters")
    if kind == "unprintable":
        return Problem(prefix + path, value, detail["msg"])
    if kind == "literal_error":
        return Problem(prefix + path, value, describe.nearest_choice(detail))
    if kind == "string_pattern_mismatch":
        return Problem(prefix + path, value, "must be text without slashes")
    if kind == "finite_number":
        return Problem(prefix + path, value, "must be finite")
    return Problem(prefix + path, value, describe.expectation(model, path))
