# SPDX-License-Identifier: Apache-2.0

"""Model of the Pelican and its onboard controller, with which cloud predicts.

The model contains the guard's limits, the velocity PID, the attitude loop, rotors and drag. The
odometry lacks the velocity reference, the PID's integral, thrust and torque; the model computes
them from the commands that the echoes confirm. Each odometry sample replaces the model's pose and
twist. The model estimates effects that it lacks, such as wind, a payload or the arm's weight, as a
constant acceleration and a constant torque.

Source: docs/reference/control.md, "Predictors", (e2); docs/reference/plant.md, "Robot", and
docs/reference/onboard.md.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from math import ceil, sqrt
from struct import Struct
from typing import TYPE_CHECKING

from cloudrc.cloud.motion import Body
from cloudrc.config.schema import NotNegative, NotNegatives, Positive
from cloudrc.physics.geometry.vectors import step_towards
from cloudrc.robots.native.library import Library, library
from cloudrc.robots.pelican.low_level import (
    GAIN_D,
    GAIN_I,
    GAIN_P,
    GRAVITY,
    INTEGRAL_LIMIT_XY,
    INTEGRAL_LIMIT_Z,
    MASS,
    ROBOT_GRAVITY,
    ROBOT_MASS,
    TILT_RATE_GAIN,
)
from cloudrc.robots.pelican.rotors import TIME_CONSTANT_DOWN, TIME_CONSTANT_UP
from cloudrc.wire.messages import ZERO, Odometry, Vector
from cloudrc.world.guard.limits import LOW_HEIGHT, LOW_SPEED, SINK_LEAD_MAX

if TYPE_CHECKING:
    from cloudrc.cloud.controllers.pid import Law

STEP = 0.010
"""Longest time step of the model [s]."""
ASSUMED_WEIGHT = MASS * GRAVITY
"""Weight that the onboard controller assumes [N]."""
INERTIA_X, INERTIA_Y = 0.0116, 0.0121
"""Inertia of the whole robot about its centre of mass [kg m^2].
Source: docs/reference/plant.md, "Total inertia"."""
LAG = 0.01875
"""Time constant of a torque: the mean of those of a rising and of a falling thrust [s]."""
DRAG = 0.155
"""Deceleration per velocity across the thrust axis, with the rotors at hover speed [1/s].
Source: docs/reference/plant.md, "Rotor drag"."""
FLOOR_MARGIN = 0.35
"""Height below which the guard does not descend [m]. Source: docs/safety.md, "Limits"."""
THRUST_MAX = 134.9
"""Largest thrust of the four rotors [N]. Source: docs/reference/plant.md, "Rotor speed"."""
CONSTANTS = (
    STEP, ROBOT_MASS, ROBOT_GRAVITY, ASSUMED_WEIGHT, INERTIA_X, INERTIA_Y, LAG, TIME_CONSTANT_UP,
    TIME_CONSTANT_DOWN, DRAG, THRUST_MAX, TILT_RATE_GAIN, FLOOR_MARGIN, LOW_HEIGHT, LOW_SPEED,
    SINK_LEAD_MAX,
)  # fmt: skip
"""The first numbers of the structure `Body` of `robots/native/motion.c`."""
_STATE, _VECTOR = Struct("24d"), Struct("3d")
GAIN_ACCELERATION, GAIN_TORQUE = 0.3, 0.1
"""Rates at which the estimated acceleration and torque follow the errors of a prediction [1/s]. The
rate of the torque falls from 1 to GAIN_TORQUE, because other errors disturb the estimate."""


class WhiteBox(Body):
    """Model of the robot and of its onboard controller, which holds the yaw at 0.

    The body rates turn the axis of the thrust: a unit vector (nx, ny, nz) in the world frame.
    `robots/native/motion.c` advances it under many commands at once, with the same bits.
    """

    def __init__(
        self,
        gains: tuple[float, ...],
        acceleration_max: float,
        native: Library,
        basis: Odometry,
    ) -> None:
        """Start the model in a measured state; assume steady flight, in which thrust equals weight.

        Args:
            gains: P, I, D gains and integral limits of the velocity loop, for x, y, z: shape (12,).
            acceleration_max: The guard's cap on the acceleration [m/s^2].
            native: The compiled `motion.c`, if there is one.
            basis: The measured state.
        """
        self._gains, self._acceleration_max, self._native = gains, acceleration_max, native
        self._fixed = array("d", (*CONSTANTS, *gains, acceleration_max)).tobytes()
        self._reference, self._thrust = basis.velocity, ASSUMED_WEIGHT
        self._integral = self._missed = ZERO  # _missed: acceleration that the model lacks [m/s^2]
        self._age = 0.0  # of the estimates [s]
        self._torque = self._trim = (0.0, 0.0)  # _trim: torque that the model lacks [N m]
        self._take(basis)

    def correct(self, odometry: Odometry) -> None:
        """Adopt measured pose and twist; correct the estimates of acceleration and torque."""
        (ax, ay, az), (vx, vy, vz) = odometry.velocity, self.velocity
        bx, by, bz = self._missed
        k = GAIN_ACCELERATION
        self._missed = (bx + k * (ax - vx), by + k * (ay - vy), bz + k * (az - vz))
        (before_x, before_y), since_ns = self._rate, self.basis.stamp_ns
        self._take(odometry)
        (qx, qy), (cx, cy) = self._rate, self._trim
        self._age += (odometry.stamp_ns - since_ns) * 1e-9
        k = max(GAIN_TORQUE, 1.0 / (1.0 + self._age))
        self._trim = (cx + k * INERTIA_Y * (qx - before_x), cy + k * INERTIA_X * (qy - before_y))

    def _take(self, odometry: Odometry) -> None:
        self.basis, self.horizon = odometry, 0.0
        self.position, self.velocity = odometry.position, odometry.velocity
        w, x, y, z = odometry.orientation_wxyz
        p, q, _ = odometry.angular_velocity_body
        self._axis = (2.0 * (x * z + w * y), 2.0 * (y * z - w * x))
        self._rate = (q, -p)  # of the thrust axis towards x and y

    def advance(self, command: Vector, dt: float) -> None:
        """Advance the state by `dt` [s] under a velocity command [m/s]."""
        steps = ceil(dt / STEP - 1e-9)
        h = dt / steps
        lag, up, down = h / (h + LAG), h / (h + TIME_CONSTANT_UP), h / (h + TIME_CONSTANT_DOWN)
        (x, y, z), (vx, vy, vz), (bx, by, bz) = self.position, self.velocity, self._missed
        (nx, ny), (qx, qy), (tx, ty), (cx, cy) = self._axis, self._rate, self._torque, self._trim
        thrust, last = self._thrust, self._reference
        for _ in range(steps):
            reference = step_towards(last, command, self._acceleration_max * h)
            if z < LOW_HEIGHT or reference[2] < 0.0:
                reference = _limit(reference, last, z, vz)
            # The thrust pushes along its axis, the drag acts across it.
            if (across := nx * nx + ny * ny) > 1.0:
                nx, ny, across = nx / sqrt(across), ny / sqrt(across), 1.0
            nz = sqrt(1.0 - across)
            along = thrust / ROBOT_MASS + DRAG * (vx * nx + vy * ny + vz * nz)
            ax = along * nx - DRAG * vx + bx
            ay = along * ny - DRAG * vy + by
            az = along * nz - DRAG * vz + bz - ROBOT_GRAVITY
            fx, fy, fz = self._force(last, reference, (vx, vy, vz), (ax, ay, az), h)
            last = reference
            # Thrust and torques follow with the lag of the rotors; the torques turn the axis.
            wanted = min(max(fx * nx + fy * ny + fz * nz, 0.0), THRUST_MAX)
            thrust += (wanted - thrust) * (up if wanted > thrust else down)
            size = sqrt(fx * fx + fy * fy + fz * fz) or 1.0
            tx += lag * ((fx * nz - fz * nx) / size - TILT_RATE_GAIN * qx - tx)
            ty += lag * ((fy * nz - fz * ny) / size - TILT_RATE_GAIN * qy - ty)
            qx += h * (tx + cx) / INERTIA_Y
            qy += h * (ty + cy) / INERTIA_X
            nx += h * qx * nz
            ny += h * qy * nz
            x += h * (vx + 0.5 * h * ax)
            y += h * (vy + 0.5 * h * ay)
            z += h * (vz + 0.5 * h * az)
            vx += h * ax
            vy += h * ay
            vz += h * az
        self.position, self.velocity = (x, y, z), (vx, vy, vz)
        self._axis, self._rate, self._torque = (nx, ny), (qx, qy), (tx, ty)
        self._thrust, self._reference = thrust, last

    def replay(self, commands: Iterable[tuple[Vector, float]]) -> None:
        """Advance the state under several commands: velocity [m/s] and duration [s] of each."""
        advance = self._native.advance
        if advance is None:
            super().replay(commands)
            return
        rows = array("d", [number for (x, y, z), dt in commands for number in (x, y, z, dt)])
        body = self._pack()
        advance(_address(body), _address(rows), len(rows) // 4, None)
        self._unpack(body)

    def coast(self, velocity: Vector, dt: float, count: int) -> array[float]:
        """Advance by `dt` [s], `count` times, under one command `velocity` [m/s]."""
        advance = self._native.advance
        if advance is None:
            return super().coast(velocity, dt, count)
        body, states = self._pack(), array("d", bytes(48 * count))
        rows = array("d", (*velocity, dt) * count)
        advance(_address(body), _address(rows), count, _address(states))
        self._unpack(body)
        for _ in range(count):  # a sum, as in Python
            self.horizon += dt
        return states

    def follow(
        self, law: Law, goals: Sequence[bytes], dt: float, velocity: Vector, most: float
    ) -> tuple[list[Vector], list[Vector]] | None:
        """Simulate a flight in which `law` computes the next velocity after each `dt` [s].

        None without C, or if a component of a velocity is above `most` [m/s].
        """
        plan, count = self._native.plan, len(goals)
        if plan is None:
            return None
        body, rows, flown = self._pack(), array("d", b"".join(goals)), array("d", bytes(48 * count))
        gain_p, gain_d, has_derivative = law
        given = array("d", (*gain_p, *gain_d, has_derivative, *velocity, dt, most))
        begin, law_at, goals_at = _address(body), _address(given), _address(rows)
        if plan(begin, law_at, goals_at, count, _address(flown)) < count:
            return None
        vectors = [*_VECTOR.iter_unpack(flown)]
        return vectors[:count], vectors[count:]

    def _pack(self) -> array[float]:
        """Return the numbers of the structure `Body` of `robots/native/motion.c`, in its order."""
        return array("d", self._fixed + _STATE.pack(
            *self._missed, *self._trim, *self._reference, *self._integral,
            self._thrust, *self._torque, *self.position, *self.velocity, *self._axis, *self._rate,
        ))  # fmt: skip

    def _unpack(self, body: array[float]) -> None:
        """Take over the state of a structure `Body`: its last 19 numbers."""
        # fmt: off
        (
            ax, ay, az, bx, by, bz, self._thrust, tx, ty, px, py, pz, vx, vy, vz, nx, ny, qx, qy,
        ) = body[-19:]
        # fmt: on
        self._reference, self._integral, self._torque = (ax, ay, az), (bx, by, bz), (tx, ty)
        self.position, self.velocity = (px, py, pz), (vx, vy, vz)
        self._axis, self._rate = (nx, ny), (qx, qy)

    def _force(
        self, last: Vector, reference: Vector, velocity: Vector, acceleration: Vector, h: float
    ) -> Vector:
        """Compute the force that the onboard PID requests [N]; advance its integral by `h` [s].

        `last` is the previous reference. Source: docs/reference/onboard.md.
        """
        px, py, pz, ix, iy, iz, dx, dy, dz, limit_x, limit_y, limit_z = self._gains
        (rx, ry, rz), (vx, vy, vz), (ax, ay, az) = reference, velocity, acceleration
        last_x, last_y, last_z = last
        ex, ey, ez = rx - vx, ry - vy, rz - vz
        sx, sy, sz = self._integral
        sx += ex * h
        sy += ey * h
        sz += ez * h
        sx = limit_x if sx > limit_x else -limit_x if sx < -limit_x else sx
        sy = limit_y if sy > limit_y else -limit_y if sy < -limit_y else sy
        sz = limit_z if sz > limit_z else -limit_z if sz < -limit_z else sz
        self._integral = (sx, sy, sz)
        return (
            px * ex + ix * sx + dx * ((rx - last_x) / h - ax),
            py * ey + iy * sy + dy * ((ry - last_y) / h - ay),
            pz * ez + iz * sz + dz * ((rz - last_z) / h - az) + ASSUMED_WEIGHT,
        )


def _address(numbers: array[float]) -> int:
    return numbers.buffer_info()[0]


def _limit(reference: Vector, last: Vector, height: float, climb: float) -> Vector:
    """Limit a velocity reference [m/s] near the floor and in a descent, as the guard does.

    `last` is the reference of the last step [m/s]. The robot is at `height` [m] above the floor and
    climbs at `climb` [m/s]. Source: docs/safety.md, "Limits".
    """
    x, y, z = reference
    z = max(z, min(last[2], climb - SINK_LEAD_MAX))
    if z < 0.0:
        room = max(height - FLOOR_MARGIN, 0.0)
        z = max(z, -2.0 * room / (0.2 + sqrt(0.04 + room / 1.5)))
    speed = sqrt(x * x + y * y)
    scale = LOW_SPEED / speed if height < LOW_HEIGHT and speed > LOW_SPEED else 1.0
    return (scale * x, scale * y, z)


def build(
    acceleration_max: Positive,
    gain_p: NotNegatives = GAIN_P,
    gain_i: NotNegatives = GAIN_I,
    gain_d: NotNegatives = GAIN_D,
    integral_limit_xy: NotNegative = INTEGRAL_LIMIT_XY,
    integral_limit_z: NotNegative = INTEGRAL_LIMIT_Z,
) -> Callable[[Odometry], WhiteBox]:
    """Return a function that starts a model in a measured state.

    Args:
        acceleration_max: The guard's cap on the acceleration [m/s^2].
        gain_p: Proportional gain of the onboard velocity loop [N s/m], shape (3,).
        gain_i: Integral gain of the onboard velocity loop [N/m], shape (3,).
        gain_d: Derivative gain of the onboard velocity loop [N s^2/m], shape (3,).
        integral_limit_xy: Limit of the loop's integrated velocity error in x and y [m].
        integral_limit_z: Limit of the loop's integrated velocity error in z [m].
    """
    limits = integral_limit_xy, integral_limit_xy, integral_limit_z
    return partial(WhiteBox, (*gain_p, *gain_i, *gain_d, *limits), acceleration_max, library())
