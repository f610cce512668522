# SPDX-License-Identifier: Apache-2.0

"""The allocation makes what is asked; where it cannot, the tilt comes first and the yaw last."""

import numpy as np
import pytest

from cloudrc.physics.sim.airframe import read_airframe
from cloudrc.robots.onboard._allocation import Allocation
from tests.robots.onboard.conftest import SKEW, big, compiled, hexarotor, one_site

GRAVITY = 9.81


@pytest.fixture(params=[big(), big(centre=".03 0 .02"), SKEW, hexarotor(), one_site()])
def parts(request):
    """Return the frame, its allocation, and a function: controls -> accelerations."""
    frame = read_airframe(compiled(request.param))

    def accelerations(controls):
        turn_x, turn_y, force, turn_z = frame.wrench @ controls
        turns = np.linalg.solve(frame.inertia, (turn_x, turn_y, turn_z))
        return np.array((force / frame.mass, *turns))

    return frame, Allocation(frame, 3.0), accelerations


def test_the_controls_make_what_is_asked(parts):
    _, allocation, accelerations = parts
    wanted = (10.0, 3.0, -2.0, 0.5)
    assert accelerations(allocation.allocate(*wanted)) == pytest.approx(wanted)


def test_the_turn_about_z_gives_way_first(parts):
    _, allocation, accelerations = parts
    for thrust in (0.5 * GRAVITY, 0.9 * allocation.acceleration_max):
        for yaw in (500.0, -500.0):
            made = accelerations(allocation.allocate(thrust, 0.2, -0.1, yaw))
            assert made[:3] == pytest.approx((thrust, 0.2, -0.1))
            assert 0.0 < made[3] / yaw < 1.0


def test_the_thrust_gives_way_to_the_tilt(parts):
    _, allocation, accelerations = parts
    turn = 0.5 * allocation.turn_max
    for thrust in (0.0, 2.0 * allocation.acceleration_max):
        made = accelerations(allocation.allocate(thrust, turn, 0.0, 0.0))
        assert made[1:] == pytest.approx((turn, 0.0, 0.0), abs=1e-6 * turn)
        assert 0.0 <= made[0] <= allocation.acceleration_max


def test_a_turn_that_is_too_fast_keeps_its_direction(parts):
    _, allocation, accelerations = parts
    made = accelerations(allocation.allocate(GRAVITY, 9e3, -4e3, 1e3))
    assert made[2] / made[1] == pytest.approx(-4.0 / 9.0)
    assert made[1] > 0.6 * allocation.turn_max


def test_a_turn_lifts_no_robot_that_wants_to_sink(parts):
    _, allocation, accelerations = parts
    for thrust in (0.0, 0.3 * GRAVITY, GRAVITY):
        made = accelerations(allocation.allocate(thrust, 9e3, -9e3, 0.0))
        assert thrust - 1e-6 <= made[0] <= GRAVITY + 1e-6
    made = accelerations(allocation.allocate(allocation.acceleration_max, 9e3, 9e3, 0.0))
    assert made[0] >= GRAVITY - 1e-6


def test_any_wish_leads_to_controls_within_their_ranges(parts):
    frame, allocation, _ = parts
    rng = np.random.default_rng(7)
    for scale in (1.0, 30.0, 1e4):
        for wish in rng.normal(scale=scale, size=(50, 4)):
            controls = np.array(allocation.allocate(*wish.tolist()))
            assert ((frame.low <= controls) & (controls <= frame.high)).all()
