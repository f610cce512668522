"""A configuration file in memory: plain values, and for each where it was written.

YAML in and out: text becomes plain values that know their lines, values become text.

Deviation: scalars follow YAML 1.2's core schema, not PyYAML's 1.1: `1e-3` is a number, `on`, `yes`
and `12:30` are text. Duplicate keys are refused.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from cloudrc import files
from cloudrc.config.schema import MAX_WAYPOINTS
from cloudrc.errors import BadInputError

KeyPath = tuple[str, ...]
"""Keys from the top of a document down to a value; indices are written as text."""

_SCALARS = (
    ("null", r"~|null|Null|NULL|", "~nN\0"),
    ("bool", r"true|True|TRUE|false|False|FALSE", "tTfF"),
    ("int", r"[-+]?[0-9]+", "-+0123456789"),
    (
        "float",
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        "-+.0123456789",
    ),
)
"""Tag, pattern, first characters. Source: YAML 1.2.2, section 10.3.2."""

_MAX_DEPTH = 50
_MAX_VALUES = 300_000
_MAX_EVENTS = 3 * _MAX_VALUES
"""Of a value: the ends of a list or mapping, or itself; and its key."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012


class _Dumper(yaml.SafeDumper):
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        """Write every value out: a resolved file is read by people."""
        return True


for _tag, _pattern, _first in _SCALARS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}",
            re.compile(f"(?:{_pattern})$"),
            ["" if character == "\0" else character for character in _first],
        )
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))


def parse(text: str, name: str) -> tuple[Any, dict[KeyPath, int]]:
    """Read one YAML document.

    Args:
        text: The document.
        name: What to call it in messages.

    Returns:
        Dictionaries with text keys, lists and scalars; and the line of each of them, from 1.

    Raises:
        BadInputError: If it is not YAML, has a key twice or an object that is not plain.
    """
    try:
        loader = _Loader(text)
        _check_bounds(text)
        lines: dict[KeyPath, int] = {}
        return _value(loader, loader.get_single_node(), (), lines, ()), lines
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}" if mark else name
        raise BadInputError(f"{place}: {error.problem}; mend the YAML there") from error
    except (yaml.YAMLError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise BadInputError(f"{name}: not readable as YAML: {reason}") from error


def write(value: Any) -> str:
    """Write plain values as a YAML document that `parse` reads back as they were."""
    return yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None,
        width=100,
    )  # fmt: skip


def _check_bounds(text: str) -> None:
    """Refuse what would overflow the stack of libyaml's composer, which is recursive, or memory."""
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=_Loader)):
        if count > _MAX_EVENTS:
            raise _refuse(event, f"more than {_MAX_VALUES} values")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _MAX_DEPTH:
                problem = f"nested more than {_MAX_DEPTH} deep"
                raise _refuse(event, problem)
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1


def _value(
    loader: Any, node: Any, path: KeyPath, lines: dict[KeyPath, int], above: tuple[Any, ...]
) -> Any:
    if node is None:
        return None
    lines[path] = node.start_mark.line + 1
    if len(lines) > _MAX_VALUES:  # aliases of aliases of aliases
        raise _refuse(node, f"more than {_MAX_VALUES} values")
    if node in above:
        raise _refuse(node, "a value contains itself")
    if isinstance(node, yaml.MappingNode):
        return _mapping(loader, node, path, lines, (*above, node))
    if isinstance(node, yaml.SequenceNode):
        return [
            _value(loader, item, (*path, str(index)), lines, (*above, node))
            for index, item in enumerate(node.value)
        ]
    value = loader.construct_object(node)
    if value is not None and not isinstance(value, bool | int | float | str):
        raise _refuse(node, f"{node.tag} is not a plain value")
    if isinstance(value, str) and "\0" in value:
        raise _refuse(node, "a text with the character NUL, which no path can have")
    return value


