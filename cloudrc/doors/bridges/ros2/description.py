# SPDX-License-Identifier: Apache-2.0

"""Describe the robot for nodes of ROS 2: a URDF, and how exactly cloud measures it."""

from __future__ import annotations

from collections.abc import Iterable
from math import radians
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

from cloudrc.config.disturbances import SensorsConfig
from cloudrc.physics.geometry.shapes import Pose, Surface
from cloudrc.results.record.live import BASE, WORLD, Covariance, covariance
from cloudrc.results.record.ros import CAMERA, LIDAR
from cloudrc.wire.messages import UPRIGHT, ZERO

MAP, ODOM = "map", "odom"
"""Frames of REP-105."""
HERE = ZERO, UPRIGHT
"""Pose of a frame in another one with the same origin and axes."""
Covariances = tuple[Covariance, Covariance]


class RobotFrames(NamedTuple):
    """Names of a robot's frames.

    Those on the ground have the origin and the axes of the world: nothing drifts.
    """

    prefix: str = ""  # of the robot's own frames, such as "drone1/"
    rep_105: bool = False  # whether the base moves in `odom`, which is a frame in `map`

    @property
    def base(self) -> str:
        """Frame of the robot's base."""
        return self.prefix + BASE

    @property
    def lidar(self) -> str:
        """Frame of the robot's scanner."""
        return self.prefix + LIDAR

    @property
    def camera(self) -> str:
        """Frame of the robot's camera: x to the right, y down, z ahead."""
        return self.prefix + CAMERA

    @property
    def odom(self) -> str:
        """Frame in which the base moves."""
        return self.prefix + ODOM if self.rep_105 else WORLD

    @property
    def ground(self) -> tuple[str, ...]:
        """Frames in which a goal may be."""
        return (MAP, WORLD, self.odom) if self.rep_105 else (MAP, WORLD)

    def at_rest(
        self, scanner: Pose | None, camera: Pose | None = None
    ) -> dict[str, dict[str, Pose]]:
        """Return frame -> frames that do not move in it -> their poses in it.

        `scanner` and `camera` are the poses of these in the frame of the base; None: it has none.
        """
        tree = {MAP: {self.odom: HERE}} if self.rep_105 else {WORLD: {MAP: HERE}}
        sensors = {self.lidar: scanner, self.camera: camera}
        if mounted := {frame: pose for frame, pose in sensors.items() if pose is not None}:
            tree[self.base] = mounted
        return tree


def covariances(errors: SensorsConfig) -> Covariances:
    """Return the covariances of pose and twist that follow from the noise of the sensors."""
    return (
        covariance(errors.position_noise_m, radians(errors.attitude_noise_deg)),
        covariance(errors.velocity_noise_mps, errors.rate_noise_radps),
    )


def urdf(name: str, frames: RobotFrames, parts: Iterable[Surface]) -> str:
    """Return a URDF of one link, in which a box stands for each part of the robot.

    Other nodes need no file for it, in contrast to meshes. The markers have the exact shape.
    """
    robot = Element("robot", name=name)
    link = SubElement(robot, "link", name=frames.base)
    for number, part in enumerate(parts):
        low, high = part.corners.min(axis=0), part.corners.max(axis=0)
        for kind in ("visual", "collision"):
            shown = SubElement(link, kind, name=f"{kind}{number}")
            SubElement(shown, "origin", xyz=_words((low + high) / 2.0))
            SubElement(SubElement(shown, "geometry"), "box", size=_words(high - low))
            if kind == "visual":
                material = SubElement(shown, "material", name=f"colour{number}")
                SubElement(material, "color", rgba=_words(part.rgba))
    return tostring(robot, encoding="unicode")


def _words(numbers: Iterable[float]) -> str:
    return " ".join(f"{number:.4g}" for number in numbers)
