"""Read and write YAML, and keep the file and line of each value.

Deviation: scalars follow YAML 1.2's core schema, not PyYAML's 1.1: `1e-3` is a number; `on`, `yes`
and `12:30` are text. Duplicate keys are refused.
"""

from __future__ import annotations

import contextlib
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
"""Keys from the top of a document down to a value; the indices of lists are text, too."""

SIZE_MAX = 8 << 20
"""Largest file that is read [bytes]: four times the size of a mission of MAX_WAYPOINTS points."""
SET_LABEL = "--set"
"""Label of a value that was set on the command line."""

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
"""Tag, pattern and possible first characters of each kind of scalar. The first character "\\0"
stands for an empty scalar.
Source: YAML 1.2.2, section 10.3.2."""

_MAX_DEPTH = 50
"""Deepest nesting of lists and mappings."""
_MAX_VALUES = 300_000
"""Largest number of values in a document."""
_MAX_EVENTS = 3 * _MAX_VALUES
"""Largest number of parser events: a value has at most two events, and its key has one."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012


class _Dumper(yaml.SafeDumper):
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        """Write no YAML aliases but every value in full, because people read resolved files."""
        return True


for _tag, _pattern, _first in _SCALARS:
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}",
            re.compile(f"(?:{_pattern})$"),
            ["" if character == "\0" else character for character in _first],
        )
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))


def parse_yaml(text: str, name: str) -> tuple[Any, dict[KeyPath, int]]:
    """Parse one YAML document.

    Args:
        text: The document.
        name: Its name in messages.

    Returns:
        The document as dictionaries with text keys, lists and scalars; and the line of each value,
        counted from 1.

    Raises:
        BadInputError: If the text is not YAML, repeats a key or has an object that is not plain.
    """
    try:
        loader = _Loader(text)
        _check_bounds(text)
        lines: dict[KeyPath, int] = {}
        return _value(loader, loader.get_single_node(), (), lines, ()), lines
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}" if mark else name
        raise BadInputError(f"{place}: {error.problem}; fix the YAML there") from error
    except (yaml.YAMLError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise BadInputError(f"{name}: not readable as YAML: {reason}") from error


def parse_value(text: str, name: str) -> Any:
    """Parse a value of the command line.

    In a scalar without quotes, ` #` starts no comment and `: ` starts no mapping.

    Args:
        text: A list or mapping in YAML's brackets, quoted text, several lines of YAML, or a scalar.
        name: Its name in messages.

    Raises:
        BadInputError: If brackets hold no YAML, or if text follows the closing bracket.
    """
    stripped = text.strip()
    if "\n" in stripped:
        return parse_yaml(text, name)[0]
    quoted = len(stripped) > 1 and stripped[0] in "'\"" and stripped[0] == stripped[-1]
    if quoted or stripped.startswith(("[", "{")):
        # A comment would swallow the outer bracket, and what follows the value adds an element.
        with contextlib.suppress(BadInputError):
            values = parse_yaml(f"[{stripped}, null]", name)[0]
            if len(values) == 2:
                return values[0]
        parse_yaml(stripped, name)  # raises if that is no YAML either
        raise BadInputError(f"{name}: {stripped}: text behind the value; delete or quote it")
    loader = _Loader("")
    tag = loader.resolve(yaml.ScalarNode, stripped, (True, False))
    if tag != "tag:yaml.org,2002:str":
        return loader.construct_object(yaml.ScalarNode(tag, stripped))
    if "\0" in text:
        raise BadInputError(f"{name}: text with the character NUL, which no path can contain")
    return text


def write_yaml(value: Any) -> str:
    """Write plain values as YAML; `parse_yaml` of the text returns equal values."""
    return yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None,
        width=100,
    )  # fmt: skip


def _check_bounds(text: str) -> None:
    """Refuse a document that would exhaust memory or, as libyaml's composer recurses, the stack."""
    depth = 0
    for count, event in enumerate(yaml.parse(text, Loader=_Loader)):
        if count > _MAX_EVENTS:
            raise _refuse(event, f"more than {_MAX_VALUES} values")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _MAX_DEPTH:
                raise _refuse(event, f"nested more than {_MAX_DEPTH} deep")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1


