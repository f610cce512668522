# SPDX-License-Identifier: Apache-2.0

"""Load an experiment and resolve it: replace names by contents, and add all default values.

A resolved experiment contains its mission, both directions of the link, all parameters of the
plug-ins and all limits. If `dump` writes it to a file, `cloudrc run FILE` repeats the flight. One
error lists all problems of an experiment, each with its file and line.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

from cloudrc.base import plugins
from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.document import Document, KeyPath, parse_value, read_document
from cloudrc.base.outside.reuse import reuse, reuse_results
from cloudrc.base.outside.tables import CsvTable
from cloudrc.config import overrides, problems, shipped
from cloudrc.config.cloud import Cloud
from cloudrc.config.compute import compute_times
from cloudrc.config.faults import NOT_IN_CLUSTER
from cloudrc.config.ground import put_on_ground
from cloudrc.config.heading import without_held_yaws
from cloudrc.config.mission_check import check_mission, check_scene
from cloudrc.config.overrides import Settings
from cloudrc.config.place import PlaceFile
from cloudrc.config.problems import ConfigProblem
from cloudrc.config.profile import (
    DIRECTIONS,
    LATER_KEYS,
    DirectionConfig,
    Profile,
    check_profile,
    load_profile,
    resolve_files,
)
from cloudrc.config.resolved import (
    COMMAND_AGE_MAX_MS,
    FREEZE_AFTER_S,
    HORIZON_MAX_S,
    PLAN_MAX_S,
    Bounds,
    ResolvedExperiment,
    bounds_of,
    speed_cap,
)
from cloudrc.config.robot import DEFAULT_LIMITS, known_robot
from cloudrc.config.robot import facts as facts_of
from cloudrc.config.schema import Experiment, MissionConfig, World
from cloudrc.config.sensors import of_other_codec, without_sensor
from cloudrc.config.world import read_world
from cloudrc.link.traces import read_trace

_NO_BOUNDS = Bounds(DEFAULT_LIMITS.model_copy(update={"acceleration_max_mps2": inf}), inf)
"""Bounds of a flight that is over: it had the limits that its file gives."""
_NAMES: dict[KeyPath, Any] = {
    ("mission",): Experiment().mission,
    **{("world", key): getattr(World(), key) for key in ("robot", "scene")},
    **{("cloud", key): getattr(Cloud(), key) for key in overrides.KINDS},
}
"""Key path of a name -> value in place of null."""
_SECTIONS = ("world", "guard", "link", "cloud", "report")
"""Sections that may be null, and get values."""
_PLACE, _PROFILE = ("cloud", "place"), ("link", "profile")
"""Keys of the names of files; the kind of file is called as its key."""
_START = ("link", "start_s")
_PROFILE_KEYS = {("link",), _PROFILE, _PLACE}
"""If a setting gives one of these keys, it replaces the whole link profile."""
_OF_ALL = "fleet", "cell", "cloud.cores", "cloud.sharing", "cloud.place"
"""Beginnings of keys that are the same for all robots of a fleet."""
_Named = TypeVar("_Named", PlaceFile, Profile)
_COMPUTER = "speed", "cores", "sharing"
"""Keys of cloud that a place gives."""


@reuse_results()
def load_experiment(
    name: str | Path,
    settings: Iterable[str] | Settings = (),
    *,
    build: bool = True,
    flown: bool = False,
) -> ResolvedExperiment:
    """Load an experiment by name or path, and import and check its plug-ins.

    `settings` override values of the file; they may be texts `key=value`. Without `build`, the
    plug-ins are not imported. If the experiment is `flown` already, its files may be missing or
    changed, and its values count as they are: robot, scene and mission are not compared. Raise a
    BadInputError that lists the experiment's problems.
    """
    name = str(name)
    document, found = _combine(name, settings, build=build, flown=flown)
    lost = _resolve_paths(document)
    draft = problems.validate(document, Experiment, name, found if flown else found + lost)
    guard, facts = draft.guard, None
    if flown and guard.speed_max_mps and guard.acceleration_max_mps2:
        bounds = _NO_BOUNDS
    else:
        with problems.collect(found, ("world", "scene")):
            files = read_world(draft.world)
            bounds = bounds_of(files, has_speed=guard.speed_max_mps is not None)
        with problems.collect(found, ("world", "tuning")):
            limits = guard.acceleration_max_mps2, guard.speed_max_mps
            facts = facts_of(known_robot(draft.world.robot), draft.world, *limits)
        problems.raise_problems(document, found, name)
    if build and facts:
        found += overrides.complete_plugins(document, draft, files.robot, facts)
    else:
        overrides.name_plugins(document, draft.cloud)
    experiment = problems.validate(document, ResolvedExperiment, name, found, context=bounds)
    return experiment if flown else _judge(document, experiment, name)


def _combine(
    name: str, settings: Iterable[str] | Settings, *, build: bool, flown: bool
) -> tuple[Document, list[ConfigProblem]]:
    """Read an experiment, apply settings, and replace the names of mission and profile.

    Also return the problems of these two.
    """
    document, found = shipped.read("experiment", name, Path()), list[ConfigProblem]()
    changes = settings if isinstance(settings, dict) else overrides.parse_settings(settings)
    with problems.collect(found, ("fleet", "vary")):
        changes = _settings_of_robot(document, changes)
    inner = {path: value for path, value in changes.items() if _is_inside_name(path)}
    _default(document, ("name",), Path(name).stem)
    if changes and _has_all_values(document) and not flown:
        _remove_derived(document, name, new_profile=bool(changes.keys() & _PROFILE_KEYS))
    outer = {path: value for path, value in changes.items() if path not in inner}
    overrides.apply_overrides(document, outer, build=build)
    for key in _SECTIONS:
        _default(document, (key,), {})
    for path, name in _NAMES.items():
        _default(document, path, name)
    with problems.collect(found, ("mission",)):
        _inline_mission(document)
    _inline_link(document, found)
    _take_contact(document)
    overrides.apply_overrides(document, inner)
    _default(document, ("guard", "plan_max_s"), _plan_max(document))
    if ("mission", "setpoints") in inner and document.get("mission", "setpoints"):
        for key in {"waypoints", "steps", "carrot", "touch"} - {path[1] for path in inner}:
            document.tree["mission"].pop(key, None)
    if isinstance(names := document.get("report", "metrics"), str):  # one metric without a list
        document.tree["report"]["metrics"] = [names]
    return document, found


def robot_settings(robot: int | None) -> list[str]:
    """Return the settings of a process that works for a robot of a fleet, or for no fleet (None).

    A fleet in a cluster may grow, so the experiment's number of robots is no limit.
    """
    return [] if robot is None else [f"fleet.robots={robot + 1}", f"fleet.only={robot}"]


def _settings_of_robot(document: Document, changes: Settings) -> Settings:
    """Apply the settings of the fleet; return the others and those of its robot `fleet.only`."""
    of_fleet = {path: value for path, value in changes.items() if path[0] == "fleet"}
    overrides.apply_overrides(document, of_fleet)
    others = {path: value for path, value in changes.items() if path not in of_fleet}
    place, source = ("fleet", "vary"), document.source(("fleet", "vary"))
    if isinstance(vary := document.get(*place), str):
        vary = _read_robots(source.absolute(vary))
        document.set_value(place, vary, source)
    if not (isinstance(vary, list) and vary and all(isinstance(each, dict) for each in vary)):
        return others
    for robot in vary:
        for key, value in robot.items():
            if key.startswith(_OF_ALL):
                raise BadInputError(f"{key} is the same for all robots")
            if isinstance(value, str) and value.startswith("."):
                robot[key] = str(source.absolute(value))
    if type(only := document.get("fleet", "only")) is not int:
        return others
    document.tree["fleet"]["vary"] = []
    given = ((key, value, source) for key, value in vary[only % len(vary)].items())
    own = others | overrides.collect_settings(given)
    return dict(sorted(own.items(), key=lambda each: len(each[0])))


def _read_robots(path: Path) -> list[dict[str, Any]]:
    """Read a CSV file with a key in each column and the settings of a robot in each row."""
    table = CsvTable.read(path, f"fleet {path}", "world.robot,link.both.delay_ms")
    found = list[dict[str, Any]]()
    for row in table.rows:
        cells = dict(zip(table.head, row.cells, strict=True))
        for key, cell in cells.items():
            row.refuse_comma(key, cell)
        found.append({key: parse_value(cell, f"{row.where}: {key}") for key, cell in cells.items()})
    return found


def _judge(document: Document, experiment: ResolvedExperiment, name: str) -> ResolvedExperiment:
    """Check that the mission fits the scene and the robot, and complete it with what they give."""
    mission = put_on_ground(experiment.mission, experiment.world.files)
    found = [*_without_effect(document, experiment)]
    found += [*without_sensor(experiment)] or _check_mission(mission, experiment)
    problems.raise_problems(document, found, name)
    mission = without_held_yaws(mission, experiment.robot.heading)
    return experiment.model_copy(update={"mission": mission})


def _without_effect(document: Document, experiment: ResolvedExperiment) -> Iterator[ConfigProblem]:
    """List the settings that another key replaces or switches off: their flights would be equal."""
    yield from of_other_codec(document, experiment)
    for way in DIRECTIONS:
        if experiment.cell.rate_kbit is not None and getattr(experiment, way).rate_kbit is not None:
            path = "link", way, "rate_kbit"
            yield ConfigProblem(path, "", "the cell is the bottleneck; set this to null")
        trace = getattr(experiment, way).trace
        if trace is None:
            continue
        has_losses = read_trace(Path(trace)).losses is not None
        for key in ("delay_ms", "loss") if has_losses else ("delay_ms",):
            path = "link", way, key
            if document.get(*path) is not None and document.source(path).is_setting:
                text = f"has no effect, because link.{way}.trace replaces it; set that to null"
                yield ConfigProblem(path, str(document.get(*path)), text)


def _check_mission(mission: MissionConfig, experiment: ResolvedExperiment) -> list[ConfigProblem]:
    """List the problems of a mission in a scene, with their paths in the experiment."""
    world, sees = experiment.world, experiment.cloud.perception is not None

    def check() -> list[ConfigProblem]:
        if above := check_scene(world.files, mission.touched):
            return above
        wrong = check_mission(mission, world.files, straight=not sees)
        return [problem._replace(path=("mission", *problem.path)) for problem in wrong]

    key = "mission", mission.model_dump_json(), world.scene, world.fence_m, world.robot, sees
    return reuse(key, check)


def read_experiment(
    name: str | Path, settings: Iterable[str] = (), *, flown: bool = False
) -> ResolvedExperiment:
    """Load an experiment without importing its plug-ins, for processes other than cloud.

    The result has only those parameters of plug-ins that the file gives. `flown` is that of
    `load_experiment`.
    """
    return load_experiment(name, settings, build=False, flown=flown)


def read_attached(attachments: Mapping[str, bytes], recording: str) -> ResolvedExperiment:
    """Read the experiment that is attached to a recording with this name."""
    if (data := attachments.get("config.yaml")) is None:
        raise BadInputError(f"{recording}: its config.yaml is lost; name the folder of the run")
    with TemporaryDirectory() as folder:
        config = Path(folder) / "config.yaml"
        config.write_bytes(data)
        return read_experiment(config, flown=True)


def load_link(file: Path, experiment: Path) -> Profile:
    """Load the link that a `file` of the chart asks for; raises BadInputError.

    The file is a link profile, or has the only key `profile`: the name of a shipped profile, or
    null for the link of the file `experiment`.
    """
    document = read_document(file, file.name)
    if "profile" not in document.tree:
        return check_profile(document, file.name)
    if name := document.get("profile"):
        shipped.check_name("profile", str(name))
        return load_profile(str(name))
    flown = read_document(experiment, experiment.name)
    if flown.get("faults"):
        raise BadInputError(f"{experiment.name}: faults: {NOT_IN_CLUSTER}")
    return _link_of(flown, experiment.name)


def _link_of(document: Document, name: str) -> Profile:
    """Return the link of an experiment, whose other parts are not looked at."""
    place = document.get("cloud", "place")
    document.tree = {"link": document.get("link") or {}, "cloud": {"place": place}}
    found: list[ConfigProblem] = []
    _inline_link(document, found)
    found += _resolve_paths(document)
    link = problems.validate(document, Experiment, name, found).link
    return Profile(uplink=link.uplink, downlink=link.downlink, start_s=link.start_s)


def _is_inside_name(path: KeyPath) -> bool:
    """Return whether a key is inside the mission or a direction of the link.

    An experiment may replace these parts by the name of a mission or of a link profile.
    """
    is_direction = path[0] == "link" and len(path) > 2 and path[1] in DIRECTIONS
    return is_direction or (path[0] == "mission" and len(path) > 1)


def _default(document: Document, path: KeyPath, value: Any) -> None:
    if document.get(*path) is None and isinstance(document.get(*path[:-1]), dict):
        document.set_value(path, value, document.source(path))


def _inline_mission(document: Document) -> None:
    """Replace the name of the mission by the content of the mission's file."""
    name = document.tree["mission"]
    if isinstance(name, str):
        file = shipped.read("mission", name, document.source(("mission",)).folder)
        problems.validate(file, MissionConfig, name)
        document.tree["mission"] = file.tree
        document.sources |= {("mission", *key): source for key, source in file.sources.items()}


