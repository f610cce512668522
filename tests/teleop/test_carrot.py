# SPDX-License-Identifier: Apache-2.0

"""The carrot: its motion, when it waits at the robot, and when it leaves a waypoint."""

from math import dist

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cloudrc.teleop.carrot import arrival_ns, setpoint_at
from cloudrc.teleop.wire import Leg, Plan
from cloudrc.wire.messages import ZERO, GuardState, Motion, Setpoint, Start
from tests.teleop.conftest import PERIOD_NS, ServiceFlight, reference

SECOND = 1_000_000_000
TRACK, HOLD = GuardState.TRACK, GuardState.HOLD
START, A, B = (0.0, 0.0, 1.0), (4.0, 0.0, 1.0), (4.0, 3.0, 1.0)
FAST = {"tolerance": 0.4, "dwell": 0.3, "speed": 2.0, "acceleration": 2.0}
TWO = Plan((Leg(A, **FAST), Leg(B, **FAST)), Start.HERE)
POINTS = st.tuples(*[st.floats(-10, 10)] * 3)
SIZES = st.floats(0.1, 10)


def test_the_carrot_speeds_up_cruises_and_stops():
    moving = Setpoint(A, waypoint=3, motion=Motion(START, SECOND, 2.0, 2.0))
    assert arrival_ns(moving) == 4 * SECOND
    seen = [setpoint_at(moving, at * SECOND // 2) for at in (0, 2, 3, 4, 6, 7, 8, 9)]
    assert [s.position[0] for s in seen] == [0, 0, 0.25, 1, 3, 3.75, 4, 4]
    assert [s.velocity[0] for s in seen] == [0, 0, 1, 2, 2, 1, 0, 0]
    assert {s.waypoint for s in seen} == {3}
    assert setpoint_at(Setpoint(A), SECOND) == Setpoint(A)
    assert arrival_ns(Setpoint(A)) == 0


@given(POINTS, POINTS, SIZES, SIZES, st.integers(0, 10 * SECOND))
def test_the_carrot_keeps_its_limits(start, end, speed, acceleration, now_ns):
    moving = Setpoint(end, motion=Motion(start, 0, speed, acceleration))
    before, after = setpoint_at(moving, now_ns), setpoint_at(moving, now_ns + PERIOD_NS)
    assert dist(ZERO, before.velocity) <= speed * (1 + 1e-9)
    assert dist(before.velocity, after.velocity) <= acceleration * 0.01 + 1e-9
    mean = [(a + b) * 0.005 for a, b in zip(before.velocity, after.velocity, strict=True)]
    moved = [b - a for a, b in zip(before.position, after.position, strict=True)]
    assert moved == pytest.approx(mean, abs=acceleration * 1e-4 + 1e-9)
    assert setpoint_at(moving, arrival_ns(moving) + 1).position == end


def led():
    """Return a flight that has just begun, with the robot in the air."""
    flight = ServiceFlight()
    flight.position, flight.guard = START, HOLD
    flight.step()
    flight.create(TWO)
    flight.step(seconds=0.1)
    return flight


def follow(flight, seconds):
    for _ in range(round(seconds * 100)):
        flight.step(reference(flight).position)


def test_it_waits_at_a_robot_that_holds_and_starts_from_there():
    flight = led()
    follow(flight, 1.0)
    flight.guard = HOLD
    flight.step((1.4, 0.1, 1.0), seconds=3.0)
    assert flight.setpoints[-1][:1] == ((1.4, 0.1, 1.0),)
    assert reference(flight).velocity == ZERO
    flight.guard = TRACK
    flight.step()
    assert reference(flight).position == (1.4, 0.1, 1.0)
    follow(flight, 5.0)
    assert flight.newest.waypoint == 1


def test_it_starts_again_from_the_robot_after_a_silence():
    flight = led()
    follow(flight, 1.0)
    flight.uplink = False
    flight.step(seconds=1.0)
    flight.uplink = True
    flight.step((1.2, 0.0, 1.0))
    assert reference(flight).position == (1.2, 0.0, 1.0)
    follow(flight, 0.5)
    flight.epoch += 1
    flight.step((1.0, 0.0, 1.0))
    assert flight.setpoints[-1].motion == Motion((1.0, 0.0, 1.0), flight.now_ns, 2.0, 2.0)
