"""`--set key=value`: single values put over those of a file, before anything is checked.

Shorter keys are set first, so that `mission=steps` and `mission.steps.count=3` may come in any
order. A key below a name opens it: `cloud.controller.speed_max=2` turns `pid` into
`{name: pid, speed_max: 2}`. One index above the last appends to a list.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cloudrc.config import document as yaml_text
from cloudrc.config.document import SETTING, Document, Source
from cloudrc.config.schema import Direction, Experiment
from cloudrc.errors import BadInputError

_PLUGINS = {("cloud", key) for key in ("estimator", "predictor", "controller")}
_DIRECTIONS = (("link", "uplink"), ("link", "downlink"))


@dataclass(frozen=True, slots=True)
class Override:
    """One value to set.

    Attributes:
        path: Keys down to it.
        value: As YAML reads it.
    """

    path: yaml_text.KeyPath
    value: Any

    @property
    def inside_name(self) -> bool:
        """Whether it lies inside of what a file can give by name: the mission, the profile."""
        inside_mission = self.path[0] == "mission" and len(self.path) > 1
        return inside_mission or (self.path[:2] in _DIRECTIONS and len(self.path) > 2)


def parse(texts: Iterable[str]) -> list[Override]:
    """Read `key=value` texts, values as YAML; shorter keys come first.

    Raises:
        BadInputError: If one has no key or no `=`, or its value is not YAML.
    """
    result = []
    for text in texts:
        key, equals, value = text.partition("=")
        path = tuple(part.strip() for part in key.split("."))
        if not equals or not all(path):
            raise BadInputError(
                f"{SETTING} {text}: must be key=value; for example cloud.predictor=last_sample"
            )
        result.append(Override(path, yaml_text.parse(value, f"{SETTING} {key}")[0]))
    return sorted(result, key=lambda override: len(override.path))


def apply(document: Document, overrides: Iterable[Override]) -> None:
    """Set values in a document.

    Args:
        document: Of an experiment; changed in place.
        overrides: What to set; relative paths in them are relative to the working folder.

    Raises:
        BadInputError: If an index points behind a list's end, or is none.
    """
    for override in overrides:
        _open(document, override.path)
        value = copy.deepcopy(override.value)
        document.graft(override.path, value, Source(SETTING, Path.cwd()))


def is_spelled_out(direction: Any) -> bool:
    """Say whether a direction has every key: then a resolved file wrote it, not a person."""
    return isinstance(direction, dict) and direction.keys() >= Direction.model_fields.keys()


def _open(document: Document, path: yaml_text.KeyPath) -> None:
    """Make the containers above `path`, from the schema's defaults where there are some."""
    node: Any = document.tree
    default: Any = _DEFAULTS
    for depth, key in enumerate(path):
        _check_index(node, path, depth)
        default = _child(default, key)
        if depth == len(path) - 1:
            break
        child = _child(node, key)
        child = copy.deepcopy(default) if child is None else child
        if path[: depth + 1] in _PLUGINS and isinstance(child, str):
            child = {"name": child}
        if not isinstance(child, dict | list):
            child = [] if path[depth + 1] == "0" else {}
            document.forget_sources(path[: depth + 1])
            document.sources[path[: depth + 1]] = Source(SETTING, Path.cwd())
        node = _put(node, key, child)


def _check_index(node: Any, path: yaml_text.KeyPath, depth: int) -> None:
    key = path[depth]
    if not isinstance(node, list):
        return
    if not key.isdecimal() or int(key) > len(node):
        above = ".".join(path[:depth])
        have = f"0 to {len(node) - 1}" if node else "none yet"
        raise BadInputError(
            f"{SETTING}: {above}.{key}: {above} is a list with entries {have}; "
            f"use one of these, or {len(node)} to append"
        )
    if int(key) == len(node):
        node.append(None)


def _child(node: Any, key: str) -> Any:
    if isinstance(node, dict):
        return node.get(key)
    if isinstance(node, list) and key.isdecimal() and int(key) < len(node):
        return node[int(key)]
    return None


def _put(node: Any, key: str, child: Any) -> Any:
    node[int(key) if isinstance(node, list) else key] = child
    return child


_DEFAULTS = Experiment().model_dump(mode="json")
