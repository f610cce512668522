# SPDX-License-Identifier: Apache-2.0

"""A controller steers a robot on the ground in the plane; a vertical velocity is refused."""

import pytest

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.controllers.pid import build
from cloudrc.cloud.planar import Planar
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry, Setpoint

SEEN = Odometry(0, (0.0, 0.0, 0.0993), UPRIGHT, (0.2, 0.0, 0.004), ZERO)
GOAL = Setpoint((1.0, 2.0, 0.1), velocity=(0.5, 0.0, 1e-5))


class Climbing(Controller):
    """Commands a vertical velocity."""

    def __init__(self, z):
        self.z = z

    def update(self, estimate, setpoint, dt):
        return ControlOutput((0.5, 0.0, self.z), 0.0)


def steer(controller):
    return Planar(controller, "/mine/climb.py").update(SEEN, GOAL, 0.01)


def test_the_pid_plans_in_the_plane_and_its_limits_count_there():
    gains = {"gain_p": (1.0, 1.0, 9.0), "gain_i": (0.1,) * 3, "gain_d": (0.1,) * 3}
    output = steer(build(**gains))
    assert output.velocity == pytest.approx((1.53, 2.0, 0.0))
    assert output.proportional == (1.0, 2.0, 0.0)
    assert steer(build(**gains, speed_max=1.0)).velocity[2] == 0.0


def test_a_vertical_velocity_is_refused_with_file_and_value():
    with pytest.raises(InvalidValueError, match=r"^/mine/climb.py: its velocity in z is -0.3 m/s,"):
        steer(Climbing(-0.3))
    assert steer(Climbing(1e-12)).velocity == (0.5, 0.0, 0.0), "a rounding error"
