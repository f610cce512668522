"""`--set key=value`: single values put over those of a file, before anything is checked.

Shorter keys are set first, so that `mission=steps` and `mission.steps.count=3` may come in any
order. A key below a name opens it: `cloud.controller.speed_max=2` turns `pid` into
`{name: pid, speed_max: 2}`. One index above the last appends to a list.

Parameters of plug-ins: what the file says is checked against `build` and completed from it.
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
from cloudrc.config import document as yaml_text
from cloudrc.config import problems
from cloudrc.config.document import SETTING, Document, Source
from cloudrc.config.problems import Problem
from cloudrc.config.schema import Direction, Experiment, PlugIn
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


KINDS = {"estimator": "estimators", "predictor": "predictors", "controller": "controllers"}
"""Key under `cloud` -> kind of plug-in."""


def resolve(document: Document) -> list[Problem]:
    """Turn every plug-in of an experiment into a mapping with its name and all its parameters.

    Args:
        document: Of an experiment, its `cloud.*` names or mappings; changed in place.

    Returns:
        What is wrong with names and parameters; those of a wrong form are left to the schema.
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
            # Completed in place: what was given keeps the line it was written in.
            document.tree["cloud"][key] = {"name": name, **complete}
    return found


def leave(document: Document) -> list[Problem]:
    """Turn every plug-in into a mapping as `resolve` does, but with what is given alone.

    Nothing is imported: the file may be somebody else's, and so may be what it names.
    """
    for key, name, parameters in _choices(document):
        document.tree["cloud"][key] = {"name": name, **parameters}
    return []


def locate_metrics(document: Document) -> None:
    """Make the paths of the user's metrics absolute, and one name a list; nothing is imported."""
    names = document.get("report", "metrics")
    names = [names] if isinstance(names, str) else names
    if not isinstance(names, list):
        return  # missing, or left to the schema
    document.tree["report"]["metrics"] = names
    for index, name in enumerate(names):
        if isinstance(name, str) and plugins.is_path(name):
            source = document.source(("report", "metrics", str(index)))
            names[index] = str(source.absolute(name))


def build(kind: str, choice: PlugIn) -> Any:
    """Build the plug-in that a resolved experiment names, with the types that its `build` asks for.

    Args:
        kind: One of `cloudrc.plugins.PACKAGES`.
        choice: Name and parameters, as `load_experiment` leaves them.
    """
    checked = _check(kind, choice.name, choice.model_extra or {})
    return plugins.load(kind, choice.name, **_values(checked))


def parameter_model(kind: str, name: str) -> type[BaseModel]:
    """Make a model of a plug-in's parameters from the signature of its `build`."""
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
    """Give key, name and parameters of every plug-in that is named; the name of a file absolute."""
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
    # Built once here, so that what only build() can refuse is refused with the file's other errors.
    plugins.load(kind, name, **_values(checked))
    return checked.model_dump(mode="json")


def _check(kind: str, name: str, parameters: dict[str, Any]) -> BaseModel:
    return parameter_model(kind, name).model_validate_json(json.dumps(parameters))


def _values(checked: BaseModel) -> dict[str, Any]:
    return {key: getattr(checked, key) for key in type(checked).model_fields}