def _inline_link(document: Document, found: list[ConfigProblem]) -> None:
    """Replace the names of place and link profile by what they give; add problems to `found`."""
    with problems.collect(found, _PLACE):
        _take_place(document)
    with problems.collect(found, _PROFILE):
        _inline_profile(document)


def _take_contact(document: Document) -> None:
    """Let `contact: false` of the criteria mean that the mission touches nothing.

    Experiments of before the first release have it.
    """
    criteria, mission = document.get("criteria"), document.get("mission")
    if isinstance(criteria, dict) and criteria.get("contact") is False:
        del criteria["contact"]
        if isinstance(mission, dict):
            mission["touch"] = None


def _take_place(document: Document) -> None:
    """Fill in link and computer of the place where cloud runs; keys that are given win."""
    if not isinstance(document.get(*_PLACE), str):
        return
    file, place = _read_named(document, _PLACE, PlaceFile)
    source = document.source(_PLACE)
    for key in _COMPUTER:
        if key not in document.tree["cloud"]:
            document.set_value(("cloud", key), getattr(place, key), source)
    if _has_all_values(document) or document.source(_PROFILE).is_setting:
        return
    document.set_value(_PROFILE, place.profile, file.source(("profile",)))
    for way in DIRECTIONS:
        _inline_direction(document, way, file)


