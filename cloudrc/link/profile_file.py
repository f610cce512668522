# SPDX-License-Identifier: Apache-2.0

"""Read a link profile: a shipped one by its name, a file by its path, or a mapping with its keys.

The classes in `link/profile.py` say which keys there are, and which values each may have.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.document import Document, KeyPath, plain_document, read_document
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.text import unknown_name_text
from cloudrc.link.profile import DIRECTIONS, DirectionKeys, DirectionProfile, ProfileKeys

FOLDER = Path(__file__).with_name("profiles")
FILE_KEYS = ("trace", "table", "rate_trace")
"""Keys of a direction whose values are paths of files."""
_WORDS = {str: "text", bool: "true or false"}


def read_keys(profile: str | Path | Mapping[str, Any]) -> ProfileKeys:
    """Read the keys of a profile; paths in it become absolute.

    Raises:
        BadInputError: If there is no such profile, or if a value is wrong; the text says where.
    """
    document = _document(profile)
    for path in [(way, key) for way in DIRECTIONS for key in FILE_KEYS]:
        if isinstance(file := document.get(*path), str):
            source = document.source(path)
            document.set_value(path, str(source.absolute(file)), source)
    try:
        keys: ProfileKeys = _section(ProfileKeys, document.tree, ())
    except _WrongValueError as error:
        path, text = error.args
        where = ": ".join(filter(None, (document.source(path).label, ".".join(path))))
        raise BadInputError(f"{where}: {text}") from None
    return keys


def with_files(direction: DirectionKeys) -> DirectionProfile:
    """Read the files that a direction names; raise a BadInputError if one cannot be used."""
    if not any(getattr(direction, key) for key in FILE_KEYS):
        return DirectionProfile(**vars(direction))
    from cloudrc.link.traces import link_profile

    return link_profile(direction)


def _document(profile: str | Path | Mapping[str, Any]) -> Document:
    if isinstance(profile, Mapping):
        return plain_document(profile, "profile")
    if not isinstance(profile, str | Path):
        raise BadInputError(
            f"a link is the name or path of a profile, or a mapping; not {type(profile).__name__}"
        )
    name = str(profile)
    if (file := FOLDER / f"{name}.yaml").parent == FOLDER and file.is_file():
        return read_document(file, file.name)
    path = Path(os.path.expanduser(name))
    if not path.is_file():
        names = sorted(shipped.stem for shipped in FOLDER.glob("*.yaml"))
        raise BadInputError(f"{unknown_name_text('profile', name, names)}; no such file: {path}")
    return read_document(path, name)


class _WrongValueError(Exception):
    """A value of a profile is wrong; the arguments are the keys that lead to it, and the reason."""


def _section(kind: Any, values: Mapping[str, Any], path: KeyPath) -> Any:
    """Convert a mapping to a class of keys."""
    hints, made = _hints_of(kind), {}
    for key, value in values.items():
        if key not in hints:
            # `delay` is nearest to `delay_ms`: a forgotten unit is more likely than a typo.
            near = [name for name in hints if name.startswith(f"{key}_")] or [*hints]
            raise _WrongValueError((*path, key), unknown_name_text("key", key, near))
        made[key] = _value(hints[key], value, (*path, key))
    for field in fields(kind):
        if field.default is MISSING and field.name not in values:
            raise _WrongValueError((*path, field.name), "is missing")
    keys = kind(**made)
    if hasattr(keys, "conflict") and (text := keys.conflict()):
        raise _WrongValueError(path, text)
    return keys


@cache  # to evaluate the annotations takes longer than all else
def _hints_of(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _value(kind: Any, value: Any, path: KeyPath) -> Any:
    """Convert the value of a key that may be of `kind`."""
    options = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    for option in options:
        if is_dataclass(option) and isinstance(value, dict):
            return _section(option, value, path)
        if get_origin(option) is tuple and isinstance(value, list):
            one = get_args(option)[0]
            return tuple(_value(one, each, (*path, str(n))) for n, each in enumerate(value))
        if hasattr(option, "__metadata__"):
            with suppress(InvalidValueError):
                return get_args(option)[1].of(value)
        elif value in get_args(option) if get_origin(option) is Literal else type(value) is option:
            return value
    shown = f"{value!r:.60}" if isinstance(value, str | int | float) else type(value).__name__
    raise _WrongValueError(path, f"{shown}: must be {' or '.join(map(_words, options))}")


def _words(kind: Any) -> str:
    if get_origin(kind) is Literal:
        return f"one of {', '.join(get_args(kind))}"
    if hasattr(kind, "__metadata__"):
        return str(get_args(kind)[1])
    if get_origin(kind) is tuple:
        return "a list"
    return "null" if kind is NoneType else _WORDS.get(kind, "a mapping of keys")
