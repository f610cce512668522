# SPDX-License-Identifier: Apache-2.0

"""Read and write YAML, and keep the file and line of each value for error messages.

Scalars follow the core schema of YAML 1.2, not YAML 1.1 as in PyYAML: `1e-3` is a number, and `on`,
`yes` and `12:30` are text. A duplicate key is an error.
"""

from __future__ import annotations

import copy
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.paths import read_file
from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import to_plain

KeyPath = tuple[str, ...]
"""The keys that lead from the top of a document to a value. The index of a list entry is text."""

SIZE_MAX = 8 << 20
"""Largest size of a configuration file [bytes]."""
_SCALARS = {
    "null": (r"~|null|Null|NULL|", [*"~nN", ""]),
    "bool": (r"true|True|TRUE|false|False|FALSE", [*"tTfF"]),
    "int": (r"[-+]?[0-9]+", [*"-+0123456789"]),
    "float": (
        r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        [*"-+.0123456789"],
    ),
}
"""Type of a scalar -> regular expression of its text, possible first characters of the text.
Source: YAML 1.2.2, section 10.3.2."""
_TAG = "tag:yaml.org,2002:"


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012
    # Other tags, such as !!binary, are refused.
    yaml_constructors = {  # noqa: RUF012
        tag: yaml.SafeLoader.yaml_constructors[tag]
        for tag in (None, f"{_TAG}str", *(f"{_TAG}{name}" for name in _SCALARS))
    }


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    yaml_implicit_resolvers: dict[str, list[Any]] = {}  # noqa: RUF012

    def ignore_aliases(self, data: Any) -> bool:
        return True


for _name, (_pattern, _first) in _SCALARS.items():
    for _class in (_Loader, _Dumper):
        _class.add_implicit_resolver(f"{_TAG}{_name}", re.compile(f"(?:{_pattern})$"), _first)
_Loader.add_constructor(f"{_TAG}int", lambda loader, node: int(node.value))


def parse_yaml(text: str, name: str) -> tuple[Any, dict[KeyPath, int]]:
    """Parse one YAML document; `name` is the document's name in error messages.

    Return the document as dictionaries with text keys, lists and scalars, and the line number of
    each value. Raise a BadInputError if the text is not YAML or repeats a key.
    """
    lines: dict[KeyPath, int] = {}
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        return None if node is None else _construct(loader, node, (), lines), lines
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = f"{name}:{mark.line + 1}" if mark else name
        raise BadInputError(f"{place}: {error.problem}; fix the YAML there") from error
    except (yaml.YAMLError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise BadInputError(f"{name}: not readable as YAML: {reason}") from error
    except RecursionError:
        raise BadInputError(f"{name}: nested too deep") from None


@lru_cache(maxsize=64)  # most of the time in which an experiment is loaded again
def _parse_once(text: str, name: str) -> tuple[Any, dict[KeyPath, int]]:
    return parse_yaml(text, name)


def parse_value(text: str, name: str) -> Any:
    """Parse a value from the command line; `name` is the value's name in error messages.

    Text without quotes and brackets is one scalar, even if it contains ` #` or `: `. A value of
    several lines is a YAML document. Raise a BadInputError if the value is not YAML.
    """
    stripped = text.strip()
    if "\n" in stripped:
        return parse_yaml(text, name)[0]
    quoted = len(stripped) > 1 and stripped[0] in "'\"" and stripped[0] == stripped[-1]
    if quoted or stripped.startswith(("[", "{")):
        return parse_yaml(stripped, name)[0]
    loader = _Loader("")
    node = yaml.ScalarNode(loader.resolve(yaml.ScalarNode, stripped, (True, False)), stripped)
    return text if node.tag.endswith(":str") else loader.construct_object(node)


def write_yaml(value: Any) -> str:
    """Format plain values as YAML; `parse_yaml` of the result returns equal values."""
    return yaml.dump(
        value, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None,
        width=100,
    )  # fmt: skip


def _construct(loader: Any, node: Any, path: KeyPath, lines: dict[KeyPath, int]) -> Any:
    """Convert a YAML node to plain values; store the line of each value in `lines`."""
    lines.setdefault(path, node.start_mark.line + 1)
    if isinstance(node, yaml.SequenceNode):
        items = enumerate(node.value)
        return [_construct(loader, item, (*path, str(n)), lines) for n, item in items]
    if isinstance(node, yaml.ScalarNode):
        return loader.construct_object(node)
    result: dict[str, Any] = {}
    for key_node, value_node in node.value:
        if not isinstance(key_node, yaml.ScalarNode):
            raise _refuse(key_node, "a key must be text")
        key = str(key_node.value)
        if key in result:
            raise _refuse(key_node, f"the key {key!r} is given twice; keep one of them")
        lines[(*path, key)] = key_node.start_mark.line + 1
        result[key] = _construct(loader, value_node, (*path, key), lines)
    return result


def _refuse(node: Any, problem: str) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)


