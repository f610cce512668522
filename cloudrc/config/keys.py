# SPDX-License-Identifier: Apache-2.0

"""The keys of a model, as its JSON schema describes them: for errors, completion and tables."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator
from functools import lru_cache
from typing import Any, TypeAlias

from pydantic import BaseModel
from pydantic.errors import PydanticInvalidForJsonSchema

from cloudrc.base.outside.document import KeyPath

Schema: TypeAlias = dict[str, Any]


def keys_of(
    defined: Schema, section: Schema, above: KeyPath = (), apart: Container[str] = ()
) -> Iterator[tuple[KeyPath, Schema]]:
    """Yield path and schema of each key in a `section` of the schema `defined`.

    In a list of sections, the path has "[]" behind the list. Keys below those of `apart` are left
    out.
    """
    for key, part in section.get("properties", {}).items():
        if "description" in part:
            yield (*above, key), part
        for form in forms(defined, part):
            many = "[]" if "items" in form else ""
            for inner in forms(defined, form.get("items", form)):
                if key not in apart:
                    yield from keys_of(defined, inner, (*above, key + many), apart)


def plain_keys(model: type[BaseModel]) -> set[str]:
    """Return the dotted keys whose values are no sections, without those in lists."""
    defined = model.model_json_schema()
    return {
        ".".join(path)
        for path, part in keys_of(defined, defined)
        for form in forms(defined, part)
        if form.get("type") != "null" and not form.get("properties") and "[]" not in "".join(path)
    }


def forms(defined: Schema, part: Schema) -> Iterator[Schema]:
    """Yield the schemas of the forms that a value may have."""
    part = defined["$defs"][part["$ref"].rpartition("/")[2]] if "$ref" in part else part
    choices = part.get("anyOf", part.get("oneOf"))
    if choices is None:
        yield part
    for each in choices or ():
        yield from forms(defined, each)


def known_at(model: type[BaseModel], path: KeyPath) -> Schema:
    """Return key -> schema of all keys in the section at a path; {} if nothing is known of it."""
    defined = _schema(model)
    found = [defined]
    for key in path:
        parts = [_below(form, key) for form in found]
        found = [form for part in parts if part for form in forms(defined, part)]
    return {key: part for form in found for key, part in form.get("properties", {}).items()}


@lru_cache(maxsize=16)  # a file may have thousands of problems
def _schema(model: type[BaseModel]) -> Schema:
    try:
        return model.model_json_schema()
    except PydanticInvalidForJsonSchema:  # a class of a user
        return {}


def _below(form: Schema, key: str) -> Any:
    if key.isdecimal():
        return form.get("items")
    other = form.get("additionalProperties")
    return form.get("properties", {}).get(key, other if isinstance(other, dict) else None)


def unit_at(model: type[BaseModel], path: KeyPath) -> str:
    """Return the unit of a key, such as "[ms]"; "" if there is none."""
    while path and path[-1].isdecimal():
        path = path[:-1]
    return unit_in(known_at(model, path[:-1]).get(path[-1], {})) if path else ""


def unit_in(part: Schema) -> str:
    """Return the unit in the description of a key's schema; "" if there is none."""
    text = part.get("description", "")
    found = re.search(r"\[[^\],]+\]$|\[[^\],]+\](?=[,;.\s])", text)
    return found.group() if found else ""
