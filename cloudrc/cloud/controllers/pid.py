# SPDX-License-Identifier: Apache-2.0

"""Controller: PID on the position of the predicted odometry.

Source: the paper, eqs. (4) and (5); gains: docs/reference/plant.md, "Cloud controller".
"""

from __future__ import annotations

from math import hypot, inf
from operator import add
from typing import NamedTuple

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.config.schema import NotNegative, NotNegatives
from cloudrc.physics.geometry.vectors import turn_to
from cloudrc.wire.messages import ZERO, Odometry, Setpoint, Vector

GAIN_YAW = 0.8
"""Gain of the yaw if a waypoint asks for one [1/s]: that of x and y, so that delays have the same
effect on both."""
UNLIMITED: Vector = (inf, inf, inf)
_new = tuple.__new__  # makes a named tuple twice as fast as its class does


class Law(NamedTuple):
    """A controller without limits and without memory: gains of the position and the velocity."""

    gain_p: Vector  # [1/s]
    gain_d: Vector  # [1]
    has_derivative: bool


class Pid(Controller):
    """PID controller: from the position error to a velocity command.

    Deviations from eq. (4) of the paper and from the published code:

    - Here error = setpoint - estimate. Eq. (4) as printed has estimate - setpoint, which diverges
      with positive gains.
    - The derivative acts on the velocity of the setpoint minus that of the robot. A setpoint that
      jumps has the velocity 0, so that it causes no kick.
    - Velocity and yaw rate of the setpoint are added to the output (feed-forward).
    - The integral term, the velocity per axis and the speed are limited; the published code has no
      limits. While the output of an axis is limited, the axis does not integrate an error that
      would push the output further (conditional anti-windup).

    The default gains are the published ones.
    Source: docs/reference/plant.md, "Cloud controller": P .8, .8, 1.5; I 0; D 0; no saturation.

    Args:
        gain_p: Proportional gain per axis [1/s], shape (3,).
        gain_i: Integral gain per axis [1/s^2], shape (3,).
        gain_d: Derivative gain per axis [1], shape (3,).
        gain_yaw: Gain of the yaw [1/s], always; None: 0.8 if a waypoint asks for a yaw, else 0. The
            published low-level controller ignores the yaw rate.
        integral_limit: Largest integral term per axis [m/s], shape (3,); None: no limit.
        velocity_max: Largest velocity per axis [m/s], shape (3,); None: no limit.
        speed_max: Largest speed [m/s]; the limit keeps the direction. None: no limit. With an
            integral gain, `speed_max` should not exceed the guard's speed cap, because the
            anti-windup does not take the guard into account.
    """

    def __init__(
        self,
        gain_p: NotNegatives = (0.8, 0.8, 1.5),
        gain_i: NotNegatives = ZERO,
        gain_d: NotNegatives = ZERO,
        gain_yaw: NotNegative | None = None,
        integral_limit: NotNegatives | None = None,
        velocity_max: NotNegatives | None = None,
        speed_max: NotNegative | None = None,
    ) -> None:
        self._gain_p, self._gain_d = gain_p, gain_d
        self._gain_yaw = GAIN_YAW if gain_yaw is None else gain_yaw
        self._always_turns = bool(gain_yaw)
        self._integral_limit = integral_limit or UNLIMITED
        self._velocity_max = velocity_max or UNLIMITED
        self._speed_max = inf if speed_max is None else speed_max
        self._gain_i = ZERO if gain_i == ZERO else gain_i
        self._proportional_only = gain_i == ZERO and gain_d == ZERO
        self._limited = velocity_max is not None or speed_max is not None
        self._integral = ZERO

    @property
    def law(self) -> Law | None:
        """The controller, if its velocity depends on the present error alone; else None."""
        if self._limited or self._gain_i is not ZERO:
            return None
        return Law(self._gain_p, self._gain_d, not self._proportional_only)

    def reset(self) -> None:
        """Set the integral to zero at the start of a session or mission."""
        self._integral = ZERO

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Compute one command: u = P · e + I · (integral of e) + D · (v_s - v) + v_s, limited.

        Here v is the robot's velocity and v_s the setpoint's, in [m/s]. The limits of velocity
        and speed apply to u, but not to the returned terms. The integral has the errors of earlier
        updates only; the present error is integrated over `dt` [s] for the next update.
        Source: the paper, eq. (5).
        """
        px, py, pz = estimate.position
        sx, sy, sz = setpoint.position
        gx, gy, gz = self._gain_p
        ex, ey, ez = sx - px, sy - py, sz - pz
        wanted = proportional = (gx * ex, gy * ey, gz * ez)
        integral, derivative = self._integral, ZERO
        if not self._proportional_only:
            vx, vy, vz = estimate.velocity
            rx, ry, rz = setpoint.velocity
            gx, gy, gz = self._gain_d
            derivative = (gx * (rx - vx), gy * (ry - vy), gz * (rz - vz))
            x, y, z = map(add, map(add, proportional, integral), derivative)
            wanted = (x, y, z)
        if setpoint.velocity is not ZERO:
            x, y, z = map(add, wanted, setpoint.velocity)
            wanted = (x, y, z)
        velocity = self._limit(wanted) if self._limited else wanted
        if self._gain_i is not ZERO:
            self._integrate((ex, ey, ez), wanted, velocity, dt)
        yaw_rate = 0.0
        if self._always_turns or setpoint.turns:
            yaw_rate = self._gain_yaw * turn_to(setpoint.yaw, estimate.orientation_wxyz)
            if setpoint.yaw_rate:
                yaw_rate += setpoint.yaw_rate
        return _new(ControlOutput, (velocity, yaw_rate, proportional, integral, derivative))

    def _limit(self, wanted: Vector) -> Vector:
        x, y, z = (
            max(min(value, limit), -limit)
            for value, limit in zip(wanted, self._velocity_max, strict=True)
        )
        speed = hypot(x, y, z)
        if speed <= self._speed_max:
            return (x, y, z)
        scale = self._speed_max / speed
        return (x * scale, y * scale, z * scale)

    def _integrate(self, error: Vector, wanted: Vector, velocity: Vector, dt: float) -> None:
        """Integrate `error` [m] over `dt` [s], with anti-windup on each axis.

        `wanted` and `velocity` are the output before and after the limits [m/s].
        """
        terms = zip(self._integral, self._gain_i, self._integral_limit, strict=True)
        x, y, z = (
            max(min(term + gain * e * dt, limit), -limit) if v == u or e * u < 0 else term
            for (term, gain, limit), e, u, v in zip(terms, error, wanted, velocity, strict=True)
        )
        self._integral = (x, y, z)


build = Pid
