# SPDX-License-Identifier: Apache-2.0

"""Apply settings, such as `--set key=value`, to a document, and complete plug-in parameters.

- A key of both directions of the link, `link.both.delay_ms`, sets the uplink and the downlink.
- Keys with fewer parts are set first: `mission=steps` before `mission.steps.count=3`, in whatever
  order the user gives them.
- A parameter turns the name of a plug-in into a mapping: if the file has `controller: pid`, then
  `cloud.controller.speed_max=2` gives `{name: pid, speed_max: 2}`.
- An index changes one entry of a list; one above the last index appends. If the file does not have
  the list, its other entries are those of the default.

Types and defaults of a plug-in's parameters come from the signature of its `build`.
"""

from __future__ import annotations

import copy
import inspect
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias
from weakref import WeakKeyDictionary

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from cloudrc.base import plugins
from cloudrc.base.errors import BadInputError
from cloudrc.base.outside import code
from cloudrc.base.outside.document import Document, KeyPath, Source, child, parse_value
from cloudrc.base.outside.reuse import reuse
from cloudrc.config import problems, shipped
from cloudrc.config.choice import PlugIn
from cloudrc.config.cloud import Cloud
from cloudrc.config.problems import ConfigProblem, ProblemsError
from cloudrc.config.robot import RobotFacts, RobotFiles, known_robot, parameters
from cloudrc.config.schema import Experiment, Steps, World
from cloudrc.config.sensors import lacks_of
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry

REMOTE, ROS2 = "remote", "ros2"
OUTSIDE = (REMOTE, ROS2)
"""Name of the controller that asks a program outside."""
KINDS = {
    **{"estimator": "estimators", "predictor": "predictors", "controller": "controllers"},
    "perception": "perceptions",
}
"""Key under `cloud` -> kind of plug-in."""
BRAKING = "braking_mps2"
"""Argument of an onboard controller's `build`: the braking in `guard` of robot.yaml [m/s^2]."""
GIVEN = {
    *(("onboard", "model"), ("onboard", BRAKING)),
    *(("predictors", "robot"), ("controllers", "robot"), ("perceptions", "robot")),
}
"""Kind of plug-in and argument of its `build` that cloudrc gives, not the user."""
_models = WeakKeyDictionary[Callable[..., Any], type[BaseModel]]()
"""`build` of a plug-in -> the model of its parameters. It keeps no module of a user alive."""
_DEFAULTS = {
    **Experiment().model_dump(mode="json"),
    "mission": {"steps": Steps().model_dump(mode="json")},
}


class Setting(NamedTuple):
    """A value that overrides the value of a configuration file."""

    value: Any
    source: Source


Settings: TypeAlias = dict[KeyPath, Setting]
"""Path -> setting, keys with fewer parts first."""
Given: TypeAlias = tuple[str, Any, Source]
"""A setting as it is given: its key, such as `link.both.delay_ms`, its value and its source."""


def collect_settings(given: Iterable[Given]) -> Settings:
    """Make settings; raise a BadInputError if a key has an empty part or is set twice."""
    found: Settings = {}
    for key, value, source in given:
        path = tuple(part.strip() for part in key.split("."))
        if not all(path):
            raise BadInputError(f"{source.label}: {key!r}: is no key; one is cloud.predictor")
        for each in _directions(path):
            if each in found:
                raise BadInputError(f"{source.label} {key}: is set twice; keep one of them")
            found[each] = Setting(value, source._replace(is_setting=True))
    return {path: found[path] for path in sorted(found, key=len)}


def _directions(path: KeyPath) -> list[KeyPath]:
    """Return the paths of uplink and downlink if `path` contains "both", else only `path`."""
    at = int(path[0] == "link")
    if path[at : at + 1] != ("both",):
        return [path]
    return [(*path[:at], way, *path[at + 1 :]) for way in ("uplink", "downlink")]


