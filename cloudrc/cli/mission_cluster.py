"""Run the verbs of `cloudrc mission` in a cluster, where a mission is a Kubernetes Job.

The command checks a mission before it creates the Job, so that an error shows at once. Teleop's
API checks the mission again with the same code when the Job's pod runs.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from cloudrc.cli.client import Api, token_file, token_reader
from cloudrc.cli.cluster_flags import release_from_flags
from cloudrc.cli.extras import require
from cloudrc.cli.find_run import no_run_error
from cloudrc.cli.mission_local import read_mission
from cloudrc.cli.output import format_document, print_line, table
from cloudrc.errors import BadInputError, MissingPrerequisiteError

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release
    from cloudrc.cluster.jobs import JobStatus
    from cloudrc.config.problems import Problem
    from cloudrc.config.schema import Experiment
    from cloudrc.teleop.models import MissionRequest


UNKNOWN_LIMIT = 600.0
"""Time limit of a mission if neither the mission nor the release's experiment has a limit [s]."""
PROBLEMS_MAX = 20
"""Largest number of problems to print; a mission in wrong units has a problem at each waypoint."""


def parse(name: str, mission: Mapping[str, Any]) -> MissionRequest:
    """Check the fields of a mission, without the experiment.

    Args:
        name: Name of the file, for messages.
        mission: Body of the request to the API.

    Raises:
        BadInputError: If the mission is invalid; the text lists all problems.
    """
    from pydantic import ValidationError

    from cloudrc.config.problems import Problem, from_pydantic
    from cloudrc.teleop.models import MissionRequest

    try:
        request = MissionRequest.model_validate_json(json.dumps(mission))
    except ValidationError as error:
        _refuse(name, from_pydantic(error, MissionRequest))
        raise  # if no problem was listed
    if not request.waypoints:
        _refuse(name, [Problem(("waypoints",), "", "none given; give at least one")])
    return request


def check_on(release: Release, name: str, request: MissionRequest) -> float:
    """Check a mission against the experiment of a release.

    Args:
        release: The release.
        name: Name of the file, for messages.
        request: The mission.

    Returns:
        Time limit of the mission if it has one, else of the experiment [s].

    Raises:
        BadInputError: If the mission is invalid; the text lists all problems.
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
    """Read the experiment of a release; None if this user's rights or this version prevent it."""
    from pydantic import ValidationError

    from cloudrc.cluster.client import FILE, ClusterError, experiment_text
    from cloudrc.config.document import parse_yaml
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
    lines = [str(problem) for problem in problems[:PROBLEMS_MAX]]
    if len(problems) > PROBLEMS_MAX:
        lines.append(f"and {len(problems) - PROBLEMS_MAX} more")
    if lines:
        raise BadInputError("\n  ".join([f"{name} has {len(problems)} problems:", *lines]))


@contextmanager
def api(options: argparse.Namespace) -> Iterator[Api]:
    """Forward a port to a release's API while the block runs."""
    release, path = _place(options), token_file(options)
    from cloudrc.cluster.pods import api_url, operator_token

    token = operator_token(release) if path is None else ""
    with api_url(release) as url:
        yield Api(url, token_reader(path) if path else lambda: token)


def _run(options: argparse.Namespace) -> int:
    mission = read_mission(options.mission)
    if options.name:
        mission["name"] = options.name
    request = parse(options.mission, mission)
    release = _place(options)
    from cloudrc.cluster.flight import wait_ready
    from cloudrc.cluster.jobs import follow, follow_limit, run_job
    from cloudrc.cluster.pods import find_deployment

    find_deployment(release, "cloud")
    limit = check_on(release, options.mission, request)
    # After 'helm install' without --wait this takes some seconds: the link starts last.
    wait_ready(release, timeout=options.timeout, tell=print_line)
    job = run_job(release, mission, limit=limit, queue=options.queue)
    print(f"Job {job.name} in namespace '{release.namespace}'", flush=True)
    try:
        ended = follow(release, job.name, print_line, timeout=follow_limit(limit, options.queue))
    except KeyboardInterrupt:
        command = f"cloudrc mission cancel {job.name} {' '.join(release.cloudrc_flags)}"
        print(f"Job {job.name} is still running; cancel it: {command}", file=sys.stderr)
        raise
    if ended.exit_code is None:
        print_line(ended.message)
    return 1 if ended.exit_code is None else ended.exit_code


def _list(options: argparse.Namespace) -> int:
    release = _place(options)
    from cloudrc.cluster.jobs import list_jobs

    jobs = list_jobs(release)
    if options.output != "table":
        return _print([asdict(job) for job in jobs], options.output)
    if not jobs:
        print(f"no missions {release.where}; fly one: cloudrc mission run FILE")
        return 0
    print(table([("JOB", "STATE", "CREATED", "VERDICT"), *map(_row, jobs)]))
    return 0


def _status(options: argparse.Namespace) -> int:
    release = _place(options)
    from cloudrc.cluster.jobs import read_job

    job = read_job(release, options.id)
    if options.output != "table":
        return _print([asdict(job)], options.output)
    print(table([_row(job)]))
    return 0


def _cancel(options: argparse.Namespace) -> int:
    release = _place(options)
    from cloudrc.cluster.jobs import cancel

    path = token_file(options)
    print_line(cancel(release, options.id, token_reader(path)() if path else None))
    return 0


def _logs(options: argparse.Namespace) -> int:
    release = _place(options)
    from cloudrc.cluster.jobs import follow, list_jobs, logs

    job = options.id
    if job is None:
        jobs = list_jobs(release)
        if not jobs:
            raise BadInputError(f"no missions {release.where}")
        job = jobs[-1].name
    if options.follow:
        follow(release, job, print_line, timeout=86_400.0)
        return 0
    for line in logs(release, job):
        print_line(line)
    return 0


VERBS: dict[str, Callable[[argparse.Namespace], int]] = {
    "run": _run,
    "list": _list,
    "status": _status,
    "cancel": _cancel,
    "logs": _logs,
}
OF_ONE_JOB = ("status", "cancel")
"""Verbs that need the name of a Job; without a name, the API carries them out."""


def _place(options: argparse.Namespace) -> Release:
    require("a cluster", ("kube",))
    try:
        return release_from_flags(options)
    except MissingPrerequisiteError as error:
        raise no_run_error(options, error, "--run, --api") from None


def _row(job: JobStatus) -> tuple[str, ...]:
    return job.name, job.state, job.created, job.message


def _print(jobs: list[dict[str, object]], form: str) -> int:
    print(format_document({"schemaVersion": 1, "jobs": jobs}, form))
    return 0
