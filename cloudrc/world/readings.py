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
        x_axis: The body's x axis in the world frame, shape (3,): the orientation once more, because
            both the drag and the low-level controller need it at every step.
        y_axis: Its y axis, likewise.
    """

    position: Vector
    orientation_wxyz: Quaternion
    velocity: Vector
    angular_velocity_body: Vector
    x_axis: Vector
    y_axis: Vector

    @classmethod
    def of(
        cls, position: Vector, orientation_wxyz: Quaternion, velocity: Vector, rate: Vector
    ) -> Readings:
        """Make readings, the axes from the orientation.

        Args:
            position: [m], world frame, shape (3,).
            orientation_wxyz: Body to world, unit quaternion, shape (4,).
            velocity: [m/s], world frame, shape (3,).
            rate: Angular velocity [rad/s], body frame, shape (3,).
        """
        w, x, y, z = orientation_wxyz
        xx, yy, zz = 2.0 * x * x, 2.0 * y * y, 2.0 * z * z
        xy, xz, yz = 2.0 * x * y, 2.0 * x * z, 2.0 * y * z
        wx, wy, wz = 2.0 * w * x, 2.0 * w * y, 2.0 * w * z
        return cls(
            position,
            orientation_wxyz,
            velocity,
            rate,
            (1.0 - yy - zz, xy + wz, xz - wy),
            (xy - wz, 1.0 - xx - zz, yz + wx),
        )


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