def parse_settings(
    texts: Iterable[str], label: str = "--set", example: str = "link.both.delay_ms=40"
) -> Settings:
    """Parse texts `key=value`; a relative path in a value starts at the working folder.

    Raise a BadInputError for a text of another form; its message begins with `label` and
    ends with an `example` of the right form.
    """
    given, source = list[Given](), Source(label, Path.cwd())
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise BadInputError(f"{label} {text}: must be key=value; for example {example}")
        given.append((key, parse_value(value, f"{label} {key}"), source))
    return collect_settings(given)


def check_no_seed(settings: Settings) -> None:
    """Check that no setting is the seed: work with several seeds sets that of each flight."""
    if (seed := settings.get(("seed",))) is not None:
        text = "each flight has its own seed; give their number with --seeds or the key 'seeds'"
        raise BadInputError(f"{seed.source.label}: seed: {text}")


@contextmanager
def naming_settings(settings: Settings) -> Iterator[None]:
    """Let a ProblemsError of the block name the settings that caused its problems."""
    try:
        yield
    except ProblemsError as error:
        lines = [f"{_label(settings, each.path)}{each}" for each in error.problems]
        raise BadInputError("; ".join(lines)) from error


def _label(settings: Settings, path: KeyPath) -> str:
    """Return the place of the setting that caused a problem, as "FILE:LINE: "; "" if none did.

    It is the most exact one that gives the value at `path`, a part of it, or what it is a part of.
    """
    for key, each in reversed(settings.items()):
        size = min(len(key), len(path))
        if key[:size] == path[:size]:
            return f"{each.source.label}: "
    return ""


def apply_overrides(document: Document, settings: Settings, *, build: bool = False) -> None:
    """Set values in a document; raise a BadInputError if an index is beyond the end of its list.

    An index changes one entry of a list; the others keep their values, also if these are defaults.
    Without `build`, the defaults of plug-ins' parameters are unknown: they are not imported.
    """
    for path, (value, source) in settings.items():
        for depth, below in enumerate(path[1:], start=1):
            above = path[:depth]
            _check_index(document, above, source)
            present = document.get(*above)
            node = _default_at(document, above, build=build) if present is None else present
            if path[0] == "cloud" and path[1] in KINDS and depth == 2 and isinstance(node, str):
                node = {"name": node}  # not by `set_value`: the name keeps its source
                document.tree["cloud"][path[1]] = node
            elif not isinstance(node, dict | list):
                document.set_value(above, [] if below == "0" else {}, source)
            elif present is None:
                document.set_value(above, node, document.source(above))
        _check_index(document, path, source)
        document.set_value(path, copy.deepcopy(value), source)


def _default_at(document: Document, path: KeyPath, *, build: bool) -> Any:
    """Return what to change if the document has no value at `path`, from the value's default.

    A section begins empty: its defaults would look like values that somebody has set.
    """
    default: Any = reduce(child, path, _DEFAULTS)
    if build and len(path) == 3:
        # Who reads the experiment meets a problem of the plug-in or of the robot again.
        with suppress(BadInputError, ValidationError):
            default = _parameters_at(document, path[:2]).get(path[2], default)
    if isinstance(default, tuple | list):
        return json.loads(json.dumps(default))
    return {} if isinstance(default, dict) else default


def _parameters_at(document: Document, path: KeyPath) -> dict[str, Any]:
    """Return the parameters with their defaults of the plug-in at a key; {} if there is none."""
    kind = KINDS.get(path[1], "") if path[0] == "cloud" else ""
    name = document.get(*path, "name")
    if kind and isinstance(name, str):
        return default_parameters(kind, _absolute(document, path, name))
    if path != ("world", "onboard"):
        return {}
    given = {key: document.get("world", key) for key in ("robot", "tuning")}
    world = World(**{key: value for key, value in given.items() if value is not None})
    robot = shipped.model_path("robot", world.robot, document.source(("world", "robot")).folder)
    return onboard_values(known_robot(robot), world.model_copy(update={"robot": robot}))


def onboard_values(robot: RobotFiles, world: World) -> dict[str, Any]:
    """Return all parameters of the onboard controller with their values, including defaults."""
    return default_parameters("onboard", robot.onboard.name) | parameters(robot, world)


