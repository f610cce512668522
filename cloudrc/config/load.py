"""Load an experiment and resolve it: replace names and defaults by values.

The steps:

1. Read the file.
2. Apply `--set`.
3. Insert mission and link profile; the experiment's own values have priority.
4. Add the missing parameters of plug-ins.
5. Check everything against the schema, the scene and the disk. One error lists all problems, each
   with its line.

A resolved experiment contains its mission, both directions of the link, all parameters of the
plug-ins and all limits. Written to a file, it is an experiment file that gives the same run.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from math import sqrt
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError, ValidationInfo, field_validator

from cloudrc.config import overrides, problems, shipped
from cloudrc.config.document import Document, KeyPath, write_yaml
from cloudrc.config.mission_check import check_mission
from cloudrc.config.problems import Problem
from cloudrc.config.schema import (
    COMMAND_AGE_MS,
    Cloud,
    CommandAge,
    Direction,
    Experiment,
    Guard,
    Mission,
    PlugIn,
    Profile,
    Speed,
)
from cloudrc.errors import BadInputError
from cloudrc.geometry.scene import load_scene
from cloudrc.link.traces import read_table, read_trace

COMMAND_AGE_MAX_MS = 250.0
"""Value of guard.command_age_max_ms if neither experiment nor profile gives one [ms].
Source: docs/reference/plant.md, "Command age"."""


def speed_cap(command_age_max_ms: float) -> float:
    """Compute the largest speed from which the robot stops within 8.7 m [m/s].

    The robot flies for T = `command_age_max_ms` [ms] plus 0.2 s before it brakes at 3 m/s^2:
    v · (T + 0.2 s) + v^2 / 6 = 8.7 m.
    Source: docs/reference/plant.md, "Speed cap".
    """
    delay = command_age_max_ms * 1e-3 + 0.2
    return round(3.0 * (sqrt(delay * delay + 8.7 / 1.5) - delay), 6)


class ResolvedGuard(Guard):
    """A guard with a value for each limit."""

    command_age_max_ms: CommandAge = Field(
        COMMAND_AGE_MAX_MS, description="Age limit of a command [ms]"
    )
    speed_max_mps: Speed = Field(
        speed_cap(COMMAND_AGE_MAX_MS), description="Cap on the commanded speed [m/s]"
    )

    @field_validator("speed_max_mps")
    @classmethod
    def _check_stopping(cls, speed_max: float, info: ValidationInfo) -> float:
        age_max = info.data.get("command_age_max_ms", COMMAND_AGE_MAX_MS)
        if speed_max > speed_cap(age_max) + 1e-6:
            raise ValueError(
                f"must be at most {speed_cap(age_max):g} m/s: above it the robot does not stop in "
                f"time with commands {age_max:g} ms old; lower it, or guard.command_age_max_ms"
            )
        return speed_max


class ResolvedCloud(Cloud):
    """Plug-ins with all their parameters, defaults included."""

    estimator: PlugIn
    predictor: PlugIn
    controller: PlugIn


class ResolvedExperiment(Experiment):
    """An experiment with values in place of all names and defaults."""

    mission: Mission
    guard: ResolvedGuard
    cloud: ResolvedCloud

    @property
    def uplink(self) -> Direction:
        """All conditions from world to cloud."""
        return self.link.uplink

    @property
    def downlink(self) -> Direction:
        """All conditions from cloud to world."""
        return self.link.downlink


_Model = TypeVar("_Model", bound=BaseModel)
_DIRECTIONS = ("uplink", "downlink")
FILE_READERS: dict[str, Callable[[Path], object]] = {"trace": read_trace, "table": read_table}
"""Key of a direction whose value is a path -> function that reads the file."""


def load_experiment(name: str | Path, settings: Iterable[str] = ()) -> ResolvedExperiment:
    """Load an experiment for a flight, and import the plug-ins that it names.

    Args:
        name: Name of a shipped experiment, or path of a file.
        settings: Texts `key=value` that override the file, in any order.

    Returns:
        The complete, checked experiment; its paths are absolute.

    Raises:
        BadInputError: If the experiment has problems. The message is one line, or a summary and one
            line for each problem.
    """
    return _load_experiment(str(name), settings, overrides.resolve_plugins)


def read_experiment(name: str | Path, settings: Iterable[str] = ()) -> ResolvedExperiment:
    """Load an experiment without its plug-ins, for a process that runs no cloud.

    This differs from `load_experiment`: plug-ins are neither imported nor checked, and have only
    the parameters that the file gives. The config.yaml of a run gives all parameters.
    """
    return _load_experiment(str(name), settings, overrides.name_plugins)


def load_profile(name: str | Path, folder: Path | None = None) -> Profile:
    """Load a link profile by name or path (relative to `folder`); raises BadInputError."""
    return _load_profile(str(name), folder or Path())[1]


def check_profile(document: Document, name: str) -> Profile:
    """Check a link profile that was built in memory; raises BadInputError."""
    return _validate(document, Profile, name, _resolve_traces(document, ()))


def load_mission(name: str | Path, folder: Path | None = None) -> Mission:
    """Load a mission by name or path (relative to `folder`); raises BadInputError.

    `config.mission_check.check_mission` checks a mission against a scene.
    """
    document = shipped.read("mission", str(name), folder or Path())
    return _validate(document, Mission, str(name), [])


def dump(experiment: ResolvedExperiment) -> str:
    """Write an experiment as YAML that loads as an equal experiment without other files.

    The text does not contain traces and plug-ins outside the package, only their absolute paths.
    """
    return write_yaml(experiment.model_dump(mode="json"))


def fingerprint(experiment: ResolvedExperiment) -> str:
    """Compute the hash of an experiment; experiments with equal hashes give equal flights.

    Returns:
        SHA-256 of the text from `dump`, in hexadecimal digits.
    """
    return hashlib.sha256(dump(experiment).encode()).hexdigest()


def _load_experiment(
    name: str, settings: Iterable[str], plug_ins: Callable[[Document], list[Problem]]
) -> ResolvedExperiment:
    document = shipped.read("experiment", name, Path())
    changes = overrides.parse_settings(settings)
    _default(document, ("name",), Path(name).stem)
    outer = [change for change in changes if not change.inside_name]
    if any(change.path in (("link",), ("link", "profile")) for change in outer):
        _remove_profile_values(document)
    overrides.apply_overrides(document, outer)
    for key in ("world", "guard", "link", "cloud", "report"):
        _default(document, (key,), {})
    found = [*_inline_mission(document), *_inline_profile(document)]
    overrides.apply_overrides(document, [change for change in changes if change.inside_name])
    for key in overrides.KINDS:
        _default(document, ("cloud", key), Experiment().cloud.model_dump()[key])
    overrides.locate_metrics(document)
    found += [*plug_ins(document), *_resolve_traces(document, ("link",))]
    found += _check_files(document)
    experiment = _validate(document, ResolvedExperiment, name, found)
    scene = load_scene(experiment.world.scene)
    wrong = [
        Problem(("mission", *problem.path), problem.value, problem.reason)
        for problem in check_mission(experiment.mission, scene)
    ]
    problems.raise_problems(document, wrong, name)
    return experiment


def _load_profile(name: str, folder: Path) -> tuple[Document, Profile]:
    document = shipped.read("profile", name, folder)
    return document, check_profile(document, name)


def _validate(document: Document, model: type[_Model], name: str, found: list[Problem]) -> _Model:
    """Check a document against its model.

    Raises:
        BadInputError: If `found` contains problems or the check finds more; lists all of them.
    """
    result = None
    # Messages describe what a file may contain: in a file, a mission may be a name, too.
    file_model = Experiment if model is ResolvedExperiment else model
    try:
        # In JSON mode pydantic accepts lists for tuples and is still strict.
        result = model.model_validate_json(json.dumps(document.tree))
    except ValidationError as error:
        known = {problem.path for problem in found}
        found = found + [
            problem
            for problem in problems.from_pydantic(error, file_model)
            if problem.path not in known
        ]
    problems.raise_problems(document, found, name)
    assert result is not None
    return result


def _default(document: Document, path: KeyPath, value: Any) -> None:
    if document.get(*path) is None and isinstance(document.get(*path[:-1]), dict):
        document.set_value(path, value, document.source(path))


def _inline_mission(document: Document) -> list[Problem]:
    """Replace the mission's name by the contents of its file."""
    _default(document, ("mission",), Experiment().mission)
    name = document.tree["mission"]
    if not isinstance(name, str):
        return []
    source = document.source(("mission",))
    document.tree["mission"] = {}
    try:
        mission = shipped.read("mission", name, source.folder)
        _validate(mission, Mission, name, [])
    except BadInputError as error:
        return [Problem(("mission",), "", str(error))]
    document.set_value(("mission",), mission.tree, mission)
    return []


