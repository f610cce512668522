# SPDX-License-Identifier: Apache-2.0

"""World moves the target, and knows where the camera has it."""

from math import atan2, cos, pi, sin

import numpy as np
import pytest

from cloudrc.config.robot import find_robot
from cloudrc.physics.geometry.moving import Moving
from cloudrc.physics.sim.engine import at_rest, mujoco
from cloudrc.physics.sim.target import MovingTarget
from tests.world.conftest import model_of

EYE = 0.1
"""Distance of the camera of x2 before its base [m]."""
BOARD = Moving("board", ((3.0, 0.0, 1.5), (3.0, 3.0, 1.5)), 0.8)


def seen_from(position, yaw, time=0.0):
    """Return what the camera has of the board, with x2 at a position [m] and a yaw [rad]."""
    model = model_of("x2", "follow")
    data = at_rest(model)
    data.qpos[:7] = *position, cos(yaw / 2), 0.0, 0.0, sin(yaw / 2)
    target = MovingTarget(model, data, BOARD, find_robot("x2").camera)
    target.begin(5)
    seen = target.observe(5 + round(time * 1e9))
    assert data.mocap_pos[0].tolist() == pytest.approx(seen.position)
    return seen


@pytest.mark.parametrize(
    ("position", "yaw", "left", "ahead", "inside"),
    [
        ((0.0, 0.0, 1.5), 0.0, 0.0, 3.0 - EYE, True),
        ((0.0, -2.0, 1.5), 0.0, 2.0, 3.0 - EYE, True),
        ((0.0, -2.3, 1.5), 0.0, 2.3, 3.0 - EYE, False),  # 4 to 3, 60 degrees high: tan .77
        ((0.0, 0.0, 1.5), -pi / 2, 3.0, -EYE, False),
        ((3.0, 3.0, 1.5), pi / 2, 0.0, -3.0 - EYE, False),
        ((0.0, 0.0, 0.1), 0.0, 0.0, 3.0 - EYE, True),
        ((1.0, 0.0, 0.1), 0.0, 0.0, 2.0 - EYE, False),  # too high in the picture
    ],
)
def test_the_place_in_the_picture_is_that_of_geometry(position, yaw, left, ahead, inside):
    seen = seen_from(position, yaw)
    assert seen.position == (3.0, 0.0, 1.5)
    assert abs(seen.bearing) == pytest.approx(abs(atan2(left, ahead)), abs=1e-9)
    up = 1.5 - position[2]
    assert seen.distance == pytest.approx((left**2 + ahead**2 + up**2) ** 0.5)
    assert seen.in_picture is inside


def test_the_body_moves_from_the_start_of_the_mission_on():
    assert seen_from((0.0, 0.0, 1.5), 0.0, time=1.0).position == pytest.approx((3.0, 0.8, 1.5))


def test_a_moving_board_changes_no_bit_of_the_robot():
    model = model_of("x2", "follow")
    data, alone = at_rest(model), at_rest(model)
    target = MovingTarget(model, data, BOARD, find_robot("x2").camera)
    for step in range(50):
        target.observe(step * 10_000_000)
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, alone)
    assert (data.qpos == alone.qpos).all()
    assert np.any(data.mocap_pos != alone.mocap_pos)
