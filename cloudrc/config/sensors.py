# SPDX-License-Identifier: Apache-2.0

"""Check that a robot has the sensors which its experiment needs, and uses their settings."""

from __future__ import annotations

from collections.abc import Iterator

from cloudrc.base.outside.document import Document
from cloudrc.config.camera import OF_CODEC
from cloudrc.config.problems import ConfigProblem
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.robot import RobotFiles
from cloudrc.config.schema import Experiment

GIVE_SCANNER = "choose the rover, or give its robot.yaml the key scan"
GIVE_CAMERA = "choose x2, or give its robot.yaml the key camera"
"""What to do about a robot that lacks a sensor."""


def lacks_of(draft: Experiment, robot: RobotFiles) -> dict[str, str]:
    """Return sensor -> why a perception cannot take its data, and what to do; "" if it can."""
    name, camera, scan = draft.world.robot, "", ""
    if robot.camera is None:
        camera = f"takes pictures, but {name} has no camera: {GIVE_CAMERA}"
    elif draft.camera is None:
        camera = (
            "takes pictures: give the experiment a section camera, such as camera: {codec: jpeg}"
        )
    if robot.scan is None:
        scan = f"takes scans, but {name} has no scanner: {GIVE_SCANNER}"
    # With a camera, the scanner works if world.scan says so. Of a section camera without a camera,
    # the check of the whole experiment tells.
    elif draft.camera is not None and robot.camera is not None and not draft.world.scan:
        scan = "takes scans: set world.scan=true, or leave the section camera out"
    return {"camera": camera, "scan": scan}


def of_other_codec(document: Document, experiment: ResolvedExperiment) -> Iterator[ConfigProblem]:
    """List the settings of the camera that only another codec has.

    A file may hold the keys of both codecs, so that a setting chooses one.
    """
    if experiment.camera is None:
        return
    chosen = experiment.camera.codec
    for codec, keys in OF_CODEC.items():
        for key in keys if codec != chosen else ():
            path = "camera", key
            if document.get(*path) is not None and document.source(path).is_setting:
                text = f"has no effect with codec {chosen}; set camera.codec={codec}"
                yield ConfigProblem(path, str(document.get(*path)), text)


def without_sensor(experiment: ResolvedExperiment) -> Iterator[ConfigProblem]:
    """List the keys that ask a robot for a scanner or a camera which it has not."""
    name, robot = experiment.world.robot, experiment.robot
    if experiment.world.scan and robot.scan is None:
        yield ConfigProblem(("world", "scan"), "true", f"{name} has no scanner: {GIVE_SCANNER}")
    if experiment.camera is not None and robot.camera is None:
        text = f"{name} has no camera: leave camera out, {GIVE_CAMERA}"
        yield ConfigProblem(("camera",), experiment.camera.codec, text)
