"""Controller of a user: P with a limit; or one that raises near the setpoint."""

from math import hypot

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.messages import Odometry, Setpoint


class Straight(Controller):
    def __init__(self, fails: bool) -> None:
        self.fails = fails

    def update(self, estimate: Odometry, setpoint: Setpoint, dt: float) -> ControlOutput:
        error = [s - p for s, p in zip(setpoint.position, estimate.position, strict=True)]
        gain = min(0.8, 1.0 / max(hypot(*error), 1e-9))
        if self.fails and hypot(*error) < 0.3:
            raise ValueError("the controller of the net")
        x, y, z = (gain * e for e in error)
        return ControlOutput(velocity=(x, y, z), yaw_rate=0.0)


def build(fails: bool = False) -> Straight:
    return Straight(fails)
