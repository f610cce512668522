# SPDX-License-Identifier: Apache-2.0

"""The PID controller by hand-worked numbers."""

import pytest

from cloudrc.cloud.controllers import pid
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry, Setpoint

DT = 0.01
ONES = (1.0, 1.0, 1.0)


def x(value):
    return (value, 0.0, 0.0)


def fly(controller, position=ZERO, wanted=ZERO, velocity=ZERO, times=1):
    for _ in range(times):
        output = controller.update(
            Odometry(0, position, UPRIGHT, velocity, ZERO), Setpoint(wanted), DT
        )
    return output


def test_published_gains_pull_towards_the_setpoint():
    output = fly(pid.build(), (1.0, 2.0, 3.0), velocity=(9.0, 9.0, 9.0))
    assert output == (pytest.approx((-0.8, -1.6, -4.5)), 0.0, output.velocity, ZERO, ZERO)


def test_integral_and_derivative_follow_the_equation():
    controller = pid.build(
        gain_p=[1, 1, 1], gain_i=(0.5,) * 3, gain_d=(0.5, 0.5, 0), integral_limit=(1, 1, 0.15)
    )
    fly(controller, wanted=(0.2, 0.0, -0.4), times=100)
    for jump in (0.0, 10.0):  # the derivative of the velocity has no kick
        output = fly(controller, wanted=x(jump), velocity=(2.0, -1.0, 3.0))
        assert output.integral == pytest.approx((0.1, 0.0, -0.15))  # .5 * .2 m * 1 s
        assert output.derivative == pytest.approx((-1.0, 0.5, 0.0))
        assert output.velocity == pytest.approx((jump + 0.1 - 1.0, 0.5, -0.15))
    controller.reset()
    assert fly(controller, wanted=ONES).integral == ZERO


def test_the_velocity_of_the_setpoint_is_fed_forward():
    controller = pid.build(gain_p=ONES, gain_d=(0.5, 0.5, 0.0), velocity_max=(9.0, 2.0, 9.0))
    estimate = Odometry(0, (1.0, 0.0, 0.0), UPRIGHT, (1.0, 0.0, 1.0), ZERO)
    output = controller.update(estimate, Setpoint((2.0, 0.0, 0.0), velocity=(2.0, 3.0, 0.5)), DT)
    assert output.derivative == (0.5, 1.5, 0.0)
    assert output.velocity == (1.0 + 0.5 + 2.0, 2.0, 0.5)
    # With the published gains, too.
    output = pid.build().update(estimate, Setpoint((2.0, 0.0, 0.0), velocity=(2.0, 0.0, 0.0)), DT)
    assert output.velocity == (2.8, 0.0, 0.0)


def test_only_a_saturated_axis_integrates_in_one_direction():
    controller = pid.build(gain_p=ONES, gain_i=ONES, gain_d=ONES, velocity_max=ONES)
    output = fly(controller, wanted=(10.0, 0.05, 0.0), times=1000)
    assert output.velocity[0] == 1.0
    assert output.integral == pytest.approx((0.0, 0.4995, 0.0))
    # The derivative saturates upwards while the error points down.
    output = fly(controller, x(1.0), velocity=x(-5.0), times=10)
    assert output.velocity[0] == 1.0
    assert output.integral[0] == pytest.approx(-0.09)


@pytest.mark.parametrize(
    ("limit", "velocity"),
    [({"speed_max": 2.0}, (1.2, 0.0, -1.6)), ({"velocity_max": (1.0, 2.0, 0.5)}, (1.0, 0.0, -0.5))],
)
def test_limits_shorten_the_vector_or_clamp_each_axis(limit, velocity):
    output = fly(pid.build(gain_p=ONES, **limit), wanted=(3.0, 0.0, -4.0))
    assert output.velocity == pytest.approx(velocity)
    assert output.proportional == (3.0, 0.0, -4.0)


def test_without_a_gain_the_yaw_turns_only_to_a_waypoint_with_a_yaw():
    heading = Odometry(0, ZERO, UPRIGHT, ZERO, ZERO)
    wanted = Setpoint(ZERO, yaw=0.5)
    rates = [
        pid.build(**gain).update(heading, wanted._replace(turns=turns), DT).yaw_rate
        for gain in ({}, {"gain_yaw": 2.0}, {"gain_yaw": 0.0})
        for turns in (False, True)
    ]
    assert rates == pytest.approx([0.0, 0.4, 1.0, 1.0, 0.0, 0.0])
