# SPDX-License-Identifier: Apache-2.0

"""The onboard low-level controller: it makes the robot follow a velocity reference at 500 Hz.

A velocity PID computes the force that the robot needs. Geometric attitude control turns the thrust
axis towards this force. The allocation distributes thrust and torque over the four rotors. Vectors
are tuples of floats, because arrays would be too slow in every physics step.

Source: docs/reference/onboard.md.
Deviation: the published code assumes a step of 10 ms but runs every 2 ms. This module uses the true
step; its gains are converted so that the effect is the same.
"""

from __future__ import annotations

from math import sqrt
from typing import TypeAlias

from cloudrc.physics.sim.onboard import Commands
from cloudrc.physics.sim.readings import Readings
from cloudrc.robots.pelican.rotors import (
    ARM,
    SPEED_MAX,
    STOPPED,
    THRUST_COEFFICIENT,
    TORQUE_RATIO,
    RotorSpeeds,
)
from cloudrc.wire.messages import ZERO, Vector

MASS = 1.05
"""Mass that the controller assumes [kg]. Source: docs/reference/plant.md, "Total mass"."""
GRAVITY = 9.81
"""Gravity that the controller assumes [m/s^2]. Source: docs/reference/plant.md, "Gravity"."""
ROBOT_MASS, ROBOT_GRAVITY = 1.06, 9.8066
"""Mass of the robot [kg], and gravity of the physics [m/s^2].
Source: docs/reference/plant.md, "Total mass", "Gravity"."""
GAIN_P: Vector = (4.0, 4.0, 10.0)
"""Published force per velocity error [N s/m], shape (3,)."""
GAIN_I: Vector = (1.0, 1.0, 2.5)
"""Published force per integrated velocity error [N/m], shape (3,)."""
GAIN_D: Vector = (0.30, 0.30, 0.50)
"""Published force per rate of the velocity error [N s^2/m], shape (3,)."""
INTEGRAL_LIMIT_XY, INTEGRAL_LIMIT_Z = 0.10, 0.40
"""Published limits of the integrated velocity error in x and y, and in z [m]."""
TILT_GAIN, YAW_GAIN = 1.0, 0.035
"""Attitude gains k_R: torque per attitude error about x and y, and about z [N m]."""
TILT_RATE_GAIN, YAW_RATE_GAIN = 0.22, 0.01
"""Rate gains k_w: torque per angular velocity about x and y, and about z [N m s]."""
THRUST_MAX = THRUST_COEFFICIENT * SPEED_MAX**2
"""Largest thrust of one rotor [N]."""
TINY = 1e-9

Effort: TypeAlias = tuple[float, float, float, float]
"""Thrust [N] and torque about x, y, z [N m], body frame."""

_WEIGHT = MASS * GRAVITY
_HALF_TILT_GAIN, _HALF_YAW_GAIN = 0.5 * TILT_GAIN, 0.5 * YAW_GAIN
_TWO_ARMS, _FOUR_RATIOS = 2.0 * ARM, 4.0 * TORQUE_RATIO

NOSE_COSINE_MIN, YAW_SINE_MAX = 0.5, 0.3
"""Range in which the published formula of the attitude error is right: smallest cosine of the roll
error, largest sine of the yaw error [1]. For larger errors, `attitude` uses another formula."""


class LowLevel:
    """Controller that makes the robot follow a velocity at a yaw of 0, like the published code.

    Attributes:
        gains: Force per velocity error, per integrated error and per change of the error in one
            step, each for x, y and z [N s/m, N/m, N s/m], shape (9,).
        limits: Limit of the integrated error in x and y [m], its limit in z [m], time step [s].
        integral: Integrated velocity error [m], shape (3,).
        error: Velocity error of the last update [m/s], shape (3,); None after a reset.
        stopped: Rotor speeds while the guard has stopped the robot.
    """

    stopped: Commands = STOPPED
    obeys_yaw = False

    def __init__(
        self,
        gain_p: Vector = GAIN_P,
        gain_i: Vector = GAIN_I,
        gain_d: Vector = GAIN_D,
        integral_limit_xy: float = INTEGRAL_LIMIT_XY,
        integral_limit_z: float = INTEGRAL_LIMIT_Z,
        dt: float = 0.002,
    ) -> None:
        """Set the gains and limits of the velocity loop.

        Args:
            gain_p: Force per velocity error [N s/m], shape (3,).
            gain_i: Force per integrated velocity error [N/m], shape (3,).
            gain_d: Force per rate of the velocity error [N s^2/m], shape (3,).
            integral_limit_xy: Limit of the integrated velocity error in x and y [m].
            integral_limit_z: Limit of the integrated velocity error in z [m].
            dt: Time between two updates [s].
        """
        dx, dy, dz = gain_d
        # Gains of the error, its integral and its change per step; one tuple unpacks fastest.
        self.gains = (*gain_p, *gain_i, dx / dt, dy / dt, dz / dt)
        self.limits = (integral_limit_xy, integral_limit_z, dt)
        self.reset()

    def reset(self) -> None:
        """Set the integral to zero, and forget the velocity error of the last update."""
        self.integral = ZERO
        self.error: Vector | None = None

    def update(self, readings: Readings, velocity: Vector, yaw_rate: float = 0.0) -> RotorSpeeds:
        """Compute the rotor speeds that make the robot follow a velocity; call once per `dt`.

        `velocity` is the wanted velocity [m/s], world frame, shape (3,). The published controller
        holds the yaw at 0, so `yaw_rate` has no effect.
        """
        force = self.force(readings.velocity, velocity)
        return allocate(attitude(force, readings))

    def brake(self, readings: Readings, velocity: Vector) -> RotorSpeeds:
        """Follow `velocity` [m/s] as `update` does, but keep the integral constant.

        Deviation: the published controller always integrates. Its integral winds up while the robot
        brakes, and pushes the robot back for a second afterwards.
        """
        integral = self.integral
        speeds = self.update(readings, velocity)
        self.integral = integral
        return speeds

    def force(self, velocity: Vector, reference: Vector) -> Vector:
        """Compute the force that the robot needs [N], and advance the integral by one time step.

        e = v - v_ref;  F = -(Kp · e + Ki · int(e dt) + Kd · de/dt) + (0, 0, m · g), with a clamped
        integral. `velocity` is v, `reference` is v_ref, both in [m/s]; all are in the world frame.
        """
        px, py, pz, ix, iy, iz, dx, dy, dz = self.gains
        limit_xy, limit_z, dt = self.limits
        (vx, vy, vz), (rx, ry, rz) = velocity, reference
        # The opposite sign of the equation saves a negation per term.
        ex, ey, ez = error = (rx - vx, ry - vy, rz - vz)
        # After a reset there is no last error: the rate is 0.
        last_x, last_y, last_z = self.error or error
        self.error = error

        sx, sy, sz = self.integral
        sx += ex * dt
        sy += ey * dt
        sz += ez * dt
        sx = limit_xy if sx > limit_xy else -limit_xy if sx < -limit_xy else sx
        sy = limit_xy if sy > limit_xy else -limit_xy if sy < -limit_xy else sy
        sz = limit_z if sz > limit_z else -limit_z if sz < -limit_z else sz
        self.integral = (sx, sy, sz)

        return (
            px * ex + ix * sx + dx * (ex - last_x),
            py * ey + iy * sy + dy * (ey - last_y),
            pz * ez + iz * sz + dz * (ez - last_z) + _WEIGHT,
        )


