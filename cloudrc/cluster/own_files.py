# SPDX-License-Identifier: Apache-2.0

"""Bring the user's robot and scene to the pods: each becomes a ConfigMap, which the pods mount.

A ConfigMap has no folders and at most 1 MiB. A robot that does not fit needs an image of its own.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from cloudrc.cluster.client import NotFoundError, Release, run
from cloudrc.cluster.jobs import owner_of
from cloudrc.cluster.pods import find_workload
from cloudrc.config.problems import problem_at
from cloudrc.config.resolved import ResolvedExperiment, local_files
from cloudrc.config.robot import files_of
from cloudrc.config.shipped import ROBOT_FILE, is_path
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.geometry.model_files import model_files

SCENE_FILE = "scene.xml"
"""Key of the scene's MJCF file in its ConfigMap."""
SIZE_MAX = 1 << 20
"""Largest total size of the files in a ConfigMap [bytes]; a limit of Kubernetes."""
REMEDY = "or build an image with it: charts/cloudrc/README.md, 'A robot or a scene of your own'"
"""End of the messages about files that a ConfigMap cannot hold."""


def find_own_files(world: ResolvedWorld) -> dict[str, dict[str, Path]]:
    """Find the files of the robot and of the scene that are given by path.

    Returns:
        "robot" or "scene" -> key in the ConfigMap -> file. The subfolders of a robot's folder are
        left out, unless the robot needs a file in them.
    """
    found = dict[str, dict[str, Path]]()
    if world.robot.endswith(".xml"):
        text = f"a cluster takes a folder with {ROBOT_FILE}, not a model alone; write one beside it"
        named = f"{text}: model: {Path(world.robot).name}"
        raise problem_at("world.robot", f"{world.robot}: {named}")
    if is_path(world.robot):
        folder = Path(world.robot)
        found["robot"] = {path.name: path for path in folder.iterdir() if path.is_file()}
        own = files_of(world.robot, world.files.robot)
        needed = {file for path in own for file in model_files(path)}
        _check("world.robot", folder, needed, found["robot"])
        _check_size(world)
    if world.scene.endswith(".xml"):
        scene = Path(world.scene)
        needed = {*model_files(scene)} - {scene}
        found["scene"] = {SCENE_FILE: scene, **{path.name: path for path in needed}}
        _check("world.scene", scene.parent, needed, found["scene"])
    return found


def _check(key: str, folder: Path, needed: set[Path], files: Mapping[str, Path]) -> None:
    """Check that a ConfigMap can hold the files; it has those in `folder` alone, or linked."""
    here = {path.resolve() for path in files.values()}
    if elsewhere := sorted({path.resolve() for path in needed} - here):
        text = f"needs {elsewhere[0]}, but a ConfigMap has no folders"
        raise problem_at(key, f"{text}; put the file into {folder}, {REMEDY}")
    if (total := sum(path.stat().st_size for path in files.values())) > SIZE_MAX:
        text = f"has {total} bytes, but a ConfigMap takes {SIZE_MAX} (1 MiB)"
        raise problem_at(key, f"{folder}: {text}; move what is not needed, {REMEDY}")


def _check_size(world: ResolvedWorld) -> None:
    """Check that a robot has a size, because the cloud pod has no MuJoCo to measure the model."""
    robot = world.files.robot
    if robot.hull_m is None and robot.hull_points is None:
        radius = float(world.files.hull.radii[0])
        text = f"in a cluster a robot needs its size; add the line hull_m: {radius + 0.0005:.3f}"
        raise problem_at("world.robot", f"{Path(world.robot) / ROBOT_FILE}: {text}")


def check_size(paths: Iterable[str]) -> None:
    """Check that a ConfigMap can hold the files of a sweep."""
    sizes = {path: Path(path).stat().st_size for path in paths}
    if (total := sum(sizes.values())) > SIZE_MAX:
        largest = max(sizes, key=sizes.__getitem__)
        text = f"your files have {total} bytes, but a ConfigMap takes {SIZE_MAX} (1 MiB)"
        raise problem_at("--on", f"{largest}: {text}; fly without it, or install it in an image")


def check_local_files(values: Mapping[str, Any], remedy: str) -> None:
    """Check that `values` have no path of a local file; `remedy` is the end of the error's text."""
    for key, path in local_files(values).items():
        text = f"the pods do not have this file; build it into an image, {remedy}"
        raise problem_at(key, f"{path}: {text}")


def check_experiment(experiment: ResolvedExperiment) -> None:
    """Check that a cluster can get the files of an experiment, and that it has no random steps.

    Files of the user's metrics are allowed, because this machine evaluates the metrics. The file of
    the link profile is allowed, because the experiment contains its values.
    """
    find_own_files(experiment.world)
    sent: dict[str, Any] = {"report": True, "link": {"profile"}, "world": {"robot", "scene"}}
    flown = experiment.model_dump(mode="json", exclude=sent)
    check_local_files(flown, "or fly with --mode local")
    if experiment.mission.steps is not None:  # the API takes waypoints alone
        text = "a mission in a cluster has waypoints; fly steps with --mode local or --mode virtual"
        raise problem_at("mission.steps", text)


def send_own_files(release: Release, found: Mapping[str, Mapping[str, Path]]) -> dict[str, str]:
    """Write the files into ConfigMaps of the release; return "robot" or "scene" -> its name.

    `found` is the result of `find_own_files`. An earlier ConfigMap of this name is replaced.
    """
    names = {kind: f"{release.name}-own-{kind}" for kind in found}
    if names:
        _make_namespace(release)
    for kind, name in names.items():
        try:
            release.request("delete", "configmaps", name=name)
        except NotFoundError:
            pass  # it is the first
        metadata = {"name": name, "labels": release.labels(kind)}
        body = {"metadata": metadata, "binaryData": _encode(found[kind])}
        release.request("create", "configmaps", body=body)
    return names


def _encode(files: Mapping[str, Path]) -> dict[str, str]:
    return {name: base64.b64encode(path.read_bytes()).decode() for name, path in files.items()}


def _make_namespace(release: Release) -> None:
    """Create the namespace of the release if it does not exist."""
    try:
        release.request("get", "namespaces", name=release.namespace)
    except NotFoundError:
        release.request("create", "namespaces", body={"metadata": {"name": release.namespace}})


def give_to_release(release: Release, names: Mapping[str, str]) -> None:
    """Make the ConfigMaps of `send_own_files` part of an installed release, to end with it."""
    for name in names.values():
        owner = owner_of("apps/v1", *find_workload(release, "world"))
        patch = json.dumps({"metadata": {"ownerReferences": [owner]}})
        words = ["patch", "configmap", name, "--type=merge", f"--patch={patch}"]
        run("kubectl", [*release.flags, *words])
