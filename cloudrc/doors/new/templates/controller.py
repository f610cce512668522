# SPDX-License-Identifier: Apache-2.0

"""Controller: flies straight to the setpoint, slower near it.

Positions are in m, velocities in m/s, angles in rad; all vectors are in the world frame.
Source: proportional control, u = k (setpoint - position), with a limit of the speed.
"""

from math import hypot

from cloudrc.plugin import Controller, ControlOutput, Odometry, Setpoint


class Proportional(Controller):
    """Commands a velocity in proportion to the distance: `gain` [1/s], at most `speed` [m/s]."""

    def __init__(self, gain: float, speed: float) -> None:
        self.gain, self.speed = gain, speed

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        """Return one command; `dt` [s] is the time since the last one."""
        error = [s - p for s, p in zip(setpoint.position, estimate.position, strict=True)]
        gain = min(self.gain, self.speed / max(hypot(*error), 1e-9))
        x, y, z = (gain * e + v for e, v in zip(error, setpoint.velocity, strict=True))
        return ControlOutput((x, y, z), yaw_rate=0.0)


def build(gain: float = 0.8, speed: float = 1.0) -> Proportional:
    """Return the controller; `gain` [1/s] and `speed` [m/s] are parameters of the experiment."""
    return Proportional(gain, speed)
