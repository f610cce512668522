# SPDX-License-Identifier: Apache-2.0

"""Make ROS markers of the robot, its surroundings and paths, as RViz and Foxglove show them.

A marker moves with its frame: the robot with `base_link`, the robot that cloud predicts with
`estimate`, the ball at the setpoint with `setpoint`. The scene has the frame `world`; a body of it
that moves has its own.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np

from cloudrc.physics.geometry.scene import Scene
from cloudrc.physics.geometry.shapes import Shapes, Surface
from cloudrc.physics.geometry.tubes import wall
from cloudrc.results.record.ros import header, pack
from cloudrc.results.record.topics import VIEWS

_Colour: TypeAlias = tuple[float, float, float, float]
MarkerShape: TypeAlias = tuple[Any, ...]
"""Arguments of `_marker`, from `name` on."""

SPHERE, LINE_STRIP, TRIANGLE_LIST = 2, 4, 11
"""Types of a ROS marker."""
GOAL, PATH = (0.84, 0.37, 0.0, 0.9), (0.0, 0.45, 0.70, 1.0)
GHOST, GLASS = (0.34, 0.71, 0.91, 0.45), (0.70, 0.74, 0.78, 0.35)
"""Colours of setpoint, path, predicted robot and tubes: red, green, blue, opacity in [0, 1]."""
GOAL_SIZE = 0.12
"""Largest diameter of the setpoint's ball [m]; that of a small robot is smaller."""


def scene_shapes(bodies: Shapes, geometry: Scene, prefix: str = "") -> list[MarkerShape]:
    """Make the shapes of the robot, the predicted robot, the setpoint and the scene.

    `geometry` tells which bodies of the scene are tubes, and which move: these have frames of their
    own. `prefix` precedes the names of the robot's frames.
    """
    size, names = bodies.size / 4 or GOAL_SIZE, {tube.name for tube in geometry.tubes}
    scene = [each for each in bodies.scene if each.body not in names]
    scene += [wall(tube, GLASS, 24) for tube in geometry.tubes]
    moving = {each.name: np.negative(each.path[0]) for each in geometry.moving}
    return [
        *(_solid("robot", f"{prefix}base_link", part, part.rgba) for part in bodies.robot),
        *(_solid("estimate", f"{prefix}estimate", part, GHOST) for part in bodies.robot),
        ("setpoint", SPHERE, f"{prefix}setpoint", min(GOAL_SIZE, size), GOAL),
        *(
            _solid(each.body, each.body, each.placed(moving[each.body], np.eye(3)), each.rgba)
            if each.body in moving
            else _solid(each.body, "world", each, each.rgba)
            for each in scene
        ),
    ]


def path_shape(name: str, points: Iterable[Any], colour: _Colour = PATH) -> MarkerShape:
    """Make a line through `points` [m], shape (n, 3), n > 1, world frame."""
    return name, LINE_STRIP, "world", 0.02, colour, points


def encode_markers(stamp_ns: int, shapes: Iterable[MarkerShape]) -> bytes:
    """Encode a visualization_msgs/MarkerArray as CDR.

    With the stamp 0, RViz uses the newest poses of the frames.
    """
    markers = [_marker(number, stamp_ns, *shape) for number, shape in enumerate(shapes)]
    return pack(VIEWS["/scene"], markers)


def _marker(
    number: int,
    stamp_ns: int,
    name: str,
    kind: int,
    frame: str,
    size: float,
    colour: _Colour,
    points: Iterable[Any] = (),
) -> Any:
    """Return the values of a ROS marker at the origin of `frame`.

    `size` and `points`, shape (n, 3), are in [m].
    """
    none, still = np.zeros(0, np.uint8), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    about = header(stamp_ns, frame), name, number, kind, 0, still, (size, size, size), colour
    corners = np.asarray(points, np.float32).reshape(-1, 3).tolist()
    picture = header(0, ""), "", none
    # Shown for ever, moving with its frame; no colours of corners, no texture, text or mesh.
    return *about, (0, 0), True, corners, [], "", picture, [], "", "", ("", none), False


def _solid(name: str, frame: str, surface: Surface, colour: _Colour) -> MarkerShape:
    """Make a shape of triangles."""
    points = surface.corners[surface.triangles].reshape(-1, 3)
    return name, TRIANGLE_LIST, frame, 1.0, colour, points
