"""The PID controller by hand-worked numbers."""

from math import pi

import pytest

from cloudrc.cloud.controllers import pid
from cloudrc.messages import UPRIGHT, ZERO, Odometry, Setpoint

DT = 0.01


def at(position, velocity=ZERO, orientation_wxyz=UPRIGHT):
    return Odometry(0, position, orientation_wxyz, velocity, ZERO)


def x(value):
    return (value, 0.0, 0.0)


def test_published_gains_pull_towards_the_setpoint():
    output = pid.build().update(at((1.0, 2.0, 3.0), velocity=(9.0, 9.0, 9.0)), Setpoint(ZERO), DT)
    assert output.velocity == pytest.approx((-0.8, -1.6, -4.5))
    assert output.proportional == output.velocity
    assert output.integral == output.derivative == ZERO
    assert output.yaw_rate == 0.0


def test_gains_may_be_lists_as_they_come_from_yaml():
    output = pid.build(gain_p=[1, 2, 3]).update(at(ZERO), Setpoint((1.0, 1.0, 1.0)), DT)
    assert output.velocity == (1.0, 2.0, 3.0)


def test_derivative_brakes_the_measured_velocity():
    controller = pid.build(gain_d=(0.5, 0.5, 0.0))
    output = controller.update(at(ZERO, velocity=(2.0, -1.0, 3.0)), Setpoint(ZERO), DT)
    assert output.derivative == pytest.approx((-1.0, 0.5, 0.0))
    assert output.velocity == pytest.approx((-1.0, 0.5, 0.0))


def test_a_step_of_the_setpoint_causes_no_derivative_kick():
    controller = pid.build(gain_p=(1.0, 1.0, 1.0), gain_d=(0.5, 0.5, 0.5))
    moving = at(ZERO, velocity=x(2.0))
    before = controller.update(moving, Setpoint(ZERO), DT)
    after = controller.update(moving, Setpoint(x(10.0)), DT)
    assert after.derivative == before.derivative
    assert after.velocity[0] - before.velocity[0] == pytest.approx(10.0)


def test_integral_is_gain_times_error_times_time():
    controller = pid.build(gain_p=ZERO, gain_i=(0.5, 0.5, 0.5))
    for _ in range(100):
        controller.update(at(ZERO), Setpoint((0.2, 0.0, -0.4)), DT)
    output = controller.update(at(ZERO), Setpoint(ZERO), DT)
    assert output.integral == pytest.approx((0.1, 0.0, -0.2))  # .5 * .2 m * 1 s
    assert output.velocity == output.integral


def test_integral_limit_bounds_the_term():
    controller = pid.build(gain_i=(1.0, 1.0, 1.0), integral_limit=(0.05, 0.1, 0.2))
    for _ in range(200):
        output = controller.update(at(ZERO), Setpoint((1.0, -1.0, 0.05)), DT)
    assert output.integral == pytest.approx((0.05, -0.1, 0.0995))


def test_reset_empties_the_integral():
    controller = pid.build(gain_i=(1.0, 1.0, 1.0))
    controller.update(at(ZERO), Setpoint(x(1.0)), DT)
    controller.reset()
    assert controller.update(at(ZERO), Setpoint(x(1.0)), DT).integral == ZERO


def test_only_a_saturated_axis_stops_integrating():
    controller = pid.build(
        gain_p=(1.0, 1.0, 1.0), gain_i=(1.0, 1.0, 1.0), velocity_max=(1.0, 1.0, 1.0)
    )
    for _ in range(1000):
        output = controller.update(at(ZERO), Setpoint((10.0, 0.05, 0.0)), DT)
    assert output.velocity[0] == 1.0
    assert output.integral == pytest.approx((0.0, 0.4995, 0.0))


