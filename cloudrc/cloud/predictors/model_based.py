"""Predictor: replay the sent commands through a model of the robot and its onboard controller.

The model contains the guard's limits, the velocity PID, the attitude loop, rotors and drag. The
odometry lacks the velocity reference, the PID's integral, thrust and torque; the model computes
them from the commands that the echoes confirm. Each odometry sample replaces the model's pose and
twist. The predictor estimates effects that the model lacks, such as wind, a payload or the arm's
weight, as a constant acceleration and a constant torque.

Source: docs/reference/control.md, "Predictors", (e2); docs/reference/plant.md, "Robot", "Low-level
controller".
"""

from __future__ import annotations

from copy import copy
from math import ceil, sqrt

from cloudrc.cloud.predictors._history import Body, Replay, approach
from cloudrc.config.schema import NotNegative, NotNegatives, Positive
from cloudrc.messages import ZERO, Odometry, Vector

STEP = 0.010
"""Longest time step of the model [s]."""
MASS, GRAVITY, ASSUMED_WEIGHT = 1.06, 9.8066, 1.05 * 9.81
"""Mass [kg], gravity [m/s^2], and the weight that the onboard controller assumes [N].
Source: docs/reference/plant.md, "Total mass", "Gravity"."""
INERTIA_X, INERTIA_Y = 0.0116, 0.0121
"""Inertia of the whole robot about its centre of mass [kg m^2].
Source: docs/reference/plant.md, "Total inertia"."""
RATE_GAIN = 0.22
"""Torque per angular velocity [N m s]; the torque per attitude error is 1 N m.
Source: docs/reference/plant.md, "Low-level controller"."""
LAG_UP, LAG_DOWN, LAG = 0.0125, 0.025, 0.01875
"""Time constants of a rising thrust, of a falling thrust, and of a torque: the mean of both [s].
Source: docs/reference/plant.md, "Rotor speed"."""
DRAG = 0.155
"""Deceleration per velocity across the thrust axis, with the rotors at hover speed [1/s].
Source: docs/reference/plant.md, "Rotor drag"."""
SINK_LEAD_MAX = 0.5
"""The guard's reference sinks at most this much faster than the robot [m/s].
Source: docs/reference/plant.md, "Sinking"."""
LOW_HEIGHT, LOW_SPEED, FLOOR_MARGIN = 0.25, 1.0, 0.35
"""Below the first height [m] the guard limits the horizontal speed [m/s]; below the second it
refuses to descend. Source: docs/safety.md, "Limits"."""
THRUST_MAX = 134.9
"""Largest thrust of the four rotors [N]. Source: docs/reference/plant.md, "Rotor speed"."""
GAIN_ACCELERATION, GAIN_TORQUE = 0.3, 0.1
"""Rates at which the estimated acceleration and torque follow the errors of a prediction [1/s]. The
rate of the torque falls from 1 to GAIN_TORQUE, because other errors disturb the estimate."""
GAP_NS = 500_000_000
"""Time without odometry after which the model starts again [ns]."""