def attitude(force: Vector, readings: Readings) -> Effort:
    """Return the thrust and torque that turn the thrust axis towards `force` and the nose to +x.

    `force` is F [N], world frame, shape (3,); R is the body's orientation and w its rate. R_d has
    the columns x_d, y_d, z_d; k_R and k_w are gains.
        z_d = F/|F|, y_d = z_d x (1, 0, 0) normalised, x_d = y_d x z_d; Q = R_d' R;
        e_R = 1/2 (Q21 - Q12, Q02 - Q20, Q10 - Q01); torque = -(k_R · e_R + k_w · w);
        thrust = F · (R z).
    The code works in the body frame, where the wanted axes are the rows of Q.
    Deviation: after a collision, the roll error may be above 60 degrees, or the yaw error above 17
    degrees. Then the code corrects the tilt about the body's present axes. The correction by e_R
    would be off by half the yaw error, and would have the wrong sign beyond 90 degrees.
    """
    fx, fy, fz = force
    _, _, _, (p, q, r), (xx, xy, xz, yx, yy, yz, zx, zy, zz) = readings
    thrust = fx * zx + fy * zy + fz * zz

    # A zero force, or a force along the nose, leaves an axis undefined, without torque about it.
    across = fy * fy + fz * fz
    scale = 1.0 / (sqrt(fx * fx + across) or TINY)
    z0 = scale * (fx * xx + fy * xy + fz * xz)
    z1 = scale * (fx * yx + fy * yy + fz * yz)
    z2 = scale * thrust
    scale = 1.0 / (sqrt(across) or TINY)
    y0 = scale * (fz * xy - fy * xz)
    y1 = scale * (fz * yy - fy * yz)
    y2 = scale * (fz * zy - fy * zz)

    if y1 < NOSE_COSINE_MIN or xy > YAW_SINE_MAX or xy < -YAW_SINE_MAX:
        roll, pitch = -z1 - z1, z0 + z0
    else:
        roll, pitch = y2 - z1, z0 + y1 * z0 - y0 * z1
    return (
        thrust,
        _HALF_TILT_GAIN * roll - TILT_RATE_GAIN * p,
        _HALF_TILT_GAIN * pitch - TILT_RATE_GAIN * q,
        _HALF_YAW_GAIN * (y2 * z0 - y0 * z2 - y0) - YAW_RATE_GAIN * r,
    )


def allocate(effort: Effort) -> RotorSpeeds:
    """Distribute thrust T and torque (tx, ty, tz) over the rotors; return their speeds w [rad/s].

    The thrusts f of the front, left, back and right rotor are
    T/4 + (-ty/2l + tz/4km, tx/2l - tz/4km, ty/2l + tz/4km, -tx/2l - tz/4km), with l = ARM and
    km = TORQUE_RATIO. w = sqrt(f / THRUST_COEFFICIENT), limited to [0, 1838 rad/s].
    """
    thrust, roll, pitch, yaw = effort
    roll, pitch, yaw = roll / _TWO_ARMS, pitch / _TWO_ARMS, yaw / _FOUR_RATIOS
    share = 0.25 * thrust
    with_yaw, against_yaw = share + yaw, share - yaw
    front, back = with_yaw - pitch, with_yaw + pitch
    left, right = against_yaw + roll, against_yaw - roll
    if thrust <= THRUST_MAX and front >= 0.0 and left >= 0.0 and back >= 0.0 and right >= 0.0:
        # No share is negative and their sum is the thrust, so no share exceeds the limit.
        k = THRUST_COEFFICIENT
        return sqrt(front / k), sqrt(left / k), sqrt(back / k), sqrt(right / k)
    return _speed(front), _speed(left), _speed(back), _speed(right)


def _speed(thrust: float) -> float:
    return sqrt(min(max(thrust, 0.0), THRUST_MAX) / THRUST_COEFFICIENT)
