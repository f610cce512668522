# SPDX-License-Identifier: Apache-2.0

"""Describe problems of a configuration, each in one line: file, key, value, and how to fix it.

The schema provides the texts: type, range and unit of a key, or the key most similar to a typo.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.document import Document, KeyPath
from cloudrc.base.outside.values import shorten
from cloudrc.config.keys import known_at, unit_at, unit_in

_Model = TypeVar("_Model", bound=BaseModel)
_LISTED = 50
"""Largest number of problems in one error message."""


@contextmanager
def collect(found: list[ConfigProblem], path: KeyPath) -> Iterator[None]:
    """Turn a BadInputError of the `with` block into a problem at `path`, and add it to `found`."""
    try:
        yield
    except BadInputError as error:
        found.append(ConfigProblem(path, "", str(error)))


def _nearest_key(model: type[BaseModel], path: KeyPath) -> str:
    """Return a hint about the unknown key at `path`: a similar known key, or all known keys."""
    key, known = path[-1], known_at(model, path[:-1])
    # `delay` is nearest to `delay_ms`: a forgotten unit is more likely than a typo.
    without_unit = [name for name in known if name.startswith(f"{key}_")]
    near = without_unit or difflib.get_close_matches(key, known, n=1)
    if near:
        return f"did you mean {near[0]} {unit_in(known[near[0]])}".strip() + "?"
    return f"known here: {', '.join(known)}"


class ConfigProblem(NamedTuple):
    """One problem of a configuration."""

    path: KeyPath  # keys that lead to the value
    value: str  # the value as short text; "" if there is no value
    reason: str  # why the value is invalid, and how to fix it
    cause: BaseException | None = None  # the error that --debug shows, with the user's lines

    def __str__(self) -> str:
        return ": ".join(part for part in (".".join(self.path), self.value, self.reason) if part)


class ProblemsError(BadInputError):
    """Problems of an experiment that no document shows; who knows their sources may name them."""

    def __init__(self, problems: Sequence[ConfigProblem]) -> None:
        """Set the problems; their paths begin at the top of the experiment."""
        super().__init__(problems)  # pickle passes these arguments to the parent process
        self.problems = tuple(problems)

    @property
    def cause(self) -> str:
        """What is wrong."""
        return "; ".join(map(str, self.problems))


def problem_at(key: str, reason: str) -> ProblemsError:
    """Return the error about the value of a key, such as "world.robot"."""
    return ProblemsError([ConfigProblem(tuple(key.split(".")), "", reason)])


@contextmanager
def at_key(key: str, place: str = "") -> Iterator[None]:
    """Turn a BadInputError of the `with` block into one about the value of a key.

    `place` precedes its text. An error that names its key already stays as it is.
    """
    try:
        yield
    except ProblemsError:
        raise
    except BadInputError as error:
        raise problem_at(key, f"{place}{error}") from error


def from_pydantic(
    error: ValidationError, model: type[BaseModel], limit: int | None = None
) -> list[ConfigProblem]:
    """Convert the first `limit` validation errors of `model`."""
    details = error.errors(include_url=False)[:limit]
    return [_problem(detail, model) for detail in details]


def raise_problems(document: Document, problems: Iterable[ConfigProblem], name: str) -> None:
    """If there are problems, raise a BadInputError that lists them with file and line."""
    every = list(problems)
    lines = [f"{document.source(problem.path).label}: {problem}" for problem in every[:_LISTED]]
    if len(every) > _LISTED:
        lines.append(f"and {len(every) - _LISTED} more")
    if len(every) > 1:
        lines.insert(0, f"{name} has {len(every)} problems:")
    if every:
        raise BadInputError("\n  ".join(lines)) from every[0].cause


def validate(
    document: Document,
    model: type[_Model],
    name: str,
    found: Sequence[ConfigProblem] = (),
    *,
    context: object = None,
) -> _Model:
    """Convert a document to `model`; `name` names the document in error messages.

    The model's validators see `context`. If there are problems, raise one BadInputError for all:
    the new ones and those in `found`.
    """
    known = {problem.path for problem in found}
    try:
        # In JSON mode pydantic accepts lists for tuples and is still strict.
        result = model.model_validate_json(json.dumps(document.tree), context=context)
    except ValidationError as error:
        more = from_pydantic(error, model)
        found = [*found, *(problem for problem in more if problem.path not in known)]
    raise_problems(document, found, name)
    return result


def in_words(value: Any) -> str:
    """Describe a value of a configuration in a short text."""
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list" if len(value) > 4 else f"[{', '.join(map(in_words, value))}]"
    words = {"None": "null", "True": "true", "False": "false"}
    return words.get(repr(value), shorten(value))


_WITHOUT_VALUE = ("extra_forbidden", "missing", "value_error", "too_long", "too_short")
"""Types of pydantic's errors whose message does not show the value."""
_REASONS: Mapping[str, str] = {
    "value_error": "{error}",
    "too_long": "must have at most {max_length} entries",
    "too_short": "must have at least {min_length} of them",
    "string_pattern_mismatch": "must be text without slashes",
    "missing": "is missing",
    "needs_python_object": "must be an object of a class, which YAML cannot contain",
}
"""Type of pydantic's error -> format of `ConfigProblem.reason`."""
_WORDS = {
    "Input should": "must",
    **{"greater than or equal to": ">=", "less than or equal to": "<="},
    **{"greater than": ">", "less than": "<"},
    **{"integer": "whole number", "string": "text", "boolean": "true or false"},
    **{"array": "list", "an object": "a mapping of keys"},
}
"""Words in pydantic's messages -> those of ours."""


def _problem(detail: ErrorDetails, model: type[BaseModel]) -> ConfigProblem:
    kind, keys = detail["type"], tuple(map(str, detail["loc"]))
    # Drop the tags of unions, such as <name>, and the tag of names: they are not keys. Keep an
    # unknown key unchanged.
    unknown = keys[-1:] if kind == "extra_forbidden" else ()
    known = keys[: len(keys) - len(unknown)]
    path = tuple(key for key in known if not key.startswith("<") and key != "[key]") + unknown
    if unknown:
        reason = f"unknown key; {_nearest_key(model, path)}"
    elif kind in _REASONS:
        reason = _REASONS[kind].format_map(detail.get("ctx", {}))
    else:
        reason = detail["msg"]
        for old, new in _WORDS.items():
            reason = reason.replace(old, new)
        reason = f"{reason} {unit_at(model, path)}".strip()
    value = "" if kind in _WITHOUT_VALUE else in_words(detail["input"])
    return ConfigProblem(path, value, reason)