class Source(NamedTuple):
    """Where a value comes from, for error messages and relative paths."""

    label: str  # "paper.yaml:12", "--set"
    folder: Path  # a relative path in the value starts here
    is_setting: bool = False  # True for `--set` and the like, False for a file or a default

    def absolute(self, path: str) -> Path:
        """Make `path` absolute: relative to `folder`. No file has to exist there."""
        return Path(os.path.realpath(self.folder / os.path.expanduser(path)))


@dataclass(slots=True)
class Document:
    """Values of a configuration file, possibly combined from several files.

    A value without an entry in `sources` comes from the same source as the value around it.
    """

    tree: dict[str, Any]  # dictionaries with text keys, lists and scalars
    sources: dict[KeyPath, Source] = field(default_factory=dict)

    def source(self, path: KeyPath) -> Source:
        """Find the source of the value at `path`.

        If a setting, such as `--set`, gave the value or a part of it, return the setting's source.
        """
        for key, source in self.sources.items():
            if source.is_setting and key[: len(path)] == path:
                return source
        for length in range(len(path), -1, -1):
            if found := self.sources.get(path[:length]):
                return found
        return Source("default", Path())

    def get(self, *path: str) -> Any:
        """Return the value at `path`, or None if there is no such value."""
        value: Any = self.tree
        for key in path:
            value = value.get(key) if isinstance(value, dict) else child(value, key)
        return value

    def set_value(self, path: KeyPath, value: Any, source: Source) -> None:
        """Set a value; its parents must exist. A list index equal to the length appends."""
        parent = self.get(*path[:-1])
        if isinstance(parent, list):
            parent[int(path[-1]) : int(path[-1]) + 1] = [value]
        else:
            parent[path[-1]] = value
        below = {key: place for key, place in self.sources.items() if key[: len(path)] != path}
        self.sources = below | {path: source}


def child(node: Any, key: str) -> Any:
    """Return the value at a mapping's key or a list's index; None if it does not exist."""
    if isinstance(node, dict):
        return node.get(key)
    if isinstance(node, list) and key.isdecimal() and int(key) < len(node):
        return node[int(key)]
    return None


def plain_document(given: Mapping[str, Any], name: str) -> Document:
    """Return what a program gives in place of a file; `name` is its name in error messages.

    Relative paths in it start at the working folder.
    """
    with naming(name):
        return Document(to_plain(given), {(): Source(name, Path())})


def read_document(path: Path, name: str) -> Document:
    """Read a YAML file whose top level is a mapping; `name` is its name in error messages.

    Raise a BadInputError if the file cannot be read or has another content.
    """
    data = read_file(path, name, "name a YAML file", SIZE_MAX)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{name}: is not UTF-8 text; save it as UTF-8") from error
    parsed, lines = _parse_once(text, name)
    tree = copy.deepcopy(parsed)
    if not isinstance(tree, dict):
        raise BadInputError(f"{name}: must be a mapping of keys to values")
    folder = path.resolve().parent
    return Document(tree, {key: Source(f"{name}:{line}", folder) for key, line in lines.items()})