class WhiteBox(Body):
    """Model of the robot and of its onboard controller, which holds the yaw at 0.

    The body rates turn the axis of the thrust: a unit vector (nx, ny, nz) in the world frame.
    """

    def __init__(self, gains: tuple[float, ...], acceleration_max: float, basis: Odometry) -> None:
        """Start the model in a measured state; assume steady flight, in which thrust equals weight.

        Args:
            gains: P, I, D gains and integral limits of the velocity loop, for x, y, z: shape (12,).
            acceleration_max: The guard's cap on the acceleration [m/s^2].
            basis: The measured state.
        """
        self._gains, self._acceleration_max = gains, acceleration_max
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
        lag, up, down = h / (h + LAG), h / (h + LAG_UP), h / (h + LAG_DOWN)
        (x, y, z), (vx, vy, vz), (bx, by, bz) = self.position, self.velocity, self._missed
        (nx, ny), (qx, qy), (tx, ty), (cx, cy) = self._axis, self._rate, self._torque, self._trim
        thrust, last = self._thrust, self._reference
        for _ in range(steps):
            reference = approach(last, command, self._acceleration_max * h)
            if z < LOW_HEIGHT or reference[2] < 0.0:
                reference = _limit(reference, last, z, vz)
            # The thrust pushes along its axis, the drag acts across it.
            if (across := nx * nx + ny * ny) > 1.0:
                nx, ny, across = nx / sqrt(across), ny / sqrt(across), 1.0
            nz = sqrt(1.0 - across)
            along = thrust / MASS + DRAG * (vx * nx + vy * ny + vz * nz)
            ax = along * nx - DRAG * vx + bx
            ay = along * ny - DRAG * vy + by
            az = along * nz - DRAG * vz + bz - GRAVITY
            fx, fy, fz = self._force(last, reference, (vx, vy, vz), (ax, ay, az), h)
            last = reference
            # Thrust and torques follow with the lag of the rotors; the torques turn the axis.
            wanted = min(max(fx * nx + fy * ny + fz * nz, 0.0), THRUST_MAX)
            thrust += (wanted - thrust) * (up if wanted > thrust else down)
            size = sqrt(fx * fx + fy * fy + fz * fz) or 1.0
            tx += lag * ((fx * nz - fz * nx) / size - RATE_GAIN * qx - tx)
            ty += lag * ((fy * nz - fz * ny) / size - RATE_GAIN * qy - ty)
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

    def _force(
        self, last: Vector, reference: Vector, velocity: Vector, acceleration: Vector, h: float
    ) -> Vector:
        """Compute the force that the onboard PID requests [N]; advance its integral by `h` [s].

        `last` is the previous reference. Source: docs/reference/plant.md, "Low-level controller".
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


class ModelBased(Replay):
    """Simulates `WhiteBox`, a model of the robot, from the newest odometry to the horizon."""

    def __init__(self, gains: tuple[float, ...], acceleration_max: float) -> None:
        """Set the gains of the onboard velocity loop, and `acceleration_max` [m/s^2]."""
        self._loop = gains, acceleration_max
        super().__init__()

    def reset(self) -> None:
        """Forget all samples, commands and echoes."""
        super().reset()
        self._body: WhiteBox | None = None  # at the newest sample

    def forecast(self, stamp_ns: int) -> WhiteBox | None:
        """Predict the model's state at `stamp_ns` [ns]; None without recent odometry or command."""
        body = copy(self._body)
        if body is None or not 0 < stamp_ns - body.basis.stamp_ns < GAP_NS:
            return None
        if self.history.is_silent(stamp_ns):  # the guard holds the robot
            return None
        for velocity, duration in self.history.past(body.basis.stamp_ns, stamp_ns):
            body.advance(velocity, duration)
        return body

    def observe(self, odometry: Odometry) -> None:
        """Correct the `WhiteBox`, the model of the robot, with a new odometry sample."""
        super().observe(odometry)
        self._body = self.forecast(odometry.stamp_ns) or WhiteBox(*self._loop, odometry)
        self._body.correct(odometry)

    def roll(self, odometry: Odometry, horizon: float) -> WhiteBox:
        """Return the model in its predicted state, `horizon` [s] after the sample `odometry`."""
        if self._body is None or self._body.basis.stamp_ns != odometry.stamp_ns:
            self.observe(odometry)
        assert self._body is not None
        body = copy(self._body)
        start_ns, shift_ns = odometry.stamp_ns, self.history.shift_ns(odometry, horizon)
        end_ns = start_ns + round(horizon * 1e9)
        for velocity, duration in self.history.ahead(start_ns, end_ns, shift_ns):
            body.advance(velocity, duration)
        body.horizon = horizon
        return body


def build(
    gain_p: NotNegatives = (4.0, 4.0, 10.0),
    gain_i: NotNegatives = (1.0, 1.0, 2.5),
    gain_d: NotNegatives = (0.30, 0.30, 0.50),
    integral_limit_xy: NotNegative = 0.10,
    integral_limit_z: NotNegative = 0.40,
    acceleration_max: Positive = 12.0,
) -> ModelBased:
    """Make the predictor; the defaults are those of `world.onboard` and `guard`.

    Args:
        gain_p: Proportional gain of the onboard velocity loop [N s/m], shape (3,).
        gain_i: Integral gain of the onboard velocity loop [N/m], shape (3,).
        gain_d: Derivative gain of the onboard velocity loop [N s^2/m], shape (3,).
        integral_limit_xy: Limit of the loop's integrated velocity error in x and y [m].
        integral_limit_z: Limit of the loop's integrated velocity error in z [m].
        acceleration_max: The guard's cap on the acceleration [m/s^2].
    """
    limits = integral_limit_xy, integral_limit_xy, integral_limit_z
    return ModelBased((*gain_p, *gain_i, *gain_d, *limits), acceleration_max)