def test_a_saturated_axis_integrates_an_opposite_error():
    controller = pid.build(
        gain_p=(1.0, 1.0, 1.0),
        gain_i=(1.0, 1.0, 1.0),
        gain_d=(1.0, 1.0, 1.0),
        velocity_max=(0.5, 0.5, 0.5),
    )
    # The derivative saturates upwards while the error points down.
    falling = at(x(1.0), velocity=x(-5.0))
    for _ in range(10):
        output = controller.update(falling, Setpoint(ZERO), DT)
    assert output.velocity[0] == 0.5
    assert output.integral[0] == pytest.approx(-0.09)


@pytest.mark.parametrize("limit", [{"speed_max": 1.0}, {"velocity_max": (1.0, 1.0, 1.0)}])
def test_saturation_causes_no_overshoot_by_windup(limit):
    controller = pid.build(gain_p=(1.0, 1.0, 1.0), gain_i=(0.2, 0.2, 0.2), **limit)
    position, highest = 0.0, 0.0
    for _ in range(4000):
        output = controller.update(at(x(position)), Setpoint(x(10.0)), DT)
        position += output.velocity[0] * DT
        highest = max(highest, position)
    # Without anti-windup the integral would reach 9 m/s in 9 s: an overshoot of metres.
    assert highest < 10.3
    assert position == pytest.approx(10.0, abs=0.01)


def test_speed_max_shortens_the_vector_and_keeps_its_direction():
    controller = pid.build(gain_p=(1.0, 1.0, 1.0), speed_max=2.0)
    output = controller.update(at(ZERO), Setpoint((3.0, 0.0, -4.0)), DT)
    assert output.velocity == pytest.approx((1.2, 0.0, -1.6))
    assert output.proportional == (3.0, 0.0, -4.0)


def test_velocity_max_clamps_each_axis():
    controller = pid.build(gain_p=(1.0, 1.0, 1.0), velocity_max=(1.0, 2.0, 0.5))
    output = controller.update(at(ZERO), Setpoint((3.0, 1.5, -4.0)), DT)
    assert output.velocity == (1.0, 1.5, -0.5)


def test_yaw_turns_the_short_way_round():
    # Heading 170 deg, wanted -170 deg: 20 deg to the left, not 340 to the right.
    heading = at(ZERO, orientation_wxyz=(0.08715574274765817, 0.0, 0.0, 0.9961946980917455))
    setpoint = Setpoint(ZERO, yaw=-170 * pi / 180)
    output = pid.build(gain_yaw=2.0).update(heading, setpoint, DT)
    assert output.yaw_rate == pytest.approx(2.0 * 20 * pi / 180)


def test_a_limit_does_not_turn_nan_into_full_speed():
    controller = pid.build(velocity_max=(1.0, 1.0, 1.0), gain_i=(1.0, 1.0, 1.0))
    output = controller.update(at(x(float("nan"))), Setpoint(ZERO), DT)
    assert output.velocity[0] != output.velocity[0]
    assert controller.update(at(ZERO), Setpoint(ZERO), DT).velocity == ZERO


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"gain_p": (0.8, -0.8, 1.5)}, r"gain_p\[y\]: -0.8 .*not negative"),
        ({"gain_i": (0.0, 0.0, float("nan"))}, r"gain_i\[z\]: nan .*finite"),
        ({"gain_d": (0.5, 0.5)}, r"gain_d: \(0.5, 0.5\) .*three numbers"),
        ({"gain_p": 0.8}, r"gain_p: 0.8 .*three numbers"),
        ({"gain_p": "abc"}, r"gain_p: 'abc' .*three numbers"),
        ({"gain_p": ["a", 1, 1]}, r"gain_p\[x\]: 'a' is not a number"),
        ({"gain_yaw": float("inf")}, r"gain_yaw: inf .*finite"),
        ({"integral_limit": (-1, 1, 1)}, r"integral_limit\[x\]: -1"),
        ({"velocity_max": (1, 1)}, r"velocity_max: "),
        ({"speed_max": -2.0}, r"speed_max: -2.0 .*not negative"),
        ({"speed_max": True}, r"speed_max: True is not a number"),
    ],
)
def test_an_invalid_parameter_is_named_with_value_and_reason(parameters, message):
    with pytest.raises(ValueError, match=rf"^{message}"):
        pid.build(**parameters)
