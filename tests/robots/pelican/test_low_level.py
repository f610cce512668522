# SPDX-License-Identifier: Apache-2.0

"""The equations of the low-level controller give the hand-calculated numbers."""

from math import cos, radians, sin

import numpy as np
import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.shipped import file_of
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.sim.readings import Readings
from cloudrc.robots.build import check_robot
from cloudrc.robots.pelican.low_level import (
    LowLevel,
    attitude,
)
from cloudrc.wire.messages import UPRIGHT, ZERO

WEIGHT = 10.3005  # 1.05 kg * 9.81 m/s^2


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


@pytest.mark.parametrize("yaw", [18.0, -60.0, 135.0, 180.0])
def test_after_a_hit_the_turned_robot_tilts_the_right_way(yaw):
    """In the world frame the torque turns the thrust towards the force: e_z x z_d."""
    half = radians(yaw) / 2
    readings = turned((cos(half), 0.0, 0.0, sin(half)))
    _, roll, pitch, _ = attitude((3.0, 0.0, 4.0), readings)
    turn = np.array(readings.axes[:3]) * roll + np.array(readings.axes[3:6]) * pitch
    assert turn[:2] == pytest.approx([0.0, 0.6], abs=1e-9)


def test_a_scene_with_air_is_for_other_robots(tmp_path):
    """The rotors would count the drag twice."""
    scene = tmp_path / "air.xml"
    scene.write_text(file_of("empty").read_text().replace("<option ", '<option density="1.2" '))
    check_robot(ResolvedWorld(scene=str(scene), robot="x2"))
    with pytest.raises(BadInputError, match="the rotors of this robot have a drag of their own"):
        check_robot(ResolvedWorld(scene=str(scene)))
