# SPDX-License-Identifier: Apache-2.0

"""Fly any multirotor: a body with a free joint, and actuators that push at sites.

Allocation and hover thrust come from the compiled model, and gains from bandwidths. So one
controller flies a robot of 27 g and one of several kg, with any number and layout of rotors.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, hypot, pi, radians, remainder, sqrt, tan
from typing import Any

from cloudrc.config.schema import NotNegative, Tilt
from cloudrc.physics.sim.airframe import Airframe, read_airframe
from cloudrc.physics.sim.onboard import Accelerator, Actuators, Commands, Direct
from cloudrc.physics.sim.readings import Readings
from cloudrc.robots.onboard._allocation import Allocation
from cloudrc.robots.onboard._drag import RotorDrag
from cloudrc.wire.messages import ZERO, Vector

VELOCITY_RADPS, ATTITUDE_RADPS, YAW_RADPS = 5.0, 20.0, 4.0
"""Largest default bandwidths of velocity, attitude and yaw [rad/s]."""
ATTITUDE_MAX_RADPS = 100.0
"""Largest bandwidth of the attitude [rad/s]: a fifth of the rate of the steps."""
LAG_MAX = 0.05
"""Largest lag of an actuator [s]. With a longer one, the attitude is too slow to brake in time."""
CLIMB = 2.0
"""Bandwidth of the vertical velocity relative to that of the horizontal velocity [1]. The thrust
follows at once, the tilt does not."""
WIND = 2.0
"""Largest horizontal acceleration of the integral [m/s^2]: what wind can ask for."""
WEIGHT = 0.5
"""Largest vertical acceleration of the integral, relative to gravity [1]: a payload."""
SINK, RISE = 0.6, 0.9
"""Largest planned downward acceleration relative to gravity, and largest planned upward
acceleration relative to what the thrust allows [1]."""
AHEAD = 0.8
"""Largest planned horizontal acceleration relative to what the tilt limit allows [1]. The rest is
left for corrections."""
THRUST_MIN = 0.3
"""Smallest commanded vertical force relative to the weight [1]: the robot can still turn."""
THRUST_MAX = 2.5
"""Largest commanded force relative to the weight [1]."""
BRAKING = 3.0
"""Deceleration that the guard expects of a robot whose robot.yaml does not say it [m/s^2]."""
YAW_LEAD_MAX = 0.5
"""Largest difference between the yaw reference and the yaw [rad]."""
TINY = 1e-9
SPIN_MAX = 50.0
"""Largest angular velocity in free air [rad/s], for `acceleration_max`."""


@dataclass(frozen=True)
class Gains:
    """Bandwidths and limits of the controller."""

    velocity: float  # bandwidth of the horizontal velocity [rad/s]
    attitude: float  # bandwidth of roll and pitch [rad/s]
    yaw: float  # bandwidth of the yaw [rad/s]
    tilt_max: float  # largest commanded tilt [rad]


class Multirotor:
    """Controller that makes a multirotor follow a velocity and a yaw rate.

    A first-order model of the wanted response plans velocity and acceleration. A PI controller
    keeps the velocity on this plan, so that steps do not wind up the integral. Geometric attitude
    control turns the thrust axis towards the wanted acceleration, and the nose to the yaw
    reference.

    Attributes:
        gains: Bandwidths and limits.
        allocation: Turns accelerations into controls.
        acceleration_max: Largest acceleration in free air [m/s^2], with reserve.
        stopped: Controls while the guard has stopped the robot.
        obeys_yaw: Whether it follows a yaw rate.
    """

    stopped: Commands

    def __init__(
        self, frame: Airframe, allocation: Allocation, gains: Gains, dt: float, drag: float = 0.0
    ) -> None:
        """Set up the loops; `dt` is the time between two updates [s].

        `drag` is the drag of the rotors relative to the thrust and to the velocity [s/m].
        """
        self.gains = gains
        self.stopped = allocation.stopped
        self.obeys_yaw = gains.yaw > 0.0
        self.allocation, self._allocate = allocation, allocation.allocate
        self._dt = dt
        self._gravity = gravity = frame.gravity
        self._drag = drag * gravity  # deceleration of a hovering robot per velocity [1/s]
        self._thrust_max = min(allocation.acceleration_max, THRUST_MAX * gravity)
        self._slope_max = tan(gains.tilt_max)
        self._ahead_max = gravity * self._slope_max
        self._lead_max = self._ahead_max / gains.velocity
        self._climb_lead_max = gravity / (CLIMB * gains.velocity)
        self._rise_max = min(RISE * (self._thrust_max - gravity), gravity)
        # Numbers of each step; the products have the order of the formulas.
        b, climb = gains.velocity, CLIMB * gains.velocity
        self._planned_max, self._sink_max = AHEAD * self._ahead_max, -SINK * gravity
        self._up_min, self._heave_max = THRUST_MIN * gravity, WEIGHT * gravity
        self._thrust_square = self._thrust_max * self._thrust_max
        self._bandwidths = b, climb, 0.5 * gains.attitude * dt, 0.25 * b * b, 0.25 * climb * climb
        x, y, z = frame.centre.tolist()
        self._centre = (x, y, z)
        turning = SPIN_MAX * SPIN_MAX * hypot(x, y, z)
        self.acceleration_max = 2.0 * (allocation.acceleration_max + gravity + turning)
        self.reset()

    def reset(self) -> None:
        """Forget plan, integral and yaw reference; the next update takes the present ones."""
        self._plan: Vector | None = None  # planned velocity [m/s]
        self._lagging = (0.0, 0.0)  # planned horizontal velocity, after the lag of the tilt [m/s]
        self._integral = ZERO  # [m/s^2]
        self._yaw: float | None = None  # yaw reference [rad]

    @property
    def numbers(self) -> tuple[float, ...]:
        """The constants of `native/multirotor.c`, in its order."""
        b, climb, part, gain, gain_z = self._bandwidths
        limits = self._thrust_max, self._slope_max, self._lead_max, self._climb_lead_max
        planned = self._rise_max, self._planned_max, self._sink_max
        forces = self._up_min, self._heave_max, self._thrust_square
        gains = b, climb, part, gain, gain_z, self.gains.attitude, self.gains.yaw
        common = WIND, TINY, YAW_LEAD_MAX, *self._centre
        return self._dt, self._gravity, self._drag, *limits, *planned, *forces, *gains, *common

    @property
    def memory(self) -> tuple[float, ...] | None:
        """Plan, plan after the lag, integral and yaw reference, shape (9,); None after a reset."""
        if self._plan is None or self._yaw is None:
            return None
        return *self._plan, *self._lagging, *self._integral, self._yaw

    @memory.setter
    def memory(self, numbers: tuple[float, ...]) -> None:
        x, y, z, lag_x, lag_y, ix, iy, iz, self._yaw = numbers
        self._plan, self._lagging, self._integral = (x, y, z), (lag_x, lag_y), (ix, iy, iz)

    def update(self, readings: Readings, velocity: Vector, yaw_rate: float) -> Commands:
        """Return the controls that make the robot follow a velocity; call once per time step.

        `velocity` is the wanted velocity [m/s], world frame, shape (3,); `yaw_rate` is the wanted
        yaw rate [rad/s].
        """
        acceleration = self._acceleration(self._velocity(readings), velocity)
        yaw = self._yaw_acceleration(readings, yaw_rate)
        thrust, roll, pitch = self._tilt(acceleration, readings)
        return self._allocate(thrust, roll, pitch, yaw)

    def brake(self, readings: Readings, velocity: Vector) -> Commands:
        """Follow `velocity` [m/s] and keep the yaw, but keep the integral constant."""
        integral = self._integral
        commands = self.update(readings, velocity, 0.0)
        self._integral = integral
        return commands

    def _velocity(self, readings: Readings) -> Vector:
        """Return the velocity of the base's origin without the part of roll and pitch rates.

        This part is the velocity of the origin about the centre of mass, which no force changes.
        """
        _, _, (vx, vy, vz), (p, q, _), (xx, xy, xz, yx, yy, yz, zx, zy, zz) = readings
        cx, cy, cz = self._centre
        u, v, w = q * cz, -p * cz, p * cy - q * cx
        return (
            vx + xx * u + yx * v + zx * w,
            vy + xy * u + yy * v + zy * w,
            vz + xz * u + yz * v + zz * w,
        )

    def _acceleration(self, velocity: Vector, reference: Vector) -> Vector:
        """Return the acceleration that the actuators must make, and advance plan and integral.

        With the plan u, its bandwidth b, the reference r and the gravity g, in the world frame:
            du/dt = b · (r - u), limited;
            a = du/dt + d · u + b · (u - v) + integral of b^2/4 · (u - v) + g.
        Both poles of the PI loop are at b/2. The vertical loop has the bandwidth CLIMB · b. The
        horizontal drag d · u is that of the rotors in still air: the integral is left for the wind,
        and a robot that brakes with a constant integral comes to rest. The tilt follows with a lag
        of 2/b of the attitude; so the horizontal velocity is compared with the plan after this lag,
        else it would overshoot.
        """
        dt, gravity = self._dt, self._gravity
        b, climb, part, gain, gain_z = self._bandwidths
        vx, vy, vz = velocity
        rx, ry, rz = reference
        if self._plan is None:
            self._plan, self._lagging = velocity, (vx, vy)
        ux, uy, uz = self._plan
        lx, ly = self._lagging
        ix, iy, iz = self._integral

        planned_x, planned_y = b * (rx - ux), b * (ry - uy)
        planned_x, planned_y = _shorten(planned_x, planned_y, self._planned_max)
        planned_z = min(max(climb * (rz - uz), self._sink_max), self._rise_max)
        ex, ey, ez = lx - vx, ly - vy, uz - vz
        # A robot that cannot follow, as in contact, does not get the whole plan later.
        ahead, aside = _shorten(ux + planned_x * dt - vx, uy + planned_y * dt - vy, self._lead_max)
        above = min(max(uz + planned_z * dt - vz, -self._climb_lead_max), self._climb_lead_max)
        self._plan = (vx + ahead, vy + aside, vz + above)
        self._lagging = (lx + part * (ux - lx), ly + part * (uy - ly))

        # The vertical force has priority; the tilt limit and the largest thrust bound the rest.
        wanted_z = planned_z + climb * ez + iz + gravity
        up = min(max(wanted_z, self._up_min), self._thrust_max)
        drag = self._drag
        wanted_x = planned_x + drag * ux + b * ex + ix
        wanted_y = planned_y + drag * uy + b * ey + iy
        left = sqrt(self._thrust_square - up * up)
        ahead, aside = _shorten(wanted_x, wanted_y, min(up * self._slope_max, left))

        # A limited force would wind up the integral.
        if up == wanted_z:
            iz += gain_z * ez * dt
            iz = min(max(iz, -self._heave_max), self._heave_max)
        if ahead == wanted_x and aside == wanted_y:
            ix, iy = _shorten(ix + gain * ex * dt, iy + gain * ey * dt, WIND)
        self._integral = (ix, iy, iz)
        return ahead, aside, up

    def _tilt(self, acceleration: Vector, readings: Readings) -> Vector:
        """Return the thrust and the angular accelerations about x and y that make `acceleration`.

        `acceleration` is in [m/s^2], world frame, shape (3,). The thrust [m/s^2] is its part along
        the body's z axis. The angular accelerations [rad/s^2] turn this axis by the smallest angle
        towards the acceleration, critically damped.
        """
        ax, ay, az = acceleration
        _, _, _, (p, q, _), (xx, xy, xz, yx, yy, yz, zx, zy, zz) = readings
        ahead = ax * xx + ay * xy + az * xz
        aside = ax * yx + ay * yy + az * yz
        thrust = ax * zx + ay * zy + az * zz
        across = hypot(ahead, aside)
        angle = atan2(across, thrust)
        if across > TINY:
            roll, pitch = -angle * aside / across, angle * ahead / across
        else:
            roll, pitch = angle, 0.0  # upright, or upside down: turn about any axis
        b = self.gains.attitude
        return thrust, b * (b * roll - 2.0 * p), b * (b * pitch - 2.0 * q)

    def _yaw_acceleration(self, readings: Readings, yaw_rate: float) -> float:
        """Advance the yaw reference; return the angular acceleration about z [rad/s^2].

        The yaw is the direction of the nose on the ground. The reference stays within YAW_LEAD_MAX
        of the yaw, so that it does not run away from a robot that cannot turn.
        """
        axes, r = readings.axes, readings.angular_velocity_body[2]
        yaw = atan2(axes[1], axes[0])
        reference = yaw if self._yaw is None else self._yaw
        lead = remainder(reference + yaw_rate * self._dt - yaw, 2.0 * pi)
        lead = min(max(lead, -YAW_LEAD_MAX), YAW_LEAD_MAX)
        self._yaw = yaw + lead
        b = self.gains.yaw
        return b * (b * lead + 2.0 * (yaw_rate - r))


def build(
    model: Any,
    *,
    velocity_bandwidth_radps: float | None = None,
    attitude_bandwidth_radps: float | None = None,
    yaw_bandwidth_radps: float | None = None,
    tilt_max_deg: Tilt = 35.0,
    drag_s_per_m: NotNegative = 0.0,
    braking_mps2: float = BRAKING,
) -> Multirotor:
    """Make the controller for the compiled `MjModel` of a robot in its scene.

    Without bandwidths, the robot is as fast as its actuators allow, up to the usual values.

    Args:
        model: The model. Joint 0 is the robot's free joint.
        velocity_bandwidth_radps: Bandwidth of the horizontal velocity [rad/s]; a velocity step is
            63 % done after about its inverse. The vertical velocity is twice as fast. Default: 5,
            or a quarter of the attitude's bandwidth.
        attitude_bandwidth_radps: Bandwidth of roll and pitch [rad/s]. Default: 20, or less for a
            robot that turns slowly or whose actuators lag.
        yaw_bandwidth_radps: Bandwidth of the yaw [rad/s]. Default: 4, or less for a robot that
            turns slowly. 0: leave the yaw alone.
        tilt_max_deg: Largest commanded tilt [deg].
        drag_s_per_m: Drag of the rotors, which `actuators` simulates and the controller adds to its
            force: force relative to the thrust of a rotor and to the velocity of its hub across its
            axis [s/m]. Default: no drag. The robots nano and x2 have 0.0258 and 0.0282.
        braking_mps2: Deceleration that the guard expects [m/s^2]; a robot without the thrust to
            stop a descent with it cannot be flown. It comes from `guard` in robot.yaml.

    Raises:
        ValueError: If the controller cannot fly the model, or a value does not fit.
    """
    steers_yaw = yaw_bandwidth_radps != 0.0
    frame = read_airframe(model, steers_yaw=steers_yaw)
    allocation = Allocation(frame, braking_mps2)
    lag = frame.lag or TINY
    if lag > LAG_MAX:
        raise ValueError(f"an actuator has a lag (dynprm) of {lag:g} s, above {LAG_MAX:g} s")
    # At most so fast that turns up to 50 degrees (8/9 rad) end without overshoot although the
    # actuators saturate; and slow enough for the lag of the actuators.
    attitude = min(ATTITUDE_RADPS, 3.0 * sqrt(allocation.turn_max), 0.4 / lag)
    most = min(ATTITUDE_MAX_RADPS, 1.0 / lag)
    attitude = _checked("attitude", attitude_bandwidth_radps, attitude, most)
    velocity = min(VELOCITY_RADPS, 0.25 * attitude)
    velocity = _checked("velocity", velocity_bandwidth_radps, velocity, 0.5 * attitude)
    yaw = min(YAW_RADPS, 2.0 * sqrt(allocation.yaw_max), 0.5 * attitude)
    yaw = _checked("yaw", yaw_bandwidth_radps, yaw, attitude) if steers_yaw else 0.0
    gains = Gains(velocity, attitude, yaw, radians(tilt_max_deg))
    return Multirotor(frame, allocation, gains, model.opt.timestep, drag_s_per_m)


def actuators(model: Any, dt: float, *, drag_s_per_m: float = 0.0) -> Actuators:
    """Make the actuators of a compiled `MjModel`: MuJoCo's own, with drag of the rotors if wanted.

    `dt` is the duration of a step [s]. `drag_s_per_m` is the drag [s/m] as in `build`.
    """
    return RotorDrag(model, drag_s_per_m) if drag_s_per_m else Direct(model.nu)


def accelerator() -> Accelerator:
    """Return what runs the usual steps in C, if this machine can."""
    from cloudrc.robots.native.robot import accelerate
    from cloudrc.robots.onboard._twins import MultirotorTwin

    return accelerate(MultirotorTwin, "x2", _example)


def _example(model: Any) -> tuple[Multirotor, RotorDrag]:
    drag = 0.03
    return build(model, drag_s_per_m=drag), RotorDrag(model, drag)


def _checked(name: str, wanted: float | None, default: float, most: float) -> float:
    if wanted is None:
        return default
    if not 0.0 < wanted <= most:
        raise ValueError(f"{name}_bandwidth_radps: {wanted:g} is not above 0 and up to {most:g}")
    return wanted


def _shorten(x: float, y: float, length: float) -> tuple[float, float]:
    """Return a vector of at most a given length, in any unit."""
    size = hypot(x, y)
    if size <= length:
        return x, y
    return x * length / size, y * length / size
