"""The seam between physics and what flies on board: readings come out, rotor speeds go in.

Nothing else passes between `simulator` and `low_level`, `guard` or `sensors`, so that the two sides
can live in different processes. This module needs no MuJoCo.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from cloudrc.messages import Quaternion, Vector

RotorSpeeds: TypeAlias = tuple[float, float, float, float]
"""Front, left, back, right [rad/s], >= 0."""


class Readings(NamedTuple):
    """The true state of the robot's base, as ideal onboard sensors see it.

    A tuple, because one is made at every physics step and it is made five times faster than a
    frozen dataclass.

    Attributes:
        position: Of the base's origin [m], world frame, shape (3,).
        orientation_wxyz: Body to world, unit quaternion, shape (4,).
        velocity: Of the base's origin [m/s], world frame, shape (3,).
        angular_velocity_body: [rad/s], body frame, shape (3,).
    """

    position: Vector
    orientation_wxyz: Quaternion
    velocity: Vector
    angular_velocity_body: Vector


class Touch(NamedTuple):
    """The robot has begun to touch something of the scene.

    Attributes:
        body: Name of the scene's body: pipe_1, board, floor.
        tip: True if the arm's tip touched, False for any other part.
        position: Of the base just before [m], world frame, shape (3,).
        velocity: Of the base just before [m/s], world frame, shape (3,).
        tip_velocity: Of the arm's tip just before [m/s], world frame, shape (3,).
    """

    body: str
    tip: bool
    position: Vector
    velocity: Vector
    tip_velocity: Vector
