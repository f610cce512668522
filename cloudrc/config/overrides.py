"""Apply `--set key=value` to a document, and complete the parameters of plug-ins.

- Shorter keys are set first. Therefore the order of `mission=steps` and `mission.steps.count=3`
  does not matter.
- If the value is a name, as in `controller: pid`, a longer key turns the name into a mapping:
  `cloud.controller.speed_max=2` gives `{name: pid, speed_max: 2}`.
- An index that is one above the last index appends to a list.

Parameters of a plug-in are checked against the signature of its `build`, which also gives their
defaults.
"""

from __future__ import annotations

import copy
import inspect
import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from cloudrc import plugins
from cloudrc.config import problems
from cloudrc.config.document import SET_LABEL, Document, KeyPath, Source, parse_value
from cloudrc.config.problems import Problem
from cloudrc.config.schema import Direction, Experiment, PlugIn
from cloudrc.errors import BadInputError

_PLUGINS = {("cloud", key) for key in ("estimator", "predictor", "controller")}
_DIRECTIONS = (("link", "uplink"), ("link", "downlink"))
_DEFAULTS = Experiment().model_dump(mode="json")
KINDS = {"estimator": "estimators", "predictor": "predictors", "controller": "controllers"}
"""Key under `cloud` -> kind of plug-in."""


@dataclass(frozen=True, slots=True)
class Override:
    """One value to set.

    Attributes:
        path: Keys down to the value.
        value: The value as parsed from YAML.
    """

    path: KeyPath
    value: Any

    @property
    def inside_name(self) -> bool:
        """Whether the key is inside the mission or the profile, which a file may give by name."""
        inside_mission = self.path[0] == "mission" and len(self.path) > 1
        return inside_mission or (self.path[:2] in _DIRECTIONS and len(self.path) > 2)


def parse_settings(texts: Iterable[str]) -> list[Override]:
    """Parse texts `key=value`, the values by `document.parse_value`; sort shorter keys first.

    Raises:
        BadInputError: If a text has no key or no `=`, if a key is set twice, or if a value is not
            YAML.
    """
    result: list[Override] = []
    for text in texts:
        key, equals, value = text.partition("=")
        path = tuple(part.strip() for part in key.split("."))
        if not equals or not all(path):
            raise BadInputError(
                f"{SET_LABEL} {text}: must be key=value; for example cloud.predictor=last_sample"
            )
        if any(override.path == path for override in result):
            raise BadInputError(f"{SET_LABEL} {key}: is set twice; keep one of them")
        result.append(Override(path, parse_value(value, f"{SET_LABEL} {key}")))
    return sorted(result, key=lambda override: len(override.path))


def apply_overrides(document: Document, overrides: Iterable[Override]) -> None:
    """Set values in a document.

    Args:
        document: An experiment; changed in place.
        overrides: The values to set; relative paths in these values start at the working folder.

    Raises:
        BadInputError: If an index is not a number or beyond the end of its list.
    """
    for override in overrides:
        _make_parents(document, override.path)
        value = copy.deepcopy(override.value)
        document.set_value(override.path, value, Source(SET_LABEL, Path.cwd()))


def is_spelled_out(direction: Any) -> bool:
    """Whether a direction has every key, as in a resolved file; old files have no `loop`."""
    wanted = Direction.model_fields.keys() - {"loop"}
    return isinstance(direction, dict) and direction.keys() >= wanted


def _make_parents(document: Document, path: KeyPath) -> None:
    """Create missing containers above `path`, with the schema's defaults if it has any."""
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
            document.sources[path[: depth + 1]] = Source(SET_LABEL, Path.cwd())
        node = _put(node, key, child)


