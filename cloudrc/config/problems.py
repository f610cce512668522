"""Describe the problems of a configuration: one line each, with place, reason and remedy.

The texts come from the schema: a key's type, range and unit, and the known key nearest to a typo.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import NoneType
from typing import Any, Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from cloudrc.config.document import Document, KeyPath
from cloudrc.errors import BadInputError

_TYPES = {
    float: "a number",
    int: "a whole number",
    str: "text",
    bool: "true or false",
    NoneType: "null",
}
_SIGNS = {Ge: ">=", Gt: ">", Le: "<=", Lt: "<"}


def leaves(model: type[BaseModel], above: KeyPath = ()) -> Iterator[tuple[KeyPath, FieldInfo]]:
    """List all keys without keys below them, and their fields; index 0 stands for any index."""
    for key, info in model.model_fields.items():
        inner = list(_models(info.annotation))
        many = ("0",) if _is_list(info.annotation) else ()
        if not inner or str in _types(info.annotation) or float in _types(info.annotation):
            yield (*above, key), info
        for section in inner:
            yield from leaves(section, (*above, key, *many))


def field_at(model: type[BaseModel], path: KeyPath) -> FieldInfo | None:
    """Find the field of the last key of `path`; None if the schema has no such field."""
    field = None
    models = [model]
    for key in path:
        if key.isdecimal():
            continue
        found = [inner.model_fields[key] for inner in models if key in inner.model_fields]
        if not found:
            return None
        field = found[0]
        models = [inner for info in found for inner in _models(info.annotation)]
    return field


def expectation(model: type[BaseModel], path: KeyPath) -> str:
    """Describe what the value at `path` must be: "must be a number >= 0 [ms]"."""
    field = field_at(model, path)
    if field is None:
        return "is not valid"
    inside_list = path[-1].isdecimal()
    if get_origin(field.annotation) is Literal:
        return f"must be one of {', '.join(map(repr, get_args(field.annotation)))}"
    words = [_TYPES[kind] for kind in dict.fromkeys(_types(field.annotation)) if kind in _TYPES]
    if words and words[0].endswith("number"):
        words[0] = " ".join([words[0], " and ".join(dict.fromkeys(_limits(field)))]).strip()
    if any(_models(field.annotation)):
        words.append("a mapping of keys")
    if _is_list(field.annotation) and not inside_list:
        words = [_describe_list(field.annotation)]
    return " ".join(["must be", " or ".join(words), _unit(field)]).strip()


def nearest_key(model: type[BaseModel], path: KeyPath) -> str:
    """Suggest a known key in place of an unknown key."""
    *above, key = path
    siblings = _keys_at(model, tuple(above))
    near = _near(key, siblings)
    if near:
        field = field_at(model, (*above, near))
        unit = _unit(field) if field else ""
        return f"did you mean {near}{' ' if unit else ''}{unit}?"
    everywhere = {leaf[-1]: ".".join(leaf) for leaf, _ in reversed(list(leaves(model)))}
    near = _near(key, list(everywhere))
    if near:
        return f"did you mean {everywhere[near]}?"
    return f"known here: {', '.join(siblings)}" if siblings else "no keys are known here"


def nearest_choice(detail: ErrorDetails) -> str:
    """List the allowed words, and suggest the allowed word nearest to a wrong word."""
    expected = detail["ctx"]["expected"]
    near = _near(str(detail["input"]), re.findall(r"'([^']*)'", expected))
    return f"must be {expected}" + (f"; did you mean {near}?" if near else "")


def _near(key: str, known: list[str]) -> str | None:
    # `delay` is nearest to `delay_ms`: a forgotten unit is more likely than a typo.
    without_unit = [name for name in known if name.startswith(f"{key}_")]
    close = difflib.get_close_matches(key, known, n=1)
    return next(iter(without_unit or close), None)


def _keys_at(model: type[BaseModel], path: KeyPath) -> list[str]:
    field = field_at(model, path)
    models = [model] if not path else list(_models(field.annotation)) if field else []
    return [key for inner in models for key in inner.model_fields]


def _types(annotation: Any) -> Iterator[Any]:
    """List the plain types and models in an annotation, also those inside aliases and unions."""
    if get_origin(annotation) is Literal:
        return
    arguments = [argument for argument in get_args(annotation) if argument is not Ellipsis]
    if hasattr(annotation, "__metadata__"):
        arguments = arguments[:1]
    if not arguments:
        yield annotation
    for argument in arguments:
        yield from _types(argument)


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    for kind in _types(annotation):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            yield kind


def _is_list(annotation: Any) -> bool:
    return any(
        get_origin(kind) in (tuple, list, Sequence) for kind in (annotation, *get_args(annotation))
    )


def _describe_list(annotation: Any) -> str:
    size = len(get_args(annotation)) if get_origin(annotation) is tuple else 0
    numbers = " numbers" if float in _types(annotation) else ""
    fixed = size and Ellipsis not in get_args(annotation)
    null = " or null" if NoneType in get_args(annotation) else ""
    return (
        f"a list of {size}{numbers}"
        if fixed
        else f"a list{' of' if numbers else ''}{numbers}{null}"
    )


def _limits(part: Any) -> Iterator[str]:
    """List the limits in a field or an annotation, as ">= 0"."""
    if isinstance(part, FieldInfo):
        yield from (text for item in part.metadata for text in _limits(item))
        yield from _limits(part.annotation)
    elif type(part) in _SIGNS:
        limit = next(
            getattr(part, name) for name in ("ge", "gt", "le", "lt") if hasattr(part, name)
        )
        yield f"{_SIGNS[type(part)]} {limit}"
    else:
        for item in (*getattr(part, "__metadata__", ()), *get_args(part)):
            yield from _limits(item)


def _unit(field: FieldInfo) -> str:
    found = re.search(r"\[[^\],]+\]$|\[[^\],]+\](?=[,;. ])", field.description or "")
    return found.group() if found else ""


_LISTED = 50
"""Largest number of problems that are listed."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem of a configuration.

    Attributes:
        path: Keys down to the value.
        value: The value in words; empty without a value.
        reason: What the value must be, and what to do.
    """

    path: KeyPath
    value: str
    reason: str

    def __str__(self) -> str:
        return ": ".join(part for part in (".".join(self.path), self.value, self.reason) if part)


def from_pydantic(
    error: ValidationError, model: type[BaseModel], prefix: KeyPath = (), limit: int | None = None
) -> list[Problem]:
    """Convert pydantic's errors to problems.

    Args:
        error: The error that `model` raised.
        model: The model, which has keys, ranges and units.
        prefix: Keys above the keys of the model.
        limit: Largest number of problems; None for all.
    """
    details = error.errors(include_url=False)[:limit]
    return [_problem(detail, model, prefix) for detail in details]


def raise_problems(document: Document, problems: Iterable[Problem], name: str) -> None:
    """Raise a BadInputError that lists all problems with their places; do nothing if none exist."""
    every = _deepest(problems)
    lines = [f"{document.source(problem.path).label}: {problem}" for problem in every[:_LISTED]]
    if len(every) == 1:
        raise BadInputError(lines[0])
    if len(every) > _LISTED:
        lines.append(f"and {len(every) - _LISTED} more")
    if every:
        raise BadInputError("\n  ".join([f"{name} has {len(every)} problems:", *lines]))


def _deepest(problems: Iterable[Problem]) -> list[Problem]:
    """Drop the problem of a value if a part of the value has a problem, too.

    For example, a plug-in is named but lacks a parameter. The missing parameter is one problem. The
    schema also reports that the value is a name and not a mapping; that problem is dropped.
    """
    every = list(problems)
    above = {problem.path[:n] for problem in every for n in range(1, len(problem.path))}
    return [problem for problem in every if problem.path not in above]


def in_words(value: Any) -> str:
    """Describe a value from a file in a short text."""
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list | tuple):
        return "a list" if len(value) > 4 else f"[{', '.join(map(in_words, value))}]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _problem(detail: ErrorDetails, model: type[BaseModel], prefix: KeyPath) -> Problem:
    kind, value = detail["type"], in_words(detail["input"])
    keys = tuple(map(str, detail["loc"]))
    # A union's members have tags such as <name>, which are not keys; an unknown key is kept as is.
    unknown = keys[-1:] if kind == "extra_forbidden" else ()
    known = keys[: len(keys) - len(unknown)]
    path = tuple(key for key in known if not key.startswith("<")) + unknown
    if kind == "extra_forbidden":
        return Problem(prefix + path, "", f"unknown key; {nearest_key(model, path)}")
    if kind == "missing":
        expected = expectation(model, path)
        return Problem(prefix + path, "", f"is missing; {expected}")
    if kind == "value_error":
        return Problem(prefix + path, "", str(detail["ctx"]["error"]))
    if kind == "too_long":
        return Problem(
            prefix + path, "", f"must have at most {detail['ctx']['max_length']} entries"
        )
    if kind == "string_too_long":
        longest = detail["ctx"]["max_length"]
        return Problem(prefix + path, value, f"must be text of at most {longest} characters")
    if kind == "unprintable":
        return Problem(prefix + path, value, detail["msg"])
    if kind == "literal_error":
        return Problem(prefix + path, value, nearest_choice(detail))
    if kind == "string_pattern_mismatch":
        return Problem(prefix + path, value, "must be text without slashes")
    if kind == "finite_number":
        return Problem(prefix + path, value, "must be finite")
    return Problem(prefix + path, value, expectation(model, path))
