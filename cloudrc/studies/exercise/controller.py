# SPDX-License-Identifier: Apache-2.0

"""Controller, part 3 of the exercise: a PID controller for each of x, y and z.

    e = setpoint - estimate      eq. (4), but with the sign that converges
    u = P e + I (integral of e over time) + D (derivative of e)      eq. (5)

Unlike the paper, limit each component of u to +-velocity_max.

Source: the paper, eqs. (4) and (5).
"""

from cloudrc.plugin import ZERO, Controller, ControlOutput, Odometry, Setpoint, Vector


class StudentController(Controller):
    """Computes a velocity command from the predicted position."""

    def __init__(self, p: Vector, i: Vector, d: Vector, velocity_max: Vector) -> None:
        """Set gains `p` [1/s], `i` [1/s^2], `d` [1] and limit `velocity_max` [m/s], per axis."""
        self.p, self.i, self.d, self.velocity_max = p, i, d, velocity_max

    def reset(self) -> None:
        """Forget the integral and everything else: a new mission begins."""

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Return the velocity command u [m/s]; `dt` is the time since the last call [s]."""
        return ControlOutput(velocity=ZERO, yaw_rate=0.0)  # Your code: eqs. (4) and (5).


def build(
    gain_p: Vector = (0.8, 0.8, 1.5),
    gain_i: Vector = ZERO,
    gain_d: Vector = ZERO,
    velocity_max: Vector = (6.0, 6.0, 6.0),
) -> StudentController:
    """Make a controller of `gain_p` [1/s], `gain_i` [1/s^2], `gain_d` [1], `velocity_max` [m/s].

    The default gains are those that the paper's authors published. The default of `velocity_max`
    is so high that the robot hardly ever reaches it.
    """
    return StudentController(gain_p, gain_i, gain_d, velocity_max)
