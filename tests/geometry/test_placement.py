"""Positions that overlap a wall, ways that cross one, and legal points nearby."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.config.load import load_experiment
from cloudrc.config.mission_check import check_mission
from cloudrc.config.schema import Mission, Steps, Waypoint
from cloudrc.geometry.placement import (
    find_crossed_pipe,
    find_nearest_legal,
    find_overlapped_pipe,
    outside_fence,
)
from cloudrc.geometry.robot import Array
from cloudrc.geometry.scene import Pipe, Scene, load_scene
from cloudrc.messages import Vector

PIPES = load_scene("pipes")


def hit(position: Vector, yaw: float = 0.0) -> int:
    return int(find_overlapped_pipe(PIPES, np.array([position]), np.array([yaw]))[0])


@pytest.mark.parametrize(
    ("position", "yaw", "pipe"),
    [
        ((-1.0, 0.0, 0.8), 0, -1),
        # The arm's tip is at x + .40, z + .17: from x = -.77 on it is in the wall of pipe 1.
        ((-0.78, 0.0, 0.8), 0, -1),
        ((-0.76, 0.0, 0.8), 0, 0),
        # Beyond that the tip is outside and the arm goes through the wall.
        ((-0.60, 0.0, 0.8), 0, 0),
        # Turned along the pipe, the arm is clear.
        ((-0.76, 0.0, 0.8), math.pi / 2, -1),
        # The bottom of the base's box: z - .10 against the bore's z - .662.
        ((-1.0, 0.0, 0.25), math.pi / 2, -1),
        ((-1.0, 0.0, 0.23), math.pi / 2, 0),
        # The wall is inside the box, and all corners of the box are outside the wall.
        ((-1.0, 0.0, 0.119), math.pi / 2, 0),
        # At (0, 0) only the rotors overlap; they do not count.
        ((0.0, 0.0, 0.8), 0, -1),
        # Behind the board.
        ((8.235, -6.422, 0.7), 0, -1),
    ],
)
def test_overlaps(position: Vector, yaw: float, pipe: int) -> None:
    assert hit(position, yaw) == pipe


@settings(max_examples=30, deadline=None)
@given(
    st.tuples(st.floats(-4, 10), st.floats(-9, 6), st.floats(-1, 3)),
    st.floats(-math.pi, math.pi),
)
def test_the_nearest_legal_point_is_legal(position: Vector, yaw: float) -> None:
    found = find_nearest_legal(PIPES, position, yaw)
    assert found is not None
    assert hit(found, yaw) == -1
    assert not outside_fence(np.array([found]))[0]


def test_a_legal_point_is_its_own_nearest() -> None:
    assert find_nearest_legal(PIPES, (-1.0, 0.0, 0.7), 0.0) == (-1, 0, 0.7)


@pytest.mark.parametrize("experiment", ["paper", "steps", "hover"])
def test_shipped_missions_can_be_flown(experiment: str) -> None:
    loaded = load_experiment(experiment)
    assert check_mission(loaded.mission, load_scene(loaded.world.scene)) == []


def test_every_bad_waypoint_is_named_up_to_a_number() -> None:
    bad = Waypoint(position_m=(-1.0, 0.0, 0.15))
    good = Waypoint(position_m=(-1.0, 0.0, 0.7))
    problems = check_mission(Mission(waypoints=(good, bad) * 30), PIPES)
    assert len(problems) == 21
    assert str(problems[0]).startswith("waypoints.1.position_m: [-1, 0, 0.15]: base box or arm")
    assert str(problems[-1]).startswith("waypoints: 10 more waypoints")


@pytest.mark.parametrize(
    ("start", "end", "pipe"),
    [
        ((-1.0, 0.0, 0.8), (0.5, 0.0, 0.8), 0),  # out of the bore, sideways
        ((0.5, 0.0, 0.8), (-1.0, 0.0, 0.8), 0),
        ((0.5, 0.0, 0.8), (-2.5, 0.0, 0.8), 0),  # right through
        ((-1.0, 0.0, 0.8), (-1.0, 0.0, 2.0), 0),
        ((-1.0, 3.6, 0.7), (-1.0, 0.0, 0.7), -1),  # into the bore, by its mouth
        ((-1.0, 0.0, 0.8), (-1.0, 0.0, 0.8), -1),
        ((-1.0, -1.0, 0.8), (-1.0, 1.0, 0.8), -1),  # along the axis
        ((0.5, -2.0, 0.8), (0.5, 2.0, 0.8), -1),  # past it
        ((-2.5, 2.7, 0.8), (0.5, 2.7, 0.8), -1),  # across, in front of its mouth
        ((-2.5, 0.0, 1.6), (0.5, 0.0, 1.6), -1),  # over it
        ((-1.0, -2.0, 0.8), (5.66, -6.42, 0.8), 2),  # out of one bore, into another
    ],
)
def test_a_straight_way_through_a_wall_is_found(start: Vector, end: Vector, pipe: int) -> None:
    assert find_crossed_pipe(PIPES, np.array([start]), np.array([end]))[0] == pipe


def in_pipe(points: Array, pipe: Pipe) -> tuple[Array, Array]:
    """Return the depth along the axis and the distance from it [m], shapes (n,)."""
    relative = points - np.array(pipe.centre)
    depth = relative @ np.array(pipe.axis)
    return depth, np.linalg.norm(relative - depth[:, None] * np.array(pipe.axis), axis=1)


@settings(max_examples=50, deadline=None)
@given(*[st.tuples(st.floats(-3, 9), st.floats(-8, 5), st.floats(0, 2))] * 2)
def test_a_way_crosses_a_wall_if_it_changes_sides(start: Vector, end: Vector) -> None:
    """Cut the way into short pieces: a piece that changes sides crosses the wall."""
    points = np.linspace(start, end, 2_000)
    (found,) = find_crossed_pipe(PIPES, np.array([start]), np.array([end])).tolist()
    for pipe in PIPES.pipes:
        depth, radius = in_pipe(points, pipe)
        within = radius < (pipe.inner + pipe.outer) / 2
        beside = np.abs(depth) < pipe.length / 2 - 0.02
        if np.any((within[1:] != within[:-1]) & beside[1:] & beside[:-1]):
            assert found != -1, pipe.name
    if found != -1:
        pipe = PIPES.pipes[found]
        depth, radius = in_pipe(points, pipe)
        near = np.abs(radius - (pipe.inner + pipe.outer) / 2) < 0.02
        assert np.any(near & (np.abs(depth) < pipe.length / 2 + 0.02))


def test_a_waypoint_behind_a_wall_is_refused_with_its_way() -> None:
    inside, outside = Waypoint(position_m=(-1.0, 0.0, 0.7)), Waypoint(position_m=(0.5, 0.0, 0.7))
    (problem,) = check_mission(Mission(waypoints=(inside, outside)), PIPES)
    assert str(problem).startswith("waypoints.1.position_m: [0.5, 0, 0.7]: the straight way there")
    assert "from waypoint 0 leads through the wall of pipe_1" in problem.reason
    assert check_mission(Mission(waypoints=(outside, outside)), PIPES) == []


def test_neither_waypoints_nor_steps_or_both_are_refused() -> None:
    assert "none given" in str(check_mission(Mission(), PIPES)[0])
    both = Mission(waypoints=(Waypoint(position_m=(0.0, 0.0, 1.0)),), steps=Steps())
    assert "not both" in str(check_mission(both, Scene("empty"))[0])


@pytest.mark.parametrize(
    ("steps", "scene", "reason"),
    [
        (Steps(centre_m=(0.0, 0.0, 2.0)), "empty", "beyond the fence"),
        (Steps(centre_m=(1e308, 0.0, 1.0), range_m=(1e308, 0.0, 0.0)), "empty", "beyond the fence"),
        (Steps(), "pipes", "can end in the wall of pipe_1"),
    ],
)
def test_steps_that_can_end_in_a_wall_are_refused(steps: Steps, scene: str, reason: str) -> None:
    (problem,) = check_mission(Mission(steps=steps), load_scene(scene))
    assert problem.path == ("steps",)
    assert reason in problem.reason


def test_points_far_outside_are_refused_without_overflow() -> None:
    far = Mission(waypoints=(Waypoint(position_m=(1e300, 0.0, 1.0), yaw_deg=1e300),))
    *_, problem = check_mission(far, PIPES)
    assert "beyond the fence" in problem.reason
