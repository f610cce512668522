# SPDX-License-Identifier: Apache-2.0

"""Clearance equals distances that were computed by hand, published, or computed pose by pose."""

import math
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.geometry.clearance import (
    clearance,
    clearance_per_obstacle,
    least_clearance,
    place_points,
)
from cloudrc.physics.geometry.scene import Tube, load_scene

PIPES = load_scene("pipes")
TUBES = PIPES.tubes
FEW = ResolvedWorld(robot="pelican").files.hull
ALONG_X = Tube("pipe_x", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5.0, 0.662, 0.700)
LEVEL = (1.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0, 0, 0), 0.662),  # on the axis
        ((1, 0, 1.0), 0.300),  # outside
        ((0, -0.67, 0), -0.008),  # nearer to the inner face
        ((2.499, 0, 0.681), -0.001),  # nearer to the flat end
        ((2.6, 0.681, 0), 0.100),  # before the flat end
        ((-2.53, 0, 0.740), 0.050),  # 3-4-5 from the outer edge
        ((2.8, 0, 0.262), 0.500),  # 3-4-5 from the inner edge
    ],
)
def test_distance_to_a_hollow_cylinder(point, distance):
    found = ALONG_X.distance(np.array([point], dtype=float))
    assert found == pytest.approx([distance], abs=1e-9)


def test_clearance_on_the_axis_is_that_of_the_plant():
    """Source: docs/reference/plant.md, "Clearance on the axis"."""
    for height, expected in ((0.8, (0.217, 0.326, 0.320)), (0.7, (0.246, 0.365, 0.320))):
        at = [(*pipe.centre[:2], height) for pipe in PIPES.tubes]
        found = clearance(TUBES, at, [LEVEL] * 3, FEW)
        assert found == pytest.approx(expected, abs=2e-3)
        assert np.array_equal(np.diag(clearance_per_obstacle(TUBES, at, [LEVEL] * 3, FEW)), found)
    for pipe in PIPES.tubes:  # along each pipe it is the same
        yaw = math.atan2(pipe.axis[1], pipe.axis[0])
        facing = (math.cos(yaw / 2), 0, 0, math.sin(yaw / 2))
        assert clearance(TUBES, pipe.centre, facing, FEW) == pytest.approx([0.320], abs=1e-3)


def test_points_are_those_of_the_plant_and_turn_with_the_robot():
    assert FEW.positions.shape == (225, 3)
    # A third of a turn about (1, 1, 1) takes x to y, y to z, z to x.
    placed = place_points(FEW, np.zeros((1, 3)), np.array([[0.5, 0.5, 0.5, 0.5]]))[0]
    assert placed == pytest.approx(FEW.positions[:, [2, 0, 1]])
    tip = place_points(FEW, np.array([[8.135, -6.422, 0.7]]), np.array([LEVEL]))[0, 8]
    assert tip == pytest.approx((8.535, -6.422, 0.87))  # at the contact pose


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 200), st.sampled_from([0.001, 0.02, 0.5]))
def test_the_least_clearance_is_that_of_all_poses_to_the_bit(seed, count, step):
    """Random walks along the pipes, slow and fast, that also turn."""
    draw = np.random.default_rng(seed)
    positions = draw.uniform((-4, -8, 0), (8, 1, 2)) + step * draw.normal(size=(count, 3)).cumsum(0)
    facing = draw.normal(size=4) + step * draw.normal(size=(count, 4)).cumsum(0)
    facing /= np.linalg.norm(facing, axis=1)[:, None]
    every = clearance(TUBES, positions, facing, FEW)
    assert least_clearance(TUBES, positions, facing, FEW) == every.min(initial=math.inf)


def test_the_ball_of_a_robot_holds_its_geoms(tmp_path, monkeypatch):
    (tmp_path / "robot.yaml").write_text("onboard: multirotor")
    (tmp_path / "robot.xml").write_text(
        '<mujoco><worldbody><body><freejoint/><geom type="box" size=".3 .4 .01"/>'
        '<body pos="0 .5 0"><geom type="cylinder" size=".12 .05" euler="90 0 0"/></body>'
        "</body></worldbody></mujoco>"
    )
    assert ResolvedWorld(robot=str(tmp_path)).files.hull.radii == pytest.approx([0.5629], abs=1e-3)
    absent = Mock(side_effect=MissingPrerequisiteError("the simulator needs MuJoCo"))
    monkeypatch.setattr("cloudrc.physics.sim.bodies.reach_of", absent)
    assert ResolvedWorld(robot=str(tmp_path)).files.known_hull is None
