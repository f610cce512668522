"""The equations of the low-level controller give the hand-calculated numbers."""

from math import cos, radians, sin

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from cloudrc.config.schema import World
from cloudrc.config.shipped import file_of
from cloudrc.errors import BadInputError
from cloudrc.messages import UPRIGHT, ZERO
from cloudrc.robots.build import check_robot
from cloudrc.robots.pelican.low_level import (
    NOSE_COSINE_MIN,
    YAW_SINE_MAX,
    LowLevel,
    allocate,
    attitude,
)
from cloudrc.sim.readings import Readings
from tests.world.conftest import normalised

WEIGHT = 10.3005  # 1.05 kg * 9.81 m/s^2
KF = 9.9865e-6


def turned(orientation, rate=ZERO):
    return Readings.of((*ZERO, *orientation), (*ZERO, *rate))


AT_REST = turned(UPRIGHT)


def test_the_force_carries_the_mass_and_opposes_the_error():
    # 10.3005 / 4 = 2.575125 N; / 9.9865e-6 = 257860.6; root 507.80.
    assert LowLevel().update(AT_REST, ZERO) == pytest.approx((507.80,) * 4, abs=0.005)
    # e = v - v_ref = (.1, -.1, .1): P = 4, 4, 10 times; the integral after 2 ms is .0002.
    force = LowLevel().force((0.1, 0.1, 0.3), (0.0, 0.2, 0.2))
    assert force == pytest.approx((-0.4002, 0.4002, WEIGHT - 1.0005))
    assert LowLevel(dt=0.01).force((0.1, 0.0, 0.0), ZERO)[0] == pytest.approx(-0.401)


def test_the_derivative_is_that_of_the_error():
    # A reference that jumps by .1 m/s within 2 ms: .3 * .1 / .002 = 15 N, .5 * .1 / .002 = 25 N.
    low_level = LowLevel(gain_p=ZERO, gain_i=ZERO)
    assert low_level.force((0.1, 0.1, 0.1), (0.1, 0.0, 0.0)) == pytest.approx((0, 0, WEIGHT))
    assert low_level.force((0.1, 0.1, 0.1), (0.2, 0.0, 0.1)) == pytest.approx((15, 0, WEIGHT + 25))


def test_the_integral_force_in_x_and_y_is_limited():
    low_level = LowLevel(integral_limit_xy=0.3)
    for _ in range(1000):  # 2 s of 1 m/s would integrate to 2 m
        low_level.force((-1.0, 1.0, -1.0), ZERO)
    low_level.force(ZERO, ZERO)
    assert low_level.force(ZERO, ZERO) == pytest.approx((0.3, -0.3, WEIGHT + 2.5 * 0.40))


def test_a_forward_force_pitches_down_and_rates_are_damped():
    # Wanted tilt atan(3/4) about +y, so e_R = -sin = -.6; thrust is the force's part along z.
    assert attitude((3.0, 0.0, 4.0), AT_REST) == pytest.approx((4.0, 0, 0.6, 0))
    spinning = turned(UPRIGHT, (1.0, 2.0, 3.0))
    assert attitude((0.0, 0.0, 10.0), spinning) == pytest.approx((10.0, -0.22, -0.44, -0.03))


unit = st.floats(-1.0, 1.0)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(
    force=st.tuples(unit, unit, st.floats(0.2, 2.0)),
    quaternion=st.tuples(*[unit] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)
def test_attitude_is_the_matrix_formula(force, quaternion):
    orientation, rotation = normalised(quaternion)
    z_d = np.array(force) / np.linalg.norm(force)
    y_d = np.cross(z_d, (1.0, 0.0, 0.0))
    y_d /= np.linalg.norm(y_d)
    error = np.column_stack([np.cross(y_d, z_d), y_d, z_d]).T @ rotation
    assume(error[1, 1] > NOSE_COSINE_MIN and abs(rotation[1, 0]) < YAW_SINE_MAX)
    error = 0.5 * (error - error.T)
    thrust, *torque = attitude(force, turned(orientation))
    assert thrust == pytest.approx(np.dot(force, rotation[:, 2]), abs=1e-9)
    assert torque == pytest.approx([-error[2, 1], -error[0, 2], -0.035 * error[1, 0]], abs=1e-9)


@pytest.mark.parametrize("yaw", [18.0, -60.0, 135.0, 180.0])
def test_after_a_hit_the_turned_robot_tilts_the_right_way(yaw):
    """In the world frame the torque turns the thrust towards the force: e_z x z_d."""
    half = radians(yaw) / 2
    readings = turned((cos(half), 0.0, 0.0, sin(half)))
    _, roll, pitch, _ = attitude((3.0, 0.0, 4.0), readings)
    turn = np.array(readings.axes[:3]) * roll + np.array(readings.axes[3:6]) * pitch
    assert turn[:2] == pytest.approx([0.0, 0.6], abs=1e-9)


def test_while_braking_the_integral_is_frozen():
    law, fresh = LowLevel(), LowLevel()
    moving = AT_REST._replace(velocity=(1.0, 0.0, 0.0))
    for _ in range(50):
        law.brake(moving, ZERO)
    fresh.brake(moving, ZERO)
    assert law.brake(moving, ZERO) == fresh.brake(moving, ZERO)


small = st.floats(-0.1, 0.1)


@settings(max_examples=30, deadline=None)
@given(thrust=st.floats(6.0, 20.0), roll=small, pitch=small, yaw=st.floats(-0.02, 0.02))
def test_allocation_gives_thrust_and_torque(thrust, roll, pitch, yaw):
    front, left, back, right = (KF * w * w for w in allocate((thrust, roll, pitch, yaw)))
    # r x F for rotors at (.21, 0), (0, .21), (-.21, 0), (0, -.21) that push up.
    assert front + left + back + right == pytest.approx(thrust)
    assert 0.21 * (left - right) == pytest.approx(roll, abs=1e-12)
    assert -0.21 * (front - back) == pytest.approx(pitch, abs=1e-12)
    assert 0.016 * (front - left + back - right) == pytest.approx(yaw, abs=1e-12)


@pytest.mark.parametrize(("thrust", "speed"), [(-5.0, 0.0), (0.0, 0.0), (200.0, 1838.0)])
def test_rotor_speeds_stay_within_their_range(thrust, speed):
    assert allocate((thrust, *ZERO)) == (speed,) * 4


def test_a_scene_with_air_is_for_other_robots(tmp_path):
    """The rotors would count the drag twice."""
    scene = tmp_path / "air.xml"
    scene.write_text(file_of("empty").read_text().replace("<option ", '<option density="1.2" '))
    check_robot(World(scene=str(scene), robot="x2"))
    with pytest.raises(BadInputError, match="the rotors of this robot have a drag of their own"):
        check_robot(World(scene=str(scene)))