def _inline_profile(document: Document) -> list[Problem]:
    """Insert the profile's values where the experiment gives none for a direction."""
    _default(document, ("link", "profile"), Experiment().link.profile)
    name = document.get("link", "profile")
    given = {key: document.get("link", key) for key in _DIRECTIONS}
    if not isinstance(name, str) or all(map(overrides.is_spelled_out, given.values())):
        return []
    source = document.source(("link", "profile"))
    try:
        file, profile = _load_profile(name, source.folder)
    except BadInputError as error:
        return [Problem(("link", "profile"), "", str(error))]
    if shipped.is_path(name):
        document.set_value(("link", "profile"), str(source.absolute(name)), source)
    for key in _DIRECTIONS:
        if isinstance(given[key], dict | None):
            _fill_from(document, ("link", key), file, key)
    age_max = profile.command_age_max_ms or COMMAND_AGE_MAX_MS
    _default(document, ("guard", "command_age_max_ms"), age_max)
    _default(document, ("guard", "speed_max_mps"), speed_cap(_age_max(document)))
    return []


def _age_max(document: Document) -> float:
    """Return the guard's age limit [ms], or the default if a later check will refuse the value."""
    age_max = document.get("guard", "command_age_max_ms")
    least, largest = COMMAND_AGE_MS
    usable = type(age_max) in (int, float) and least <= age_max <= largest  # excludes true
    return age_max if usable else COMMAND_AGE_MAX_MS