def _read_named(document: Document, path: KeyPath, model: type[_Named]) -> tuple[Document, _Named]:
    """Read the file that the key `path` names, and check it; make its path in the key absolute."""
    name, source = document.get(*path), document.source(path)
    file = shipped.read(path[-1], name, source.folder)
    content = problems.validate(file, model, name)
    if shipped.is_path(name):
        document.set_value(path, str(source.absolute(name)), source)
    return file, content


def _inline_profile(document: Document) -> None:
    """Fill in the values of the link that the experiment omits, from the link profile."""
    _default(document, _PROFILE, Experiment().link.profile)
    if not isinstance(document.get(*_PROFILE), str):
        return
    profile = _present(document, _PROFILE, Profile)
    if not _has_all_values(document):
        file, profile = _read_named(document, _PROFILE, Profile)
        for way in DIRECTIONS:
            _inline_direction(document, way, file)
        _default(document, _START, profile.start_s)
    for path, value in _implied(profile).items():
        _default(document, path, value)


def _inline_direction(document: Document, way: str, profile: Document) -> None:
    """Fill in the values of one direction that the experiment omits, from the file `profile`."""
    own = document.get("link", way)
    if not isinstance(own, dict | None):
        return
    own, sources = own or {}, document.sources
    document.tree["link"][way] = (profile.get(way) or {}) | own
    for key in own:
        sources.setdefault(("link", way, key), document.source(("link", way, key)))
    for key, place in profile.sources.items():
        if key[:1] == (way,) and own.keys().isdisjoint(key[1:2]):
            sources.setdefault(("link", *key), place)