def _value(
    loader: Any, node: Any, path: KeyPath, lines: dict[KeyPath, int], parents: tuple[Any, ...]
) -> Any:
    if node is None:
        return None
    lines[path] = node.start_mark.line + 1
    if len(lines) > _MAX_VALUES:  # nested aliases multiply values
        raise _refuse(node, f"more than {_MAX_VALUES} values")
    if node in parents:
        raise _refuse(node, "a value contains itself")
    if isinstance(node, yaml.MappingNode):
        return _mapping(loader, node, path, lines, (*parents, node))
    if isinstance(node, yaml.SequenceNode):
        return [
            _value(loader, item, (*path, str(index)), lines, (*parents, node))
            for index, item in enumerate(node.value)
        ]
    value = loader.construct_object(node)
    if value is not None and not isinstance(value, bool | int | float | str):
        raise _refuse(node, f"{node.tag} is not a plain value")
    if isinstance(value, str) and "\0" in value:
        raise _refuse(node, "text with the character NUL, which no path can contain")
    return value


def _mapping(
    loader: Any, node: Any, path: KeyPath, lines: dict[KeyPath, int], parents: tuple[Any, ...]
) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for key_node, value_node in node.value:
        if not isinstance(key_node, yaml.ScalarNode):
            raise _refuse(key_node, "a key must be text")
        key = str(key_node.value)
        if key == "<<":
            raise _refuse(key_node, "merge keys are not supported; write the keys out")
        if key in result:
            raise _refuse(key_node, f"the key {key!r} is given twice; keep one of them")
        result[key] = _value(loader, value_node, (*path, key), lines, parents)
        lines[(*path, key)] = key_node.start_mark.line + 1
    return result


def _refuse(node: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


@dataclass(frozen=True, slots=True)
class Source:
    """The place where a value is written.

    Attributes:
        label: The place in messages: "paper.yaml:12", "--set".
        folder: Folder at which a relative path in the value starts.
    """

    label: str
    folder: Path

    def absolute(self, path: str) -> Path:
        """Resolve a path that is written at this place; no path raises an exception."""
        return Path(os.path.realpath(self.folder / os.path.expanduser(path)))


@dataclass(slots=True)
class Document:
    """Values of a configuration file, possibly combined from several files.

    Attributes:
        tree: Dictionaries with text keys, lists and scalars.
        sources: Path of a value -> its place; a value without an entry has its parent's place.
    """

    tree: dict[str, Any]
    sources: dict[KeyPath, Source] = field(default_factory=dict)

    def source(self, path: KeyPath) -> Source:
        """Find the place of a value: a `--set` at or below `path`, else the nearest place above."""
        for key, source in self.sources.items():
            if source.label == SET_LABEL and key[: len(path)] == path:
                return source
        for length in range(len(path), -1, -1):
            if path[:length] in self.sources:
                return self.sources[path[:length]]
        return Source("default", Path())

    def get(self, *path: str) -> Any:
        """Return the value at `path`; None if it or one of its parents is missing."""
        value: Any = self.tree
        for key in path:
            if not isinstance(value, dict):
                return None
            value = value.get(key)
        return value

    def set_value(self, path: KeyPath, value: Any, origin: Document | Source) -> None:
        """Set the value at `path`; its parents must exist.

        Args:
            path: At least one key.
            value: A scalar or a tree.
            origin: Place of the value, or the document whose tree it is.
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
        """Delete the places of the value at `path` and of all values below it."""
        for key in [key for key in self.sources if key[: len(path)] == path]:
            del self.sources[key]


def read_document(path: Path, name: str) -> Document:
    """Read a YAML file whose top level is a mapping.

    Args:
        path: The file.
        name: Its name in messages.

    Raises:
        BadInputError: If the file cannot be read, is too large, is not YAML, or has no mapping at
            its top level.
    """
    try:
        text = files.read(path, SIZE_MAX).decode("utf-8")
    except OSError as error:
        raise BadInputError(f"{name}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise BadInputError(f"{name}: is not UTF-8 text") from error
    except ValueError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise BadInputError(f"{name}: cannot be read: {reason}; name a YAML file") from error
    # Counted in the text, because parsing and checking 100,000 waypoints takes half a minute.
    points = text.count("position_m")
    if points > MAX_WAYPOINTS:
        raise BadInputError(
            f"{name}: waypoints: {points}: at most {MAX_WAYPOINTS}; split the mission"
        )
    tree, lines = parse_yaml(text, name)
    if not isinstance(tree, dict):
        raise BadInputError(f"{name}: must be a mapping of keys to values")
    folder = path.resolve().parent
    return Document(tree, {key: Source(f"{name}:{line}", folder) for key, line in lines.items()})
