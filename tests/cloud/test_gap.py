# SPDX-License-Identifier: Apache-2.0

"""The perception gap goes through the widest gap, by hand."""

from math import atan2, cos, hypot, inf, pi, radians, sin, sqrt

import numpy as np
import pytest

from cloudrc.cloud.perceptions import Scan, point_at, yaw_of
from cloudrc.cloud.perceptions.gap import build, reach
from cloudrc.wire.messages import ZERO, Odometry

ANGLES = np.radians(np.arange(-135.0, 136.0, 1.5))


def robot(x=0.0, y=0.0, yaw=0.0):
    return Odometry(0, (x, y, 0.1), (cos(yaw / 2), 0.0, 0.0, sin(yaw / 2)), ZERO, ZERO)


def scan(*points):
    """Return a scan that sees points, given as angle [deg] and distance [m]."""
    ranges = np.full(len(ANGLES), inf)
    for angle, distance in points:
        ranges[np.abs(np.degrees(ANGLES) - angle).argmin()] = distance
    return Scan(0, ranges, ANGLES)


def heading(setpoint, odometry):
    (x, y, _), (px, py, _) = setpoint.position, odometry.position
    return atan2(y - py, x - px)


def test_a_disc_reaches_as_far_as_geometry_says():
    ahead, side = len(ANGLES) // 2, len(ANGLES) // 2 + 4  # 6 degrees
    beside = 3.0 * sin(radians(6.0))
    free = reach(scan((0.0, 3.0)), 0.5)
    assert free[ahead] == pytest.approx(2.5)
    assert free[side] == pytest.approx(3.0 * cos(radians(6.0)) - sqrt(0.25 - beside**2))
    assert free[0] == inf
    assert reach(scan((0.0, 0.2)), 0.5)[ahead] == 0.0, "it touches already"


def test_without_an_obstacle_it_keeps_the_course():
    odometry = robot(1.0, 2.0, yaw=0.5)
    setpoint = build().see(scan(), odometry)
    assert heading(setpoint, odometry) == pytest.approx(0.0, abs=radians(0.8))
    assert hypot(setpoint.position[0] - 1.0, setpoint.position[1] - 2.0) == pytest.approx(2.0)
    west = build(course_deg=180.0).see(scan(), robot(yaw=3.0))
    assert abs(heading(west, robot())) == pytest.approx(pi, abs=radians(0.8))


def test_it_goes_through_the_widest_gap():
    right = [(angle, 1.2) for angle in np.arange(-90.0, 21.0, 1.5)]
    setpoint = build().see(scan(*right), robot())
    assert heading(setpoint, robot()) > radians(20)


def test_without_a_gap_it_goes_as_far_as_it_can():
    wall = [(angle, 1.0) for angle in np.degrees(ANGLES)]
    x, y, _ = build().see(scan(*wall), robot()).position
    assert hypot(x, y) == pytest.approx(0.6, abs=0.01)


def test_points_are_those_of_the_world_frame():
    odometry = robot(1.0, 2.0, yaw=pi / 2)
    assert yaw_of(odometry) == pytest.approx(pi / 2)
    assert point_at(odometry, -pi / 2, 3.0) == pytest.approx((4.0, 2.0, 0.1))
