# SPDX-License-Identifier: Apache-2.0

"""Onboard controller for robots with driven wheels on the left and on the right.

The robot turns its nearer end, front or back, towards the wanted velocity, and drives with that
part of the velocity that points along the robot. It ignores the vertical component. With v and w,
the speed of the base and its yaw rate, a wheel of the radius r at the distance y to the left of the
base turns at (v - w y) / r.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, hypot
from typing import Any

from cloudrc.config.schema import Positive
from cloudrc.physics.sim.onboard import Accelerator, Commands, Direct
from cloudrc.physics.sim.readings import Readings
from cloudrc.physics.sim.wheels import Wheel, read_wheels
from cloudrc.wire.messages import Vector

SLOW = 0.1
"""Below this wanted speed the robot turns towards it more slowly, in proportion, because the
direction of a speed near zero is noise [m/s]."""
NEAR_REST = 0.05
"""Below this wanted speed a commanded yaw rate alone turns the robot: towards the last centimetres
to a goal it would turn away from the heading that it has to have there [m/s]."""
KEEP_END = 0.2
"""The end that leads changes when the velocity points beyond the side of the robot by an angle with
this sine. Without this margin, a velocity to the side would make the robot turn to and fro."""


class DiffDrive:
    """Makes a robot with driven wheels follow a horizontal velocity.

    It does not obey a yaw, because the robot needs its heading to drive.

    Attributes:
        stopped: Commands of wheels at rest.
        wheels: Place of each wheel to the left of the base [m], and command per speed.
        lead: 1 if the front leads, -1 if the back leads.
    """

    obeys_yaw = False

    def __init__(self, wheels: Sequence[Wheel], turn_gain: float, turn_rate_max: float) -> None:
        """Begin with the front in the lead.

        `turn_gain` is in [1/s], `turn_rate_max` in [rad/s]; `build` describes them.
        """
        self.stopped: Commands = (0.0,) * len(wheels)
        self.wheels = [(wheel.y, wheel.command) for wheel in wheels]
        self._turn_gain = turn_gain
        self._speed_max = min(wheel.speed_max for wheel in wheels)
        self._half_track = max(abs(wheel.y) for wheel in wheels)
        self._turn_rate_max = min(turn_rate_max, self._speed_max / self._half_track)
        self.lead = 1.0

    @property
    def numbers(self) -> tuple[float, ...]:
        """The constants of `native/diff_drive.c`, in its order."""
        limits = self._turn_rate_max, self._speed_max, self._half_track
        return SLOW, NEAR_REST, KEEP_END, self._turn_gain, *limits

    def reset(self) -> None:
        """Let the front lead."""
        self.lead = 1.0

    def update(self, readings: Readings, velocity: Vector, yaw_rate: float) -> Commands:
        """Return the wheels' speeds [rad/s] that turn the robot towards a velocity and drive.

        `velocity` is in [m/s], world frame, shape (3,). `yaw_rate` is in [rad/s]. A robot that has
        to drive needs its heading for that: it follows `yaw_rate` only near rest.
        """
        x, y, _ = velocity
        ahead_x, ahead_y = readings.axes[0], readings.axes[1]
        ahead = x * ahead_x + y * ahead_y
        left = y * ahead_x - x * ahead_y
        speed = hypot(ahead, left)
        if self.lead * ahead < -KEEP_END * speed:
            self.lead = -self.lead
        share = min(speed / SLOW, 1.0)
        if yaw_rate and speed < NEAR_REST:
            share = 0.0
        angle = atan2(self.lead * left, self.lead * ahead)
        turn = share * self._turn_gain * angle + (1.0 - share) * yaw_rate
        return self._wheel_speeds(ahead, turn)

    def brake(self, readings: Readings, velocity: Vector) -> Commands:
        """Return the wheels' speeds [rad/s] while the robot brakes to a velocity [m/s]."""
        return self.update(readings, velocity, 0.0)

    def _wheel_speeds(self, ahead: float, turn: float) -> Commands:
        """Return commands for a speed [m/s] and a yaw rate [rad/s]; turning comes first."""
        most = self._turn_rate_max
        turn = most if turn > most else -most if turn < -most else turn
        rest = self._speed_max - abs(turn) * self._half_track
        ahead = max(min(ahead, rest), -rest)
        return tuple([(ahead - turn * y) * command for y, command in self.wheels])


def build(
    model: Any,
    turn_gain: Positive = 3.0,
    turn_rate_max: Positive = 3.0,
    wheel_radius_m: Positive | None = None,
) -> DiffDrive:
    """Make the controller for a compiled `MjModel`.

    Each actuator of the model is a velocity servo of a wheel; radius, place and largest speed of
    each wheel are those of the model.

    Args:
        model: The robot in its scene.
        turn_gain: Yaw rate per angle between the robot and the wanted velocity [1/s].
        turn_rate_max: Largest yaw rate [rad/s].
        wheel_radius_m: Radius of the wheels [m], for wheels whose shape is a mesh; None: the radius
            of the largest round geom of each wheel.

    Raises:
        ValueError: If the model has no such wheels.
    """
    return DiffDrive(read_wheels(model, wheel_radius_m), turn_gain, turn_rate_max)


def accelerator() -> Accelerator:
    """Return what runs the usual steps in C, if this machine can."""
    from cloudrc.robots.native.robot import accelerate
    from cloudrc.robots.onboard._twins import DiffDriveTwin

    return accelerate(DiffDriveTwin, "rover", _example)


def _example(model: Any) -> tuple[DiffDrive, Direct]:
    return build(model), Direct(model.nu)
