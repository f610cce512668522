# SPDX-License-Identifier: Apache-2.0

"""Positions too near to a wall, straight ways through a wall, and missions with one of them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.config.mission_check import check_mission, check_scene
from cloudrc.config.schema import MissionConfig, Steps, Touch, Waypoint
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.geometry.clearance import clearance
from cloudrc.physics.geometry.obstacles import obstacles
from cloudrc.physics.geometry.placement import (
    CLEARANCE_MIN,
    find_crossed,
    find_overlapped,
)
from cloudrc.physics.geometry.scene import load_scene

KNOWN = obstacles(load_scene("pipes"), touch="board")
FEW = ResolvedWorld(robot="pelican").files.hull
BESIDE_AND_ALONG = (0.5, 0.0, 1.2), (2.821, -6.418, 0.7)
"""A point beside the third pipe, and one before its mouth [m]."""


def hit(position):
    return int(find_overlapped(KNOWN, FEW, np.array([position]))[0])


def crossed(start, end):
    return int(find_crossed(KNOWN, FEW, np.array([start]), np.array([end]))[0])


def refusals(*positions, start="spawn", scene="pipes", **more):
    waypoints = tuple(Waypoint(position_m=position, **more) for position in positions)
    touch = Touch(body="board") if scene == "pipes" else None
    mission = MissionConfig(start=start, waypoints=waypoints, touch=touch)
    problems = check_mission(mission, ResolvedWorld(scene=scene).files)
    return "\n".join(map(str, problems))


@settings(max_examples=25, deadline=None)
@given(*[st.tuples(st.floats(-2.8, 9), st.floats(-8.3, 5.3), st.floats(0.4, 2.2))] * 2)
def test_a_way_touches_a_wall_if_one_of_its_points_does(start, end):
    """Compare with the clearance of the metrics at points on the way, 1 cm apart."""
    if hit(start) >= 0:
        return
    points = np.linspace(start, end, 1 + int(100 * math.dist(start, end)))
    distance = clearance(KNOWN, points, np.tile([1.0, 0, 0, 0], (len(points), 1)), FEW).min()
    if abs(distance - CLEARANCE_MIN) > 0.02:
        assert (crossed(start, end) >= 0) is bool(distance < CLEARANCE_MIN)


def test_a_robot_that_presses_on_the_board_leads_through_no_pipe():
    solid = obstacles(load_scene("pipes"), touch="")
    presses = np.array([[8.16, -6.42, 0.7]])
    assert [find_crossed(solid, FEW, presses, np.array([end])) for end in BESIDE_AND_ALONG] == [
        2,
        -1,
    ]


@pytest.mark.parametrize(
    ("position", "tolerance", "outside"),
    [
        ((9.2, 0.0, 1.0), 0.1, True),  # in the fence; the guard stops the robot at 9.03
        ((9.05, 0.0, 1.0), 0.1, False),  # within half of the tolerance
        ((9.05, 0.0, 1.0), 0.01, True),
    ],
)
def test_a_waypoint_that_the_guard_forbids_is_refused(position, tolerance, outside):
    said = refusals(position, start="here", scene="empty", tolerance_m=tolerance)
    assert ("x -2.8 to 9, y -8.3 to 5.3, z 0.35 to 2.3 [m]" in said) is outside


@pytest.mark.parametrize(
    ("steps", "scene", "reason"),
    [
        ({"centre_m": (1e308, 0, 1), "range_m": (1e308, 0, 0)}, "empty", "beyond the fence"),
        ({}, "pipes", "can end in the wall of pipe_1"),
    ],
)
def test_steps_that_can_end_in_a_wall_are_refused(steps, scene, reason):
    (problem,) = check_mission(
        MissionConfig(steps=Steps(**steps)), ResolvedWorld(scene=scene).files
    )
    assert problem.path == ("steps",)
    assert reason in problem.reason
    both = MissionConfig(waypoints=(Waypoint(position_m=(0.0, 0.0, 1.0)),), steps=Steps(**steps))
    assert "not both" in str(check_mission(both, ResolvedWorld().files)[0])


POST = '<body name="post" pos="1.2 0 1"><geom type="capsule" size=".05 1"/></body>'
GROUND = '<geom type="plane" size="5 5 .1"/>'


@pytest.mark.parametrize(
    ("bodies", "waypoints", "reason"),
    [
        (POST, [(0, 0, 1), (2.4, 0, 1)], "from waypoint 0 leads through post, or within 0.04 m"),
        (POST, [(0, 0, 1), (1.2, 0.3, 1)], "would be within 0.04 m of post"),
        (POST, [(0, 0, 1), (0, 2, 1), (2.4, 2, 1), (2.4, 0, 1)], ""),
        (POST.replace("<geom", '<geom contype="0" conaffinity="0"'), [(2.4, 0, 1)], ""),
    ],
)
def test_every_body_of_a_scene_of_ones_own_is_in_the_way(scene_with, bodies, waypoints, reason):
    mission = MissionConfig(waypoints=tuple(Waypoint(position_m=each) for each in waypoints))
    said = "\n".join(
        map(str, check_mission(mission, ResolvedWorld(scene=scene_with(bodies)).files))
    )
    assert reason in said if reason else said == ""


@pytest.mark.parametrize(
    ("bodies", "touch", "path", "reason"),
    [
        (POST, None, None, ""),
        (POST.replace("1.2 0 1", "0 0 1"), "post", None, ""),
        (GROUND, None, ("world", "scene"), "touches world"),
        (POST.replace("1.2 0 1", "0 0 1"), None, ("world", "scene"), "touches post"),
    ],
)
def test_a_scene_fits_its_missions(scene_with, bodies, touch, path, reason):
    problems = check_scene(ResolvedWorld(scene=scene_with(bodies)).files, touch)
    assert [problem.path for problem in problems] == ([path] if path else [])
    assert all(reason in problem.reason for problem in problems)
