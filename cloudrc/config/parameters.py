"""Parameters of plug-ins: what the file says is checked against `build` and completed from it."""

from __future__ import annotations

import inspect
import json
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from cloudrc import plugins
from cloudrc.config import problems
from cloudrc.config.document import Document
from cloudrc.config.problems import Problem
from cloudrc.config.schema import PlugIn
from cloudrc.errors import BadInputError

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
