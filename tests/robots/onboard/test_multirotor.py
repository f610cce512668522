# SPDX-License-Identifier: Apache-2.0

"""One controller flies multirotors of any size and layout; how well, and how it saturates."""

import numpy as np
import pytest

from cloudrc.robots.onboard import multirotor
from tests.conftest import nightly
from tests.robots.onboard.conftest import (
    DT,
    SKEW,
    Flight,
    X,
    big,
    compiled,
    hexarotor,
    nano,
    one_site,
    robot,
    x_layout,
)

HEAVIER = robot(x_layout(0.14, 0.17, 0.02, 8.0), 1.69, ".039 .0325 .065")
BARE = {"mass": 1.3, "inertia": ".03 .025 .05"}


def permuted(order, spin):
    corners = [X[number] for number in order]
    return robot(x_layout(0.14, 0.17, 0.02 * spin, 8.0, corners), **BARE)


LAG = 'dyntype="filterexact" dynprm=".02"'
PLANTS = {
    **{"big": big(), "nano": nano(), "hexarotor": hexarotor(), "one site": one_site()},
    "30 % heavier than known": HEAVIER,
    "other order": permuted((2, 0, 3, 1), 1),
    "other spin directions": permuted((0, 1, 2, 3), -1),
    "other centre of mass": big(centre=".03 -.02 -.04"),
    "centre of mass unknown": big(centre=".01 -.01 -.03"),
    "lag": robot(x_layout(0.14, 0.17, 0.02, 8.0, more=LAG), **BARE),
    "products of inertia": SKEW,
    "unlimited": big().replace('ctrllimited="true"', 'ctrllimited="false"'),
    "a second body": big(base='<body pos="0 0 .1"><geom size=".02" mass=".3"/></body>'),
}
KNOWN = dict.fromkeys(("30 % heavier than known", "centre of mass unknown"), big())
"""Name of a plant -> the model that its controller knows, if it is another one."""


NIGHTLY = [
    *("big", "a second body", "products of inertia", "other centre of mass"),
    *("other order", "other spin directions", "centre of mass unknown", "unlimited"),
]
"""Layouts of which test_allocation and test_airframe find a fault, too."""


@pytest.fixture(params=sorted(PLANTS.keys() - NIGHTLY) + nightly(*NIGHTLY), name="flight")
def _flight(request):
    return Flight(PLANTS[request.param], KNOWN.get(request.param))


def test_it_hovers(flight):
    flight.fly(3.0)
    assert flight.speed < 0.005
    assert flight.data.qpos[:3] == pytest.approx((0.0, 0.0, 2.0), abs=0.2)


def test_it_follows_steps_of_the_velocity_on_each_axis(flight):
    flight.fly(2.0)
    for axis in range(3):
        step = np.eye(3)[axis]
        velocities = flight.fly(3.0, tuple(step))
        settled = velocities[round(1.5 / DT) :]
        assert np.abs(settled - step).max() < 0.05
        assert velocities[:, axis].max() < 1.1
        flight.fly(2.0)
        assert flight.speed < 0.02
    assert flight.tilt < 35.5


def test_it_obeys_a_yaw_rate_while_it_translates(flight):
    flight.fly(1.0)
    start = flight.yaw
    velocities = flight.fly(4.0, (1.0, -0.5, 0.2), 0.5)
    assert np.angle(np.exp(1j * (flight.yaw - start))) == pytest.approx(2.0, abs=0.02)
    assert velocities[-1] == pytest.approx((1.0, -0.5, 0.2), abs=0.05)


def test_it_brakes_within_the_distance_that_the_guard_assumes(flight):
    for speed in (2.0, 0.5):
        flight.fly(3.0, (speed, 0.0, 0.0))
        start = flight.data.qpos[0]
        flight.fly(3.0, brake=True)
        assert flight.speed < 0.05
        assert flight.data.qpos[0] - start < 0.6 * speed + speed**2 / 6.0


def test_saturation_does_not_turn_it_over(flight):
    flight.fly(0.5)
    for velocity in ((9.0, 9.0, 9.0), (-9.0, 9.0, -9.0), (9.0, -9.0, 9.0)):
        flight.fly(1.5, velocity, 3.0)
    assert flight.tilt < 40.0
    flight.fly(5.0)
    assert flight.speed < 0.02


def test_it_rights_itself_from_upside_down():
    flight = Flight(big().replace('pos="0 0 2"', 'pos="0 0 2" euler="180 0 0"'))
    flight.fly(3.0)
    assert flight.readings.axes[8] > 0.999
    assert flight.speed < 0.05


