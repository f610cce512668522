"""Loads experiments: a name or path and `--set` texts go in, a resolved experiment comes out.

In this order: the file is read; `--set` is applied; mission and profile are looked up and put in
their places, under the values that the experiment gives itself; plug-ins are completed from their
signatures; and the whole is checked against the schema, the scene and the disk. All that is wrong
is said at once, each with the line it stands in.

An experiment with nothing left to look up: what the ends, the link and the report are made from.

Names have become what they stand for: the mission is inline, the link's directions are spelled
out, plug-ins carry all their parameters, limits have their values. Written to a file it is still
an experiment file, and flies the same run again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from math import sqrt
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError, ValidationInfo, field_validator

from cloudrc.config import document as yaml_text
from cloudrc.config import overrides, problems, shipped
from cloudrc.config import overrides as parameters
from cloudrc.config.document import Document
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
"""Default where neither the experiment nor the profile says [ms].
Source: docs/reference/plant.md, "Command age"."""


def speed_cap(command_age_max_ms: float) -> float:
    """Give the speed [m/s] at which the robot still comes to rest in time.

    It flies on for `command_age_max_ms` [ms] and 0.2 s, then brakes at 3 m/s^2:
    v (T + 0.2) + v^2 / 6 = 8.7 m.
    Source: docs/reference/plant.md, "Speed cap".
    """
    blind = command_age_max_ms * 1e-3 + 0.2
    return round(3.0 * (sqrt(blind * blind + 8.7 / 1.5) - blind), 6)


class ResolvedGuard(Guard):
    """A guard whose limits are all known."""

    command_age_max_ms: CommandAge = Field(
        COMMAND_AGE_MAX_MS, description="A command whose basis is older is not flown [ms]"
    )
    speed_max_mps: Speed = Field(
        speed_cap(COMMAND_AGE_MAX_MS), description="Cap on the commanded speed [m/s]"
    )

    @field_validator("speed_max_mps")
    @classmethod
    def _can_be_stopped(cls, speed_max: float, info: ValidationInfo) -> float:
        age_max = info.data.get("command_age_max_ms", COMMAND_AGE_MAX_MS)
        if speed_max > speed_cap(age_max) + 1e-6:
            raise ValueError(
                f"at most {speed_cap(age_max):g} m/s can be stopped from in time while commands "
                f"may be {age_max:g} ms old; lower it, or guard.command_age_max_ms"
            )
        return speed_max


class ResolvedCloud(Cloud):
    """Plug-ins with all their parameters, those of the defaults too."""

    estimator: PlugIn
    predictor: PlugIn
    controller: PlugIn


class ResolvedExperiment(Experiment):
    """An experiment with nothing left to look up."""

    mission: Mission
    guard: ResolvedGuard
    cloud: ResolvedCloud

    @property
    def uplink(self) -> Direction:
        """World to cloud, complete."""
        return self.link.uplink

    @property
    def downlink(self) -> Direction:
        """Cloud to world, complete."""
        return self.link.downlink


_Model = TypeVar("_Model", bound=BaseModel)
_DIRECTIONS = ("uplink", "downlink")
FILES: dict[str, Callable[[Path], object]] = {"trace": read_trace, "table": read_table}
"""Keys of a direction whose values are paths, and what reads them."""


def load_experiment(name: str | Path, settings: Iterable[str] = ()) -> ResolvedExperiment:
    """Load an experiment whose cloud is to be flown: the plug-ins that it names are imported.

    Args:
        name: Of a shipped experiment, or the path of a file.
        settings: `key=value` texts over it, in any order.

    Returns:
        The experiment, complete and checked; paths in it are absolute.

    Raises:
        BadInputError: One line, or a summary and one line for each thing that is wrong.
    """
    return _load_experiment(str(name), settings, parameters.resolve)


def read_experiment(name: str | Path, settings: Iterable[str] = ()) -> ResolvedExperiment:
    """Load an experiment of which nothing is run, as whoever flies no cloud does.

    As `load_experiment`, but its plug-ins are left as it names them: neither imported nor checked,
    and with those parameters alone that it gives. A run's own config.yaml gives all of them.
    """
    return _load_experiment(str(name), settings, parameters.leave)


def load_profile(name: str | Path, folder: Path | None = None) -> Profile:
    """Load a link profile by its name or path (relative to `folder`); raises BadInputError."""
    return _load_profile(str(name), folder or Path())[1]


def check_profile(document: Document, name: str) -> Profile:
    """Check a link profile that was put together in memory; raises BadInputError."""
    return _validate(document, Profile, name, _resolve_traces(document, ()))


def load_mission(name: str | Path, folder: Path | None = None) -> Mission:
    """Load a mission by its name or path (relative to `folder`); raises BadInputError.

    Whether a scene lets it be flown is for `config.mission_check.check_mission` to say.
    """
    document = shipped.read("mission", str(name), folder or Path())
    return _validate(document, Mission, str(name), [])


def dump(experiment: ResolvedExperiment) -> str:
    """Write an experiment as YAML that loads to an equal one and needs no other configuration.

    Traces and plug-ins that lie outside the package are named by their absolute paths; whoever
    keeps the text may copy a trace beside it and name it relative to it.
    """
    return yaml_text.write(experiment.model_dump(mode="json"))


def fingerprint(experiment: ResolvedExperiment) -> str:
    """Hash all that an experiment sets: two with the same one are flown alike.

    Returns:
        SHA-256 of what `dump` writes, in hexadecimal digits.
    """
    return hashlib.sha256(dump(experiment).encode()).hexdigest()


def _load_experiment(
    name: str, settings: Iterable[str], plug_ins: Callable[[Document], list[Problem]]
) -> ResolvedExperiment:
    document = shipped.read("experiment", name, Path())
    changes = overrides.parse(settings)
    _default(document, ("name",), Path(name).stem)
    before = [change for change in changes if not change.inside_name]
    if any(change.path in (("link",), ("link", "profile")) for change in before):
        _forget_profile(document)
    overrides.apply(document, before)
    for key in ("world", "guard", "link", "cloud", "report"):
        _default(document, (key,), {})
    found = [*_inline_mission(document), *_inline_profile(document)]
    overrides.apply(document, [change for change in changes if change.inside_name])
    for key in parameters.KINDS:
        _default(document, ("cloud", key), Experiment().cloud.model_dump()[key])
    parameters.locate_metrics(document)
    found += [*plug_ins(document), *_resolve_traces(document, ("link",))]
    found += _check_files(document)
    experiment = _validate(document, ResolvedExperiment, name, found)
    scene = load_scene(experiment.world.scene)
    wrong = [
        Problem(("mission", *problem.path), problem.value, problem.reason)
        for problem in check_mission(experiment.mission, scene)
    ]
    problems.refuse(document, wrong, name)
    return experiment


def _load_profile(name: str, folder: Path) -> tuple[Document, Profile]:
    document = shipped.read("profile", name, folder)
    return document, check_profile(document, name)


def _validate(document: Document, model: type[_Model], name: str, found: list[Problem]) -> _Model:
    """Check a document against its model; raise with `found` and all that is wrong with it."""
    result = None
    # What is resolved is still described as what a file may say: a mission has a name, too.
    file_model = Experiment if model is ResolvedExperiment else model
    try:
        # YAML's values are JSON's: in its JSON mode pydantic takes lists for tuples, and is strict.
        result = model.model_validate_json(json.dumps(document.tree))
    except ValidationError as error:
        known = {problem.path for problem in found}
        found = found + [
            problem
            for problem in problems.from_pydantic(error, file_model)
            if problem.path not in known
        ]
    problems.refuse(document, found, name)
    assert result is not None
    return result


def _default(document: Document, path: yaml_text.KeyPath, value: Any) -> None:
    if document.get(*path) is None and isinstance(document.get(*path[:-1]), dict):
        document.graft(path, value, document.source(path))


def _inline_mission(document: Document) -> list[Problem]:
    """Put the mission's file in the place of its name."""
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
    document.graft(("mission",), mission.tree, mission)
    return []


