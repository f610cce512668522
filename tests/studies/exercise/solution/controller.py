"""Controller: eqs. (4) and (5) of the paper, with the sign that converges and with a limit."""

import numpy as np

from cloudrc.plugin import ZERO, Controller, ControlOutput, Vector


class StudentController(Controller):
    def __init__(self, gain_p, gain_i, gain_d, velocity_max):
        self.gains, self.velocity_max = np.array([gain_p, gain_i, gain_d]), velocity_max
        self.reset()

    def reset(self):
        self.integral, self.last = np.zeros(3), None

    def update(self, estimate, setpoint, dt):
        error = np.subtract(setpoint.position, estimate.position)
        rate = np.zeros(3) if self.last is None else (error - self.last) / dt
        self.integral, self.last = self.integral + error * dt, error
        limit = np.array(self.velocity_max)
        u = (self.gains * [error, self.integral, rate]).sum(axis=0)
        return ControlOutput(tuple(np.clip(u, -limit, limit)), 0.0)


def build(
    gain_p: Vector = (0.8, 0.8, 1.5),
    gain_i: Vector = ZERO,
    gain_d: Vector = ZERO,
    velocity_max: Vector = (6.0, 6.0, 6.0),
) -> StudentController:
    return StudentController(gain_p, gain_i, gain_d, velocity_max)
