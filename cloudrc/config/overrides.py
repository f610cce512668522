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
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import lru_cache, reduce
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, create_model

from cloudrc import plugins
from cloudrc.config import problems, shipped
from cloudrc.config.problems import ConfigProblem, ProblemsError
from cloudrc.config.robot import RobotFacts, facts, find_robot, known_robot, parameters
from cloudrc.config.schema import Cloud, Experiment, PlanTime, PlugIn, Steps, World
from cloudrc.errors import BadInputError
from cloudrc.messages import UPRIGHT, ZERO, Odometry
from cloudrc.outside import code
from cloudrc.outside.document import Document, KeyPath, Source, child, parse_value
from cloudrc.outside.reuse import reuse

REMOTE, ROS2 = "remote", "ros2"
OUTSIDE = (REMOTE, ROS2)
"""Name of the controller that asks a program outside."""
KINDS = {"estimator": "estimators", "predictor": "predictors", "controller": "controllers"}
"""Key under `cloud` -> kind of plug-in."""
BRAKING = "braking_mps2"
"""Argument of an onboard controller's `build`: the braking in `guard` of robot.yaml [m/s^2]."""
GIVEN = {("onboard", "model"), ("onboard", BRAKING), ("predictors", "robot")}
"""Kind of plug-in and argument of its `build` that cloudrc gives, not the user."""
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


def collect_settings(given: Iterable[tuple[str, Any, Source]]) -> Settings:
    """Make settings from triples of a key, such as `link.both.delay_ms`, its value and its source.

    Raise a BadInputError if a key has an empty part or is set twice, also inside another's value.
    """
    found: Settings = {}
    for key, value, source in given:
        path = tuple(part.strip() for part in key.split("."))
        if not all(path):
            raise BadInputError(f"{source.label}: {key!r}: is no key; one is cloud.predictor")
        for each in _directions(path):
            if each in found:
                raise BadInputError(f"{source.label} {key}: is set twice; keep one of them")
            found[each] = Setting(value, source._replace(is_setting=True))
    for path in found:
        _refuse_second(path, found)
    return {path: found[path] for path in sorted(found, key=len)}


def _refuse_second(path: KeyPath, found: Settings) -> None:
    """Raise a BadInputError if the value of a setting above `path` sets the key `path`, too.

    Below a number there is no key, so one of both would be lost. Below a name are its parameters.
    """
    for depth in range(1, len(path)):
        above = found.get(path[:depth])
        if above is None:
            continue
        is_number = isinstance(above.value, int | float)
        if is_number or reduce(child, path[depth:], above.value) is not None:
            both = f"{'.'.join(path)}: is set twice, also by {'.'.join(path[:depth])}"
            raise BadInputError(f"{found[path].source.label} {both}; keep one of them")


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
    given, source = list[tuple[str, Any, Source]](), Source(label, Path.cwd())
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise BadInputError(f"{label} {text}: must be key=value; for example {example}")
        given.append((key, parse_value(value, f"{label} {key}"), source))
    return collect_settings(given)


def apply_overrides(document: Document, settings: Settings, *, build: bool = False) -> None:
    """Set values in a document; raise a BadInputError if an index is beyond the end of its list.

    An index changes one entry of a list; the others keep their values, also if these are defaults.
    Without `build`, the defaults of plug-ins' parameters are unknown: they are not imported.
    """
    for path, (value, source) in settings.items():
        default: Any = _DEFAULTS
        for depth, (key, below) in enumerate(pairwise(path), start=1):
            _check_index(document, path[:depth], source)
            default = child(default, key)
            present = document.get(*path[:depth])
            node = present
            if present is None:
                node = _beginning(document, path[:depth], default, build=build)
            if path[0] == "cloud" and path[1] in KINDS and depth == 2 and isinstance(node, str):
                node = {"name": node}  # not by `set_value`: the name keeps its source
                document.tree["cloud"][key] = node
            elif not isinstance(node, dict | list):
                document.set_value(path[:depth], [] if below == "0" else {}, source)
            elif present is None:
                document.set_value(path[:depth], node, document.source(path[:depth]))
        _check_index(document, path, source)
        document.set_value(path, copy.deepcopy(value), source)


def _beginning(document: Document, path: KeyPath, default: Any, *, build: bool) -> Any:
    """Return what to change if the document has no value at `path`, from the value's default.

    A section begins empty: its defaults would look like values that somebody has set.
    """
    if build and _is_parameter(path):
        return _default_of_parameter(document, path)
    return {} if isinstance(default, dict) else copy.deepcopy(default)


def _is_parameter(path: KeyPath) -> bool:
    """Return whether a key is the parameter of a plug-in, such as cloud.controller.gain_p."""
    if len(path) != 3:
        return False
    section, key, parameter = path
    is_of_cloud = section == "cloud" and key in KINDS and parameter != "name"
    return is_of_cloud or (section, key) == ("world", "onboard")


