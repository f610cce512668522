"""Checks a mission before a Job is made of it: a mission's file comes in, its limit goes out.

The API checks the same by the same code, but only once the Job's pod runs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release
    from cloudrc.config.problems import Problem
    from cloudrc.config.schema import Experiment
    from cloudrc.teleop.models import MissionRequest

UNKNOWN_LIMIT = 600.0
"""Of a mission that does not say its own, on a release whose experiment may not be read [s]."""
LISTED = 20
"""Problems that are named; a mission in wrong units is wrong everywhere."""


def parse(name: str, mission: Mapping[str, Any]) -> MissionRequest:
    """Check what can be checked without knowing where it is to be flown.

    Args:
        name: Of the file, for messages.
        mission: As it is posted.

    Raises:
        BadInputError: With everything that is wrong.
    """
    from pydantic import ValidationError

    from cloudrc.config.problems import Problem, from_pydantic
    from cloudrc.teleop.models import MissionRequest

    try:
        request = MissionRequest.model_validate_json(json.dumps(mission))
    except ValidationError as error:
        _refuse(name, from_pydantic(error, MissionRequest))
        raise  # there was nothing to say
    if not request.waypoints:
        _refuse(name, [Problem(("waypoints",), "", "none given; give at least one")])
    return request


def check_on(release: Release, name: str, request: MissionRequest) -> float:
    """Check a mission against the experiment of a release.

    Args:
        release: That is to fly it.
        name: Of the file, for messages.
        request: The mission.

    Returns:
        Its limit of time, or the experiment's where it does not say its own [s].

    Raises:
        BadInputError: With everything that is wrong.
    """
    from cloudrc.config.mission_check import check_mission
    from cloudrc.config.schema import Mission
    from cloudrc.geometry.scene import load_scene

    experiment = _experiment(release)
    if experiment is None:
        return request.time_limit_s or UNKNOWN_LIMIT
    mission = Mission(start=request.start, waypoints=request.waypoints)
    _refuse(name, check_mission(mission, load_scene(experiment.world.scene)))
    return request.time_limit_s or experiment.criteria.time_limit_s


def _experiment(release: Release) -> Experiment | None:
    """Read a release's experiment; None if this user, or this version, cannot."""
    from pydantic import ValidationError

    from cloudrc.cluster.client import FILE, experiment_text
    from cloudrc.cluster.tools import ClusterError
    from cloudrc.config.document import parse as parse_yaml
    from cloudrc.config.schema import Experiment
    from cloudrc.config.shipped import check_name

    try:
        tree, _ = parse_yaml(experiment_text(release), FILE)
        experiment = Experiment.model_validate_json(json.dumps(tree or {}))
        check_name("scene", experiment.world.scene)
    except (ClusterError, BadInputError, ValidationError):
        return None
    return experiment


def _refuse(name: str, problems: Sequence[Problem]) -> None:
    if len(problems) == 1:
        raise BadInputError(f"{name}: {problems[0]}")
    lines = [str(problem) for problem in problems[:LISTED]]
    if len(problems) > LISTED:
        lines.append(f"and {len(problems) - LISTED} more")
    if lines:
        raise BadInputError("\n  ".join([f"{name} has {len(problems)} problems:", *lines]))