def _inline_profile(document: Document) -> list[Problem]:
    """Put the profile under what the experiment itself says about the two directions."""
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
        document.graft(("link", "profile"), str(source.absolute(name)), source)
    for key in _DIRECTIONS:
        if isinstance(given[key], dict | None):
            _lay_under(document, ("link", key), file, key)
    age_max = profile.command_age_max_ms or COMMAND_AGE_MAX_MS
    _default(document, ("guard", "command_age_max_ms"), age_max)
    _default(document, ("guard", "speed_max_mps"), speed_cap(_age_max(document)))
    return []


def _age_max(document: Document) -> float:
    """The age that the guard allows [ms]; what cannot be one is refused later, and alone."""
    age_max = document.get("guard", "command_age_max_ms")
    least, largest = COMMAND_AGE_MS
    usable = type(age_max) in (int, float) and least <= age_max <= largest  # true is no number
    return age_max if usable else COMMAND_AGE_MAX_MS


def _lay_under(document: Document, path: yaml_text.KeyPath, file: Document, key: str) -> None:
    """Fill what is not given at `path` from `key` of another file."""
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


def _forget_profile(document: Document) -> None:
    """Undo in a resolved file what its profile gave, before another profile takes its place."""
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
        age_max = None  # the label of a profile that is gone
    age_max = age_max or COMMAND_AGE_MAX_MS
    if isinstance(guard, dict):
        for key, implied in (
            ("command_age_max_ms", age_max),
            ("speed_max_mps", speed_cap(age_max)),
        ):
            if guard.get(key) == implied:
                del guard[key]


def _resolve_traces(document: Document, above: yaml_text.KeyPath) -> list[Problem]:
    """Make the paths of traces and tables absolute, and read them to see whether they can be."""
    found = []
    for path in ((*above, key, name) for key in _DIRECTIONS for name in FILES):
        given = document.get(*path)
        if not isinstance(given, str):
            continue
        source = document.source(path)
        absolute = source.absolute(given)
        document.graft(path, str(absolute), source)
        try:
            FILES[path[-1]](absolute)
        except BadInputError as error:
            found.append(Problem(path, "", str(error)))
    return found


def _check_files(document: Document) -> list[Problem]:
    """Check that robot and scene are files that ship."""
    found = []
    for key in ("robot", "scene"):
        name = document.get("world", key)
        if isinstance(name, str):
            try:
                shipped.check_name(key, name)
            except BadInputError as error:
                found.append(Problem(("world", key), "", str(error)))
    return found
