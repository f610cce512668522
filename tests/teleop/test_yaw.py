# SPDX-License-Identifier: Apache-2.0

"""A waypoint with a yaw is reached when the robot is there and faces the yaw; else any yaw does."""

from math import cos, pi, radians, sin

import pytest

from cloudrc.teleop.wire import Leg, Plan
from cloudrc.wire.messages import Start
from tests.teleop.conftest import A, B, flying


def facing(degree):
    return (cos(radians(degree) / 2), 0.0, 0.0, sin(radians(degree) / 2))


@pytest.mark.parametrize(
    ("yaw", "seen", "reached"),
    [
        (90, 84, False),
        (90, 86, True),
        (180, -176, True),
        (720, 1, True),
    ],
)
@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_a_waypoint_with_a_yaw_is_reached_within_5_degrees(yaw, seen, reached, speed):
    flight = flying(Plan((Leg(A, radians(yaw), speed=speed), Leg(B)), Start.HERE))
    flight.orientation = facing(seen)
    flight.step(position=A, seconds=4.0)
    assert (flight.newest.waypoint == 1) is reached


def test_the_setpoint_turns_only_at_a_waypoint_with_a_yaw_and_keeps_the_last_one():
    plan = Plan((Leg(A, 0.5, dwell=0.0, yaw_tolerance=pi), Leg(B, dwell=0.0)), Start.HERE)
    flight = flying(plan)
    flight.step(position=A)
    assert [(s.yaw, s.turns) for s in flight.setpoints[-2:]] == [(0.5, True), (0.5, False)]
    before = len(flight.setpoints)
    flight.teleop.hold(flight.now_ns)
    for leg in (Leg(A, -1.0), Leg(B)):
        flight.teleop.go_to(leg, flight.now_ns)
    flight.step()
    turned = [(s.yaw, s.turns) for s in flight.setpoints[before:]]
    assert turned == [(0.5, False), (-1.0, True), (-1.0, False)]
