# SPDX-License-Identifier: Apache-2.0

"""The size of a robot: spheres that contain it, for clearance and the check of paths."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cloudrc.base import plugins
from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import RESULT
from cloudrc.config.robot import RobotFiles
from cloudrc.config.shipped import ROBOT_FILE
from cloudrc.physics.geometry.clearance import Spheres, ball

TOLERANCE = 1e-3
"""Length by which geoms may reach out of the hull [m]: hull_m is rounded."""


def hull_of(name: str, robot: RobotFiles) -> Spheres:
    """Return the spheres that contain a robot; `name` is for the text of an error.

    Raises:
        BadInputError: If its model or its file of spheres is wrong.
        MissingPrerequisiteError: If it gives no hull_m, and MuJoCo is missing.
    """
    if robot.hull_points is not None:
        return _spheres(plugins.find("hull", robot.hull_points, look=False))
    if robot.hull_m is not None:
        return ball(robot.hull_m)
    from cloudrc.physics.sim.bodies import reach_of

    with naming(f"robot {name}"):
        return ball(reach_of(robot.model))


def doubts(name: str, robot: RobotFiles) -> Iterator[str]:
    """Say that the size of a robot, called `name`, cannot be right.

    Raises:
        BadInputError: If the model does not compile.
        MissingPrerequisiteError: If MuJoCo is missing.
    """
    from cloudrc.physics.sim.bodies import reach_of

    if robot.hull_m is None or robot.hull_points is not None:
        return
    with naming(f"robot {name}"):
        reach = reach_of(robot.model)
    if robot.hull_m < reach - TOLERANCE:
        text = f"hull_m is {robot.hull_m:g}, but the geoms reach {reach:.3f} m from the base"
        yield f"{name}/{ROBOT_FILE}: {text}"


def _spheres(file: plugins.Found) -> Spheres:
    """Return the spheres of the function `few` of a file."""
    with file.calling("few") as function:
        numbers = RESULT.array(function()).astype(np.float64)
        if numbers.ndim != 2 or numbers.shape[1] != 4 or not len(numbers):
            raise ValueError(
                f"it returned shape {numbers.shape}, not rows of x, y, z, radius [m]: shape (n, 4)"
            )
        return Spheres(numbers[:, :3], numbers[:, 3])
