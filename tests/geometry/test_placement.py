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
from cloudrc.geometry import fence
from cloudrc.geometry.clearance import clearance
from cloudrc.geometry.placement import (
    CLEARANCE_MIN,
    find_crossed_pipe,
    find_nearest_legal,
    find_overlapped_pipe,
    outside_fence,
)
from cloudrc.geometry.scene import Scene, load_scene
from cloudrc.messages import Vector
from cloudrc.world.guard.limits import Limits

PIPES = load_scene("pipes")


def hit(position: Vector, yaw: float = 0.0) -> int:
    return int(find_overlapped_pipe(PIPES, np.array([position]), np.array([yaw]))[0])


@pytest.mark.parametrize(
    ("position", "yaw", "pipe"),
    [
        ((-1.0, 0.0, 0.8), 0, -1),
        # The arm's tip is at x + .40, z + .17: from x = -.81 on it is within .04 m of the wall.
        ((-0.82, 0.0, 0.8), 0, -1),
        ((-0.80, 0.0, 0.8), 0, 0),
        # Beyond that the tip is outside and the arm goes through the wall.
        ((-0.60, 0.0, 0.8), 0, 0),
        # Turned along the pipe, the arm is clear.
        ((-0.80, 0.0, 0.8), math.pi / 2, -1),
        # The rims of the rotors, .338 from the axis, in the lower part of the bore.
        ((-1.0, 0.0, 0.29), math.pi / 2, -1),
        ((-1.0, 0.0, 0.25), math.pi / 2, 0),
        # At (0, 0) the rear rotor is in the outside of pipe 1.
        ((0.0, 0.0, 0.8), 0, 0),
        # Behind the board.
        ((8.235, -6.422, 0.7), 0, -1),
    ],
)
def test_overlaps(position: Vector, yaw: float, pipe: int) -> None:
    assert hit(position, yaw) == pipe


def test_the_limits_are_those_of_the_guard() -> None:
    corners = Limits(fence_low=fence.LOW, fence_high=fence.HIGH).inner_corners()
    assert corners == (fence.INNER_LOW, fence.INNER_HIGH)


@pytest.mark.parametrize(
    ("position", "tolerance", "outside"),
    [
        ((9.2, 0.0, 1.0), 0.1, True),  # in the fence; the guard stops the robot at 9.03
        ((9.05, 0.0, 1.0), 0.1, False),  # within half of the tolerance
        ((9.05, 0.0, 1.0), 0.01, True),
        ((9.25, 0.0, 1.0), 1.0, True),  # beyond the fence
        ((0.5, 0.0, 0.1), 0.1, True),
        ((0.5, 0.0, 0.3), 0.1, False),
    ],
)
def test_a_waypoint_that_the_guard_keeps_the_robot_from_is_refused(
    position: Vector, tolerance: float, outside: bool
) -> None:
    mission = Mission(waypoints=(Waypoint(position_m=position, tolerance_m=tolerance),))
    problems = check_mission(mission, PIPES)
    assert bool(problems) is outside
    if outside:
        assert "x -2.8 to 9, y -8.3 to 5.3, z 0.35 to 2.3 [m]" in str(problems[0])


def test_the_example_of_goto_can_be_flown_and_straight_up_cannot() -> None:
    for position, start, legal in (
        ((0.5, 0.0, 1.2), "spawn", True),
        ((0.0, 0.0, 1.2), "spawn", False),
        ((0.0, 0.0, 1.2), "here", True),
        ((0.0, 0.0, 0.8), "here", False),
    ):
        mission = Mission(start=start, waypoints=(Waypoint(position_m=position),))  # type: ignore[arg-type]
        assert (check_mission(mission, PIPES) == []) is legal


def test_the_way_from_the_spawn_is_checked() -> None:
    beyond = Mission(waypoints=(Waypoint(position_m=(-2.5, 0.0, 0.8)),))
    (problem,) = check_mission(beyond, PIPES)
    assert "the straight way there from the spawn leads through the wall of pipe_1" in str(problem)
    assert check_mission(beyond.model_copy(update={"start": "here"}), PIPES) == []