def _default_of_parameter(document: Document, path: KeyPath) -> Any:
    """Return the default of a plug-in's parameter if it is a list or mapping, else None."""
    section, key, parameter = path
    # Who reads the experiment meets a problem of the plug-in or of its default again.
    with suppress(BadInputError, TypeError, ValueError):
        if section == "world":
            default = _default_onboard(document, parameter)
        else:
            default = _default_in_cloud(document, key, parameter)
        if isinstance(default, tuple | list | dict):
            return json.loads(json.dumps(default))
    return None


def _default_in_cloud(document: Document, key: str, parameter: str) -> Any:
    choice = document.get("cloud", key) or _DEFAULTS["cloud"][key]
    name = choice.get("name") if isinstance(choice, dict) else choice
    if not isinstance(name, str):
        return None
    if plugins.is_path(name):
        place = ("cloud", key, "name") if isinstance(choice, dict) else ("cloud", key)
        name = str(document.source(place).absolute(name))
    return default_parameters(KINDS[key], name).get(parameter)


def _default_onboard(document: Document, parameter: str) -> Any:
    world = World(
        robot=document.get("world", "robot") or World().robot,
        tuning=document.get("world", "tuning"),
    )
    folder = document.source(("world", "robot")).folder
    robot = find_robot(shipped.model_path("robot", world.robot, folder))
    given = parameters(robot, world)
    if parameter in given:
        return given.get(parameter)
    return default_parameters("onboard", robot.onboard.name).get(parameter)


def _check_index(document: Document, path: KeyPath, source: Source) -> None:
    node, key = document.get(*path[:-1]), path[-1]
    if isinstance(node, list) and not (key.isdecimal() and int(key) <= len(node)):
        parent = ".".join(path[:-1])
        entries = f"entries 0 to {len(node) - 1}" if node else "no entries"
        raise BadInputError(
            f"{source.label}: {parent}.{key}: {parent} is a list with {entries}; "
            f"use one of these, or {len(node)} to append"
        )


def resolve_plugins(document: Document, *, build: bool) -> list[ConfigProblem]:
    """Replace each plug-in of an experiment by a mapping with its name and its parameters.

    With `build`, check the parameters, add defaults, and build each plug-in once as a test. Without
    `build`, import no plug-in: importing runs its code, which may be somebody else's.
    """
    found: list[ConfigProblem] = []
    robot = _robot_of(document) if build else None
    for key in KINDS:
        path = ("cloud", key)
        choice = document.get(*path)
        given = {"name": choice} if isinstance(choice, str) else choice
        if not isinstance(given, dict) or not isinstance(given.get("name"), str):
            continue
        name, parameters = given["name"], {k: v for k, v in given.items() if k != "name"}
        if plugins.is_path(name):
            name = str(document.source((*path, "name")).absolute(name))
        try:
            if build:
                parameters = _complete_once(document, path, name, parameters, robot)
        except ProblemsError as error:
            found += [each._replace(path=path + each.path) for each in error.problems]
        except _NoModelError as error:
            found.append(_no_model(document, path, error))
            document.tree["cloud"][key] = {"name": name, **parameters}
        except BadInputError as error:
            found.append(ConfigProblem(path, "", str(error), error))
        else:
            # Not by `set_value`: the parameters keep their sources.
            document.tree["cloud"][key] = {"name": name, **parameters}
    return found


class _NoModelError(BadInputError):
    """A predictor has no model of the robot, which `cloud.plan_s` needs."""


def _no_model(document: Document, path: KeyPath, error: _NoModelError) -> ConfigProblem:
    """Return the problem of a predictor of a setting, else of `cloud.plan_s`, which needs more."""
    if document.source(path).is_setting:
        return ConfigProblem(path, "", str(error), error)
    plan, default = ("cloud", "plan_s"), document.get(*path) == Cloud().predictor
    what = "the default predictor" if default else "the predictor"
    return ConfigProblem(plan, str(document.get(*plan)), f"{what} {error}", error)


def _robot_of(document: Document) -> RobotFacts | None:
    """Return what cloud knows of the experiment's robot; None if the experiment has no valid one.

    Such an experiment is refused later.
    """
    with suppress(BadInputError, ValidationError):
        world = World.model_validate_json(json.dumps(document.get("world") or {}))
        limit = document.get("guard", "acceleration_max_mps2")
        if not isinstance(limit, int | float):
            limit = known_robot(world.robot).guard.acceleration_max_mps2
        return facts(world, limit)
    return None


def _takes_robot(kind: str, name: str) -> bool:
    """Return whether a plug-in's `build` has the argument `robot`, which only predictors get."""
    if kind != "predictors":
        return False
    return reuse(("takes", name), lambda: "robot" in plugins.signature(kind, name).parameters)


def _complete_once(
    document: Document,
    path: KeyPath,
    name: str,
    given: dict[str, Any],
    robot: RobotFacts | None,
) -> dict[str, Any]:
    """Call `_complete`, but once only for the points of a sweep that share the plug-in.

    Leave the parameters of a plug-in that takes the robot as they are if there is none.
    """
    if robot is None and _takes_robot(KINDS[path[-1]], name):
        return given
    folders = [str(document.source((*path, parameter)).folder) for parameter in given]
    plan = document.get("cloud", "plan_s")
    key = ("plug-in", path, name, json.dumps([given, folders, plan]), repr(robot))
    return copy.deepcopy(reuse(key, lambda: _complete(document, path, name, given, robot)))