def _absolute(document: Document, path: KeyPath, name: str) -> str:
    """Return the name of the plug-in at a key, or the absolute path of its file."""
    if not plugins.is_path(name):
        return name
    return str(document.source((*path, "name")).absolute(name))


def _check_index(document: Document, path: KeyPath, source: Source) -> None:
    node, key = document.get(*path[:-1]), path[-1]
    if isinstance(node, list) and not (key.isdecimal() and int(key) <= len(node)):
        parent = ".".join(path[:-1])
        entries = f"entries 0 to {len(node) - 1}" if node else "no entries"
        raise BadInputError(
            f"{source.label}: {parent}.{key}: {parent} is a list with {entries}; "
            f"use one of these, or {len(node)} to append"
        )


def name_plugins(document: Document, cloud: Cloud) -> dict[KeyPath, dict[str, Any]]:
    """Replace each plug-in of an experiment by a mapping with its name and its parameters.

    No plug-in is imported: importing runs its code, which may be somebody else's. Also return the
    mappings; keys are those of `cloud`.
    """
    made: dict[KeyPath, dict[str, Any]] = {}
    for key in KINDS:
        choice, path = getattr(cloud, key), ("cloud", key)
        if choice is None:
            continue
        given = {} if isinstance(choice, str) else dict(choice.model_extra)
        name = _absolute(document, path, choice if isinstance(choice, str) else choice.name)
        # Not by `set_value`: the parameters keep their sources.
        document.tree["cloud"][key] = made[path] = {"name": name, **given}
    return made


def complete_plugins(
    document: Document, draft: Experiment, robot: RobotFiles, facts: RobotFacts
) -> list[ConfigProblem]:
    """Do as `name_plugins`, check the parameters, add defaults, and build each plug-in as a test.

    Return the problems.
    """
    found: list[ConfigProblem] = []
    lacks = lacks_of(draft, robot)
    for path, plugin in name_plugins(document, draft.cloud).items():
        name, given = plugin["name"], {key: plugin[key] for key in plugin if key != "name"}
        try:
            values = _complete(document, path, name, given, draft, facts, lacks)
            document.tree["cloud"][path[1]] |= values
        except ProblemsError as error:
            found += [each._replace(path=path + each.path) for each in error.problems]
        except BadInputError as error:
            found.append(ConfigProblem(path, "", str(error), error))
    return found


def _complete(
    document: Document,
    path: KeyPath,
    name: str,
    given: dict[str, Any],
    draft: Experiment,
    robot: RobotFacts,
    lacks: dict[str, str],
) -> dict[str, Any]:
    """Check the parameters `given` to a plug-in, and add defaults, once for the points of a sweep.

    `path` is the key of the plug-in, such as ("cloud", "predictor"). Raise a BadInputError about a
    wrong parameter or a plug-in that fails.
    """
    kind, plans = KINDS[path[1]], draft.cloud.plan_s > 0
    for parameter, field in parameter_model(kind, name).model_fields.items():
        if field.annotation == Path | None and isinstance(given.get(parameter), str):
            given[parameter] = str(document.source((*path, parameter)).absolute(given[parameter]))
    key = ("plug-in", kind, name, json.dumps(given), plans, *lacks.values(), repr(robot))
    return reuse(key, lambda: _try(kind, name, given, robot, lacks, plans=plans))