def test_the_nearest_legal_point_is_one_to_which_a_straight_way_leads() -> None:
    for start in ("spawn", "here"):
        wanted = Waypoint(position_m=(0.0, 0.0, 0.8))
        (problem,) = check_mission(Mission(start=start, waypoints=(wanted,)), PIPES)
        offered = [float(word) for word in str(problem).rpartition("[")[2].rstrip("]").split(",")]
        nearest = Waypoint(position_m=tuple(offered))
        assert math.dist(offered, (0.0, 0.0, 0.8)) < 0.15
        assert check_mission(Mission(start=start, waypoints=(nearest,)), PIPES) == []


def test_a_robot_that_is_at_a_wall_may_move_away_from_it() -> None:
    at, away, nearer = np.array([[-0.78, 0.0, 0.8]]), (-1.0, 0.0, 0.8), (-0.7, 0.0, 0.8)
    assert hit(at[0]) == 0
    assert find_crossed_pipe(PIPES, at, np.array([away]))[0] == -1
    assert find_crossed_pipe(PIPES, at, np.array([nearer]))[0] == 0


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
    bad = Waypoint(position_m=(-0.6, 0.0, 0.7))
    good = Waypoint(position_m=(-1.0, 0.0, 0.7))
    problems = check_mission(Mission(waypoints=(good, bad) * 30), PIPES)
    assert len(problems) == 21
    assert str(problems[0]).startswith("waypoints.1.position_m: [-0.6, 0, 0.7]: the robot would")
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
        ((-2.5, 2.9, 0.8), (0.5, 2.9, 0.8), -1),  # across, in front of its mouth
        ((-2.5, 2.7, 0.8), (0.5, 2.7, 0.8), 0),  # with a rotor in it
        ((-2.5, 0.0, 1.7), (0.5, 0.0, 1.7), -1),  # over it
        ((-2.5, 0.0, 1.6), (0.5, 0.0, 1.6), 0),  # its box would scrape along the top
        ((-1.0, -2.0, 0.8), (5.66, -6.42, 0.8), 0),  # out of one bore, into another
    ],
)
def test_a_straight_way_through_a_wall_is_found(start: Vector, end: Vector, pipe: int) -> None:
    assert find_crossed_pipe(PIPES, np.array([start]), np.array([end]))[0] == pipe


@settings(max_examples=50, deadline=None)
@given(*[st.tuples(st.floats(-2.8, 9), st.floats(-8.3, 5.3), st.floats(0.4, 2.2))] * 2)
def test_a_way_is_found_to_touch_a_wall_if_a_piece_of_it_does(start: Vector, end: Vector) -> None:
    """Fly the way in steps of 1 cm, with the points by which the metrics judge the clearance."""
    if hit(start) >= 0:
        return
    points = np.linspace(start, end, 1 + int(100 * math.dist(start, end)))
    distance = clearance(PIPES, points, np.tile([1.0, 0, 0, 0], (len(points), 1))).min()
    (found,) = find_crossed_pipe(PIPES, np.array([start]), np.array([end])).tolist()
    if distance < CLEARANCE_MIN - 0.02:
        assert found != -1
    if distance > CLEARANCE_MIN + 0.02:
        assert found == -1


def test_a_waypoint_behind_a_wall_is_refused_with_its_way() -> None:
    inside, outside = Waypoint(position_m=(-1.0, 0.0, 0.7)), Waypoint(position_m=(0.5, 0.0, 0.7))
    (problem,) = check_mission(Mission(start="here", waypoints=(inside, outside)), PIPES)
    assert str(problem).startswith("waypoints.1.position_m: [0.5, 0, 0.7]: the straight way there")
    assert "from waypoint 0 leads through the wall of pipe_1" in problem.reason
    assert "from the spawn" in str(check_mission(Mission(waypoints=(inside,)), PIPES)[0])
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