def _mapping(
    loader: Any, node: Any, path: KeyPath, lines: dict[KeyPath, int], above: tuple[Any, ...]
) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key_node, value_node in node.value:
        if not isinstance(key_node, yaml.ScalarNode):
            raise _refuse(key_node, "a key must be text")
        key = str(key_node.value)
        if key == "<<":
            raise _refuse(key_node, "merge keys are not supported; write the keys out")
        if key in result:
            raise _refuse(key_node, f"the key {key!r} stands here twice; keep one of them")
        result[key] = _value(loader, value_node, (*path, key), lines, above)
        lines[(*path, key)] = key_node.start_mark.line + 1
    return result


def _refuse(place: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=place.start_mark)


SIZE_MAX = 8 << 20
"""Longest file that is read [bytes]: as many waypoints as may be, spelled out, are a quarter."""
SETTING = "--set"
"""Label of what was set over a file."""


@dataclass(frozen=True, slots=True)
class Source:
    """Where a value was written.

    Attributes:
        label: For messages: "paper.yaml:12", "--set".
        folder: What a relative path there is relative to.
    """

    label: str
    folder: Path

    def absolute(self, path: str) -> Path:
        """Say which file is meant by a path that stands there; of no home or loop nothing comes."""
        return Path(os.path.realpath(self.folder / os.path.expanduser(path)))


@dataclass(slots=True)
class Document:
    """Values of a file that may have been put together from others.

    Attributes:
        tree: Dictionaries with text keys, lists and scalars.
        sources: Path of a value -> where it stands; what is missing stands where its parent does.
    """

    tree: dict[str, Any]
    sources: dict[KeyPath, Source] = field(default_factory=dict)

    def source(self, path: KeyPath) -> Source:
        """Say where the value at `path` was last touched, or else the nearest one above it."""
        for key, source in self.sources.items():
            if source.label == SETTING and key[: len(path)] == path:
                return source
        for length in range(len(path), -1, -1):
            if path[:length] in self.sources:
                return self.sources[path[:length]]
        return Source("default", Path())

    def get(self, *path: str) -> Any:
        """Give the value at `path`; None if it, or one above it, is not there."""
        value: Any = self.tree
        for key in path:
            if not isinstance(value, dict):
                return None
            value = value.get(key)
        return value

    def graft(self, path: KeyPath, value: Any, origin: Document | Source) -> None:
        """Put `value` at `path`; the keys above it must be there.

        Args:
            path: Where to, at least one key.
            value: A scalar or a tree.
            origin: Where the value was written: a place, or the document whose tree it is.
        """
        parent: Any = self.tree
        for key in path[:-1]:
            parent = parent[int(key)] if isinstance(parent, list) else parent[key]
        if isinstance(parent, list):
            parent[int(path[-1])] = value
        else:
            parent[path[-1]] = value
        self.forget_sources(path)
        if isinstance(origin, Source):
            self.sources[path] = origin
        else:
            self.sources |= {(*path, *key): source for key, source in origin.sources.items()}

    def forget_sources(self, path: KeyPath) -> None:
        """Forget where the value at `path` and those below it were written."""
        for key in [key for key in self.sources if key[: len(path)] == path]:
            del self.sources[key]


def read(path: Path, name: str) -> Document:
    """Read a YAML file whose top level is a mapping.

    Args:
        path: The file.
        name: What to call it in messages.

    Raises:
        BadInputError: If it cannot be read, is not such YAML, or is absurdly large.
    """
    try:
        text = files.read(path, SIZE_MAX).decode("utf-8")
    except OSError as error:
        raise BadInputError(f"{name}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BadInputError(f"{name}: is not UTF-8 text") from error
    except ValueError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise BadInputError(f"{name}: cannot be read: {reason}; name a file of YAML") from error
    # Counted in the text: to parse and check a hundred thousand points takes half a minute.
    points = text.count("position_m")
    if points > MAX_WAYPOINTS:
        raise BadInputError(
            f"{name}: waypoints: {points}: at most {MAX_WAYPOINTS}; split the mission"
        )
    tree, lines = parse(text, name)
    if not isinstance(tree, dict):
        raise BadInputError(f"{name}: must be a mapping of keys to values")
    folder = path.resolve().parent
    return Document(tree, {key: Source(f"{name}:{line}", folder) for key, line in lines.items()})
