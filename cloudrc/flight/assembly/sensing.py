# SPDX-License-Identifier: Apache-2.0

"""Build what senses on the robot, and what receives its pictures in cloud."""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from cloudrc.cloud.frame_receiver import FrameReceiver
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.wire.endpoint import Worker
from cloudrc.wire.pictures import Image, as_png, describe_codec, make_decoder, make_encoder

if TYPE_CHECKING:
    from cloudrc.physics.sim.scan import Scanner
    from cloudrc.physics.sim.target import MovingTarget
    from cloudrc.world.frame_source import FrameSource
    from cloudrc.world.robot import Robot


def build_scanner(
    experiment: ResolvedExperiment, robot: Robot, errors: np.random.Generator
) -> Scanner | None:
    """Build the robot's scanner, if it works in the experiment; `errors` draws its noise."""
    scan = experiment.robot.scan
    if not experiment.scans or scan is None:
        return None
    from cloudrc.physics.sim.scan import Scanner

    return Scanner(robot.simulator.model, robot.simulator.data, scan, errors)


def build_frame_source(
    experiment: ResolvedExperiment, robot: Robot, make_worker: Callable[[], Worker] | None
) -> FrameSource | None:
    """Build what takes pictures, if the robot's camera works in the experiment.

    `make_worker` makes what renders beside world; None: rendering takes no time.

    Raises:
        MissingPrerequisiteError: If this machine cannot render, or lacks the codec.
    """
    codec, config = experiment.camera, experiment.robot.camera
    if codec is None or config is None:
        return None
    from cloudrc.physics.sim.camera import Camera
    from cloudrc.world.frame_source import FrameSource

    camera = Camera(robot.simulator.model, robot.simulator.data, config)
    kind = config.width, config.height, config.fps
    worker = make_worker() if make_worker is not None else None
    return FrameSource(
        camera,
        lambda: (make_encoder(codec, *kind), make_decoder(codec.codec)),
        worker,
        robot.guard.counts,
    )


def build_target(experiment: ResolvedExperiment, robot: Robot) -> MovingTarget | None:
    """Build what moves the body that a robot with a camera may follow; None if none moves.

    Of several, that of the mission moves, or the first one.
    """
    follow, camera = experiment.mission.follow, experiment.robot.camera
    bodies = {each.name: each for each in experiment.scene.moving}
    if camera is None or not bodies:
        return None
    from cloudrc.physics.sim.target import MovingTarget

    moving = bodies[follow.target if follow is not None else next(iter(bodies))]
    return MovingTarget(robot.simulator.model, robot.simulator.data, moving, camera)


def build_receiver(experiment: ResolvedExperiment) -> FrameReceiver | None:
    """Build what receives the pictures of the robot's camera; None if it does not work."""
    codec, config = experiment.camera, experiment.robot.camera
    if codec is None or config is None:
        return None
    name = codec.codec

    def keep(data: bytes, image: Image) -> tuple[str, bytes]:
        return ("jpeg", data) if name == "jpeg" else ("png", as_png(image))

    fovy = radians(config.fovy_deg)
    return FrameReceiver(lambda: make_decoder(name), fovy, keep if codec.keep else None)


def describe_camera(experiment: ResolvedExperiment) -> dict[str, str] | None:
    """Return what renders and what encodes the pictures of a flight; None without a camera.

    Raises:
        MissingPrerequisiteError: If this machine cannot render, or lacks the codec.
    """
    if experiment.camera is None:
        return None
    from cloudrc.physics.sim.camera import find_renderer

    return {"renderer": find_renderer(), "codec": describe_codec(experiment.camera.codec)}