def _check_index(node: Any, path: KeyPath, depth: int) -> None:
    key = path[depth]
    if not isinstance(node, list):
        return
    if not key.isdecimal() or int(key) > len(node):
        parent = ".".join(path[:depth])
        entries = f"entries 0 to {len(node) - 1}" if node else "no entries"
        raise BadInputError(
            f"{SET_LABEL}: {parent}.{key}: {parent} is a list with {entries}; "
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


def resolve_plugins(document: Document) -> list[Problem]:
    """Replace each plug-in of an experiment by a mapping with its name and all its parameters.

    Args:
        document: An experiment; changed in place.

    Returns:
        Problems of names and parameters; the schema finds values of a wrong type.
    """
    found: list[Problem] = []
    for key, name, parameters in _choices(document):
        kind, path = KINDS[key], ("cloud", key)
        try:
            complete = _complete(kind, name, parameters)
        except ValidationError as error:
            found += problems.from_pydantic(error, parameter_model(kind, name), path)
        except BadInputError as error:
            found.append(Problem(path, "", str(error)))
        else:
            # Not by `set_value`: the given parameters keep their places in the file.
            document.tree["cloud"][key] = {"name": name, **complete}
    return found


def name_plugins(document: Document) -> list[Problem]:
    """Replace each plug-in by a mapping with its name and the given parameters.

    Unlike `resolve_plugins`, this imports nothing: file and plug-ins may come from somebody else.
    """
    for key, name, parameters in _choices(document):
        document.tree["cloud"][key] = {"name": name, **parameters}
    return []


def locate_metrics(document: Document) -> None:
    """Make the paths of the user's metrics absolute, and turn a single name into a list.

    No metric is imported.
    """
    names = document.get("report", "metrics")
    names = [names] if isinstance(names, str) else names
    if not isinstance(names, list):
        return  # missing, or refused by the schema later
    document.tree["report"]["metrics"] = names
    for index, name in enumerate(names):
        if isinstance(name, str) and plugins.is_path(name):
            source = document.source(("report", "metrics", str(index)))
            names[index] = str(source.absolute(name))


def build_plugin(kind: str, choice: PlugIn) -> Any:
    """Build a plug-in of a resolved experiment; convert parameters to the types in its `build`.

    Args:
        kind: One of `cloudrc.plugins.PACKAGES`.
        choice: Name and parameters from `load_experiment`.
    """
    checked = _check(kind, choice.name, choice.model_extra or {})
    return plugins.load(kind, choice.name, **_values(checked))


def parameter_model(kind: str, name: str) -> type[BaseModel]:
    """Create a model of a plug-in's parameters from the signature of its `build`."""
    fields: dict[str, Any] = {}
    for parameter in plugins.signature(kind, name).parameters.values():
        if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD):
            continue
        empty = inspect.Parameter.empty
        annotation = Any if parameter.annotation is empty else parameter.annotation
        default = Field() if parameter.default is empty else Field(parameter.default)
        fields[parameter.name] = (annotation, default)
    config = ConfigDict(
        extra="forbid", strict=True, arbitrary_types_allowed=True, allow_inf_nan=False,
        protected_namespaces=(),
    )  # fmt: skip
    model: type[BaseModel] = create_model("parameters", __config__=config, **fields)
    return model


def _choices(document: Document) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield key, name and parameters of each plug-in; make a name that is a path absolute."""
    for key in KINDS:
        path = ("cloud", key)
        choice = document.get(*path)
        given = {"name": choice} if isinstance(choice, str) else choice
        if not isinstance(given, dict) or not isinstance(given.get("name"), str):
            continue
        name = str(given["name"])
        if plugins.is_path(name):
            name = str(document.source((*path, "name")).absolute(name))
        yield key, name, {key: value for key, value in given.items() if key != "name"}


def _complete(kind: str, name: str, parameters: dict[str, Any]) -> dict[str, Any]:
    checked = _check(kind, name, parameters)
    # Built here once, so that an error of build() is listed with the file's other problems.
    plugins.load(kind, name, **_values(checked))
    return checked.model_dump(mode="json")


def _check(kind: str, name: str, parameters: dict[str, Any]) -> BaseModel:
    return parameter_model(kind, name).model_validate_json(json.dumps(parameters))


def _values(checked: BaseModel) -> dict[str, Any]:
    return {key: getattr(checked, key) for key in type(checked).model_fields}
