"""A configuration file in memory: plain values, and for each where it was written."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cloudrc import files
from cloudrc.config import yaml_text
from cloudrc.config.schema import MAX_WAYPOINTS
from cloudrc.errors import BadInputError

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
    sources: dict[yaml_text.Path, Source] = field(default_factory=dict)

    def source(self, path: yaml_text.Path) -> Source:
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

    def graft(self, path: yaml_text.Path, value: Any, origin: Document | Source) -> None:
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

    def forget_sources(self, path: yaml_text.Path) -> None:
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
    tree, lines = yaml_text.parse(text, name)
    if not isinstance(tree, dict):
        raise BadInputError(f"{name}: must be a mapping of keys to values")
    folder = path.resolve().parent
    return Document(tree, {key: Source(f"{name}:{line}", folder) for key, line in lines.items()})