def _complete(
    document: Document,
    path: KeyPath,
    name: str,
    given: dict[str, Any],
    robot: RobotFacts | None,
) -> dict[str, Any]:
    """Check the parameters `given` to a plug-in, and add defaults; build the plug-in as a test.

    `path` is the key of the plug-in, such as ("cloud", "predictor"). Raise a BadInputError about a
    wrong parameter or a plug-in that fails.
    """
    kind = KINDS[path[-1]]
    model = _parameters_of(kind, name)
    parameters = dict(given)
    for parameter in given:
        if (kind, parameter) in GIVEN:
            raise BadInputError(f"{parameter}: is no parameter of yours, cloudrc gives it")
    for parameter, field in model.model_fields.items():
        place = (*path, parameter)
        if field.annotation == Path | None and isinstance(document.get(*place), str):
            file = document.source(place).absolute(parameters[parameter])
            parameters[parameter] = str(file)
    checked = _check(kind, name, parameters)
    with code.calling(f"{path[-1]} {name!r} has a default that YAML cannot contain"):
        values: dict[str, Any] = checked.model_dump(mode="json")
    checked = _check(kind, name, values)  # as `build_plugin` will do
    more = {"robot": robot} if _takes_robot(kind, name) else {}
    plugin = plugins.load(kind, name, **dict(checked), **more)
    if kind != "estimators":
        what = f"{path[-1]} {name!r}: its reset() failed"
        slow = plugins.slow_text(kind, name, f"reset() of {name} is still running")
        with code.calling(what, slow=slow):
            plugin.reset()
    if _plans_ahead(document):
        if kind == "predictors":
            _check_model(plugin, name)
        if kind == "controllers" and name in OUTSIDE:
            raise BadInputError(f"'{name}' cannot plan ahead; set cloud.plan_s to 0")
    return values


def _plans_ahead(document: Document) -> bool:
    """Return whether cloud sends plans; a `cloud.plan_s` that is no valid one is refused later."""
    with suppress(ValidationError):
        return TypeAdapter(PlanTime).validate_python(document.get("cloud", "plan_s")) > 0
    return False


def _parameters_of(kind: str, name: str) -> type[BaseModel]:
    return reuse(("parameters", kind, name), lambda: parameter_model(kind, name))


def _check_model(predictor: Any, name: str) -> None:
    """Raise a BadInputError if the predictor has no robot model, which `cloud.plan_s` needs."""
    what = f"predictor {name!r} cannot predict"
    with code.calling(what, slow=f"predict() of {name} is still running"):
        predictor.predict(Odometry(0, ZERO, UPRIGHT, ZERO, ZERO), 0.0)
        model = predictor.model()
    if model is None:
        raise _NoModelError(
            f"'{name}' has no model of the robot, which cloud.plan_s above 0 needs; choose "
            "model_based, command_history or kalman, or set cloud.plan_s to 0"
        )


def build_plugin(kind: str, choice: PlugIn, /, **given: Any) -> Any:
    """Build a plug-in of a resolved experiment; convert its parameters to the declared types.

    `kind` is a key of `cloudrc.plugins.PACKAGES`, such as "controllers". `given` are arguments of
    its `build` that are no parameters of the user. Raise a BadInputError that names the wrong
    parameters.
    """
    checked = _check(kind, choice.name, choice.model_extra or {})
    return plugins.load(kind, choice.name, **given, **dict(checked))


def build_predictor(choice: PlugIn, robot: RobotFacts) -> Any:
    """Build a predictor as `build_plugin` does; if its `build` takes `robot`, it gets it."""
    more = {"robot": robot} if _takes_robot("predictors", choice.name) else {}
    return build_plugin("predictors", choice, **more)


def parameter_names(kind: str, name: str) -> list[str]:
    """List the parameters of a plug-in that a user may set, in the order of its `build`."""
    return list(_parameters_of(kind, name).model_fields)


def default_parameters(kind: str, name: str) -> dict[str, Any]:
    """Return parameter -> default of a plug-in, without the parameters that need a value."""
    fields = _parameters_of(kind, name).model_fields
    return {key: field.default for key, field in fields.items() if not field.is_required()}


def parameter_model(kind: str, name: str) -> type[BaseModel]:
    """Create a pydantic model of a plug-in's parameters from the signature of its `build`."""
    return _model_of(kind, name, plugins.builder(kind, name))


@lru_cache(maxsize=64)  # a pydantic model takes a millisecond
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
    model, text = _parameters_of(kind, name), json.dumps(parameters)
    what = f"{plugins.one(kind)} {name!r}: a check of a parameter failed"
    slow = plugins.slow_text(kind, name, f"{name} still checks its parameters")
    with code.calling(what, slow=slow):
        try:
            return model.model_validate_json(text)
        except ValidationError as error:
            found = problems.from_pydantic(error, model)
    raise ProblemsError(found)