def _present(document: Document, path: KeyPath, model: type[_Named]) -> _Named:
    """Return what the key `path` of a resolved experiment names.

    Return an empty one if the key is null, or if its file no longer exists.
    """
    with suppress(BadInputError):
        if name := document.get(*path):
            file = shipped.read(path[-1], str(name), Path())
            return problems.validate(file, model, str(name))
    return model()


def _implied(profile: Profile) -> dict[KeyPath, float]:
    """Return key path -> default value, for the defaults that depend on the link's profile."""
    return {
        ("guard", "command_age_max_ms"): profile.command_age_max_ms or COMMAND_AGE_MAX_MS,
        ("cloud", "horizon_max_s"): profile.horizon_max_s or HORIZON_MAX_S,
        ("cloud", "freeze_after_s"): profile.freeze_after_s or FREEZE_AFTER_S,
    }


def _has_all_values(document: Document) -> bool:
    """Whether the file sets all keys of both link directions, as a resolved experiment does."""
    given = [document.get("link", way) for way in DIRECTIONS]
    needed = DirectionConfig.model_fields.keys() - {*LATER_KEYS}
    return all(isinstance(one, dict) and one.keys() >= needed for one in given)


def _plan_max(document: Document) -> float:
    """Return the default of guard.plan_max_s [s]; 0 if cloud sends no plans."""
    plan = document.get("cloud", "plan_s")
    return PLAN_MAX_S if isinstance(plan, float | int) and plan > 0 else 0.0


