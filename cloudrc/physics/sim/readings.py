# SPDX-License-Identifier: Apache-2.0

"""The interface between the physics and the onboard part: readings of ideal sensors.

The onboard part (`guard`, `sensors`, the robot's controller) sees nothing else of the physics
(`simulator`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, TypeAlias

from cloudrc.wire.messages import Quaternion, Vector

Axes: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
_new = tuple.__new__


class Readings(NamedTuple):
    """The true state of the robot's base, as ideal onboard sensors measure it.

    Attributes:
        position: Position of the base's origin [m], world frame, shape (3,).
        orientation_wxyz: Orientation, body to world, unit quaternion, shape (4,).
        velocity: Velocity of the base's origin [m/s], world frame, shape (3,).
        angular_velocity_body: Angular velocity [rad/s], body frame, shape (3,).
        axes: The body's x, y and z axes in the world frame, shape (9,), computed once per step from
            the orientation because several modules need the axes.
    """

    position: Vector
    orientation_wxyz: Quaternion
    velocity: Vector
    angular_velocity_body: Vector
    axes: Axes

    def on_ground(self) -> Readings:
        """Return the readings without height and vertical velocity, for a planar robot."""
        (x, y, _), orientation, (vx, vy, _), rate, axes = self
        return _new(Readings, ((x, y, 0.0), orientation, (vx, vy, 0.0), rate, axes))

    @classmethod
    def of(cls, pose: Iterable[float], twist: Iterable[float]) -> Readings:
        """Make readings from the state of a free joint in MuJoCo.

        `pose` has the position [m], world frame, and the orientation (wxyz, unit), shape (7,).
        `twist` has the velocity [m/s], world frame, and the angular velocity [rad/s], body frame,
        shape (6,).
        """
        px, py, pz, w, x, y, z = pose
        vx, vy, vz, p, q, r = twist
        x2, y2, z2 = x + x, y + y, z + z
        wx, wy, wz = w * x2, w * y2, w * z2
        xx, xy, xz = x * x2, x * y2, x * z2
        yy, yz, zz = y * y2, y * z2, z * z2
        axes = (
            1.0 - yy - zz,
            xy + wz,
            xz - wy,
            xy - wz,
            1.0 - xx - zz,
            yz + wx,
            xz + wy,
            yz - wx,
            1.0 - xx - yy,
        )
        # One per physics step: the class's own constructor takes twice the time.
        return _new(cls, ((px, py, pz), (w, x, y, z), (vx, vy, vz), (p, q, r), axes))