def _fill_from(document: Document, path: KeyPath, file: Document, key: str) -> None:
    """Fill missing keys at `path` from `key` of another file."""
    _default(document, path, {})
    given = document.get(*path)
    for name, value in (file.get(key) or {}).items():
        if name not in given:
            given[name] = value
            document.sources |= {
                (*path, *source_path[1:]): source
                for source_path, source in file.sources.items()
                if source_path[:2] == (key, name)
            }


def _remove_profile_values(document: Document) -> None:
    """Remove the profile's values from a resolved file, before another profile replaces it."""
    link, guard = document.get("link"), document.get("guard")
    if not isinstance(link, dict):
        return
    if not all(overrides.is_spelled_out(link.get(key)) for key in _DIRECTIONS):
        return
    for key in _DIRECTIONS:
        del link[key]
    try:
        age_max = load_profile(str(link.get("profile"))).command_age_max_ms
    except BadInputError:
        age_max = None  # the profile's file no longer exists
    age_max = age_max or COMMAND_AGE_MAX_MS
    if isinstance(guard, dict):
        for key, implied in (
            ("command_age_max_ms", age_max),
            ("speed_max_mps", speed_cap(age_max)),
        ):
            if guard.get(key) == implied:
                del guard[key]


def _resolve_traces(document: Document, above: KeyPath) -> list[Problem]:
    """Make the paths of traces and tables absolute; check that the files can be read."""
    found = []
    for path in ((*above, key, name) for key in _DIRECTIONS for name in FILE_READERS):
        given = document.get(*path)
        if not isinstance(given, str):
            continue
        source = document.source(path)
        absolute = source.absolute(given)
        document.set_value(path, str(absolute), source)
        try:
            FILE_READERS[path[-1]](absolute)
        except BadInputError as error:
            found.append(Problem(path, "", str(error)))
    return found


def _check_files(document: Document) -> list[Problem]:
    """Check that robot and scene are shipped or exist; make their paths absolute."""
    found = []
    for key in ("robot", "scene"):
        name = document.get("world", key)
        if isinstance(name, str):
            try:
                source = document.source(("world", key))
                document.tree["world"][key] = shipped.model_path(key, name, source.folder)
            except BadInputError as error:
                found.append(Problem(("world", key), "", str(error)))
    return found