def _remove_derived(document: Document, name: str, *, new_profile: bool) -> None:
    """Remove computed values from a resolved file.

    They are computed again after the user's settings have been applied. With `new_profile`, also
    remove the values that come from the file's link profile. Keep each value that differs from the
    computed value, because the user has set it.
    """
    draft = problems.validate(document, Experiment, name)
    guard = draft.guard
    derived: dict[KeyPath, Any] = {("guard", "plan_max_s"): _plan_max(document)}
    with suppress(BadInputError):  # another robot or scene may follow
        bounds = bounds_of(read_world(draft.world), has_speed=guard.speed_max_mps is not None)
        derived["guard", "acceleration_max_mps2"] = bounds.robot.acceleration_max_mps2
        age_max = guard.command_age_max_ms or COMMAND_AGE_MAX_MS
        derived["guard", "speed_max_mps"] = speed_cap(age_max, guard.plan_max_s or 0.0, bounds)
    if new_profile:
        present = _present(document, _PROFILE, Profile)
        derived |= _implied(present) | _computer(document) | {_START: present.start_s}
        for way in DIRECTIONS:
            del document.tree["link"][way]
    for (section, key), value in derived.items():
        if document.get(section, key) == value:
            document.tree[section].pop(key, None)


def _computer(document: Document) -> dict[KeyPath, Any]:
    """Return the values of the place of a resolved experiment, or the defaults without one."""
    present = _present(document, _PLACE, PlaceFile)
    return {("cloud", key): getattr(present, key) for key in _COMPUTER}


def _resolve_paths(document: Document) -> list[ConfigProblem]:
    """Make all paths in an experiment absolute, and check the files; return problems."""
    found = resolve_files(document, ("link",))
    paths: list[KeyPath] = [("mission", "setpoints"), ("world", "robot"), ("world", "scene")]
    paths += [("cloud", key) for key in ("compute_ms", "perception_ms")]
    metrics = document.get("report", "metrics")
    if isinstance(metrics, list):
        named = [n for n, name in enumerate(metrics) if plugins.is_path(str(name))]
        paths += [("report", "metrics", str(n)) for n in named]
    for path in paths:
        name, key, source = document.get(*path), path[-1], document.source(path)
        with problems.collect(found, path):
            if not isinstance(name, str):
                continue
            if path[0] == "world":
                name = shipped.model_path(key, name, source.folder)
            else:
                name = str(source.absolute(name))
            if key == "robot":
                known_robot(name)
            elif path[0] == "cloud":
                compute_times(name)
            document.set_value(path, name, source)
    return found