def test_braking_keeps_the_integral_and_the_yaw():
    flight = Flight(HEAVIER, big())
    flight.fly(3.0)
    flight.fly(1.0, (0.0, 0.0, 0.0), 0.5)
    yaw, held = flight.yaw, Flight(HEAVIER, big())
    flight.fly(2.0, (1.0, 0.0, 0.0), brake=True)
    assert flight.yaw == pytest.approx(yaw, abs=0.02)
    # Without an integral, the robot that is heavier than known sinks for as long as it brakes.
    held.fly(3.0, brake=True)
    assert held.data.qvel[2] < -0.1


def test_update_and_brake_never_return_the_object_that_means_stopped():
    flight = Flight(big())
    assert flight.onboard.stopped == (0.0, 0.0, 0.0, 0.0)
    assert flight.onboard.update(flight.readings, (0, 0, -9.0), 0.0) is not flight.onboard.stopped
    idle = big().replace('ctrlrange="0 8.0"', 'ctrlrange="1 8"')
    assert Flight(idle).onboard.stopped == (1.0, 1.0, 1.0, 1.0)


def test_a_velocity_out_of_reach_winds_nothing_up():
    flight = Flight(big(), tilt_max_deg=5.0, drag=0.1)  # at most .86 m/s^2, .86 m/s
    flight.fly(8.0, (9.0, 0.0, 0.0))
    assert flight.speed == pytest.approx(0.86, abs=0.1)
    velocities = flight.fly(4.0)
    assert velocities[round(1.5 / DT), 0] < 0.25
    assert velocities[:, 0].min() > -0.15
    weak = Flight(*[text.replace('"0 8.0"', '"0 4.4"') for text in (HEAVIER, big())])
    weak.fly(4.0, (0.0, 0.0, 9.0))  # it climbs by .6 m/s^2 at most
    height = weak.data.qpos[2]
    weak.fly(3.0)
    assert weak.speed < 0.05
    assert weak.data.qpos[2] - height < 1.1


def test_the_tilt_limit_and_the_bandwidths_are_parameters():
    times = []
    for bandwidth in (2.0, 5.0):
        flight = Flight(nano(), velocity_bandwidth_radps=bandwidth)
        velocities = flight.fly(3.0, (1.0, 0.0, 0.0))
        times.append(np.argmax(velocities[:, 0] > 1.0 - np.exp(-1.0)) * DT)
    assert times == [pytest.approx(0.6, abs=0.05), pytest.approx(0.3, abs=0.05)]
    gentle = Flight(nano(), tilt_max_deg=10.0)
    gentle.fly(2.0, (9.0, 0.0, 0.0))
    assert 7.0 < gentle.tilt < 10.1


def test_a_robot_that_turns_only_with_its_roll_flies_with_its_yaw_left_alone():
    corners = [(x, y, np.sign(-y)) for x, y, _ in X]  # as published models have it
    text = robot(x_layout(0.14, 0.17, 0.02, 8.0, corners), **BARE)
    flight = Flight(text, yaw_bandwidth_radps=0.0)
    for velocity in ((1.0, -1.0, 0.5), (9.0, 9.0, 9.0), (-1.0, 1.0, -0.5)):
        velocities = flight.fly(4.0, velocity, 0.5)
    assert velocities[-1] == pytest.approx((-1.0, 1.0, -0.5), abs=0.02)
    assert abs(flight.yaw) < 0.3
    assert flight.tilt < 36.0


def test_drag_slows_the_hubs_across_the_axes_of_their_rotors():
    rotors = multirotor.actuators(compiled(big()), DT, drag_s_per_m=0.02)
    flight = Flight(big())
    flight.data.qvel[:] = (1.0, 0.0, 3.0, 0.0, 0.0, 2.0)
    *thrusts, fx, fy, fz, tx, ty, tz = rotors.step((1.0, 2.0, 3.0, 2.0), flight.readings)
    assert thrusts == [1.0, 2.0, 3.0, 2.0]
    assert fz == pytest.approx(0.0)
    # Hubs at (.14, -.17), (.14, .17), (-.14, .17), (-.14, -.17) m, with 1, 2, 3, 2 N.
    assert (fx, fy) == pytest.approx((-0.02 * (8.0 - 2.0 * 0.17 * 2.0), 0.02 * 2.0 * 0.14 * 2.0))
    assert (tx, ty) == pytest.approx((0.0, 0.0))
    assert tz == pytest.approx(-0.02 * (2.0 * 8.0 * (0.14**2 + 0.17**2) - 0.17 * 2.0))
    rotors.reset()
    assert rotors.speeds == (0.0,) * 4