def _try(
    kind: str,
    name: str,
    given: dict[str, Any],
    robot: RobotFacts,
    lacks: dict[str, str],
    *,
    plans: bool,
) -> dict[str, Any]:
    """Build a plug-in, with `plans` for a cloud that sends plans; return all its parameters.

    `lacks` is that of `lacks_of`.
    """
    for parameter in given:
        if (kind, parameter) in GIVEN:
            raise BadInputError(f"{parameter}: is no parameter of yours, cloudrc gives it")
    checked = _check(kind, name, given)
    with code.calling(f"{plugins.one(kind)} {name!r} has a default that YAML cannot contain"):
        values: dict[str, Any] = checked.model_dump(mode="json")
    plugin = _build(kind, name, checked, {"robot": robot})
    if kind == "perceptions":
        if plugin.takes not in lacks:
            raise BadInputError(f"'{name}' takes {plugin.takes!r}; takes must be scan or camera")
        if lack := lacks[plugin.takes]:
            raise BadInputError(f"'{name}' {lack}")
    if plans and name in OUTSIDE:
        raise BadInputError(f"'{name}' cannot plan ahead; set cloud.plan_s to 0")
    if plans and kind == "predictors":
        with code.calling(f"predictor {name!r} cannot predict"):
            plugin.predict(Odometry(0, ZERO, UPRIGHT, ZERO, ZERO), 0.0)
            model = plugin.model()
        if model is None:
            raise BadInputError(
                f"'{name}' has no model of the robot, which cloud.plan_s above 0 needs; choose "
                "model_based, command_history or kalman, or set cloud.plan_s to 0"
            )
    return values


def build_plugin(kind: str, choice: PlugIn, /, **offered: Any) -> Any:
    """Build a plug-in of a resolved experiment; convert its parameters to the declared types.

    `kind` is a key of `plugins.PACKAGES`, such as "controllers". Its `build` gets those arguments
    of `offered`, which are no parameters of the user, that it has. Raise a BadInputError that names
    the wrong parameters.
    """
    return _build(kind, choice.name, _check(kind, choice.name, choice.model_extra or {}), offered)


def _build(kind: str, name: str, checked: BaseModel, offered: dict[str, Any]) -> Any:
    known = [key for key in offered if (kind, key) in GIVEN]
    takes = plugins.signature(kind, name).parameters if known else {}
    given = {key: offered[key] for key in known if key in takes}
    return plugins.load(kind, name, **given, **dict(checked))


def default_parameters(kind: str, name: str) -> dict[str, Any]:
    """Return parameter -> default of a plug-in, without the parameters that need a value."""
    fields = parameter_model(kind, name).model_fields
    return {key: field.default for key, field in fields.items() if not field.is_required()}


def parameter_model(kind: str, name: str) -> type[BaseModel]:
    """Create a pydantic model of a plug-in's parameters from the signature of its `build`."""
    return reuse(("parameters", kind, name), lambda: _known_model(kind, name))


def _known_model(kind: str, name: str) -> type[BaseModel]:
    build = plugins.builder(kind, name)
    if build not in _models:  # a pydantic model takes a millisecond
        _models[build] = _model_of(kind, name, build)
    return _models[build]


def _model_of(kind: str, name: str, build: Callable[..., Any]) -> type[BaseModel]:
    """Create the model for `build`, the function of a plug-in; a changed file has a new one."""
    empty, parameters = inspect.Parameter.empty, plugins.signature(kind, name).parameters
    fields: dict[str, Any] = {
        name: (
            Any if parameter.annotation is empty else parameter.annotation,
            Field() if parameter.default is empty else Field(parameter.default),
        )
        for name, parameter in parameters.items()
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
        and (kind, name) not in GIVEN
    }
    is_open = any(each.kind is each.VAR_KEYWORD for each in parameters.values())
    config = ConfigDict(
        extra="allow" if is_open else "forbid", strict=True, arbitrary_types_allowed=True,
        allow_inf_nan=False, protected_namespaces=(),
    )  # fmt: skip
    with code.calling(f"{plugins.one(kind)} {name!r} has a type that cannot be read"):
        model: type[BaseModel] = create_model("parameters", __config__=config, **fields)
    return model


def _check(kind: str, name: str, parameters: dict[str, Any]) -> BaseModel:
    """Convert the parameters of a plug-in to the types that its `build` declares.

    Raise a ProblemsError about wrong parameters, a BadInputError if a validator of the user fails.
    """
    model = parameter_model(kind, name)
    with code.calling(f"{plugins.one(kind)} {name!r}: a check of a parameter failed"):
        try:
            return model.model_validate_json(json.dumps(parameters))
        except ValidationError as error:
            found = problems.from_pydantic(error, model)
    raise ProblemsError(found)
