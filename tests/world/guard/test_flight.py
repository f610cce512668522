"""The guard with a simulated robot: it brakes, holds, lands, stops, and resists hostile clouds."""

from dataclasses import replace
from math import dist, hypot, nan

import pytest

from cloudrc.messages import GuardState
from cloudrc.world.guard.state import Guard
from cloudrc.world.simulator import Simulator
from tests.world.guard.conftest import LIMITS, MS, SECOND, UP, Flight, hostile


@pytest.fixture(scope="module")
def simulator():
    return Simulator("pelican", "empty")


@pytest.fixture
def flight(simulator):
    """Return a flight at a height of 1.5 m, at rest."""
    flight = Flight(simulator)
    flight.fly(1.5, UP)
    return flight.fly(2.0, (0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "velocity", [(1.5, 0.0, 0.0), (-1.5, 0.0, 0.0), (0.0, 1.5, 0.0), (0.0, -1.0, 0.3)]
)
def test_without_commands_the_robot_stops_and_stays(flight, velocity):
    flight.fly(1.2, velocity)
    flight.fly(0.26)
    assert flight.guard.state is GuardState.HOLD
    flight.fly(1.0)
    still = flight.readings.position
    for _ in range(58):
        flight.fly(1.0)
        assert flight.speed < 0.05
        assert dist(flight.readings.position, still) < 0.10


def test_after_a_minute_it_lands_and_stops_its_rotors(flight):
    flight.fly(60.5)
    assert flight.guard.state is GuardState.LAND
    start = flight.readings.position
    speeds = []
    while flight.guard.step(flight.now_ns, flight.readings, 0.0) is not None:
        flight.fly(0.1)
        speeds.append(-flight.readings.velocity[2])
        assert len(speeds) < 80
    assert max(speeds) < 0.65
    x, y, z = flight.readings.position
    assert z == pytest.approx(0.1, abs=0.01)
    assert hypot(x - start[0], y - start[1]) < 0.10
    flight.fly(1.0)
    assert set(flight.robot.simulator._rotors.speeds) < {0.0} or flight.speed < 0.01


def test_five_impossible_commands_bring_it_down_from_full_speed(flight):
    flight.fly(0.6, (0.0, -3.0, 0.0))
    flight.fly(0.05, (nan, 0.0, 0.0))
    assert flight.guard.state is GuardState.LAND
    flight.fly(6.0, (3.0, 0.0, 3.0))
    assert flight.readings.position[2] == pytest.approx(0.1, abs=0.01)
    assert flight.speed < 0.01


def test_an_emergency_stop_lets_it_fall(flight):
    flight.guard.stop(flight.now_ns)
    flight.fly(0.3, UP)
    assert flight.readings.velocity[2] < -2.0
    flight.fly(3.0, UP)
    assert flight.readings.position[2] < 0.3


def test_after_an_acknowledged_stop_it_takes_off_again(flight):
    flight.fly(1.5, (0.0, 0.0, -0.8))
    flight.guard.stop(flight.now_ns)
    flight.fly(2.0)
    flight.guard.acknowledge(flight.now_ns)
    flight.guard.start_mission(flight.now_ns)
    flight.fly(1.5, UP)
    assert flight.readings.position[2] > 0.8
    assert flight.guard.state is GuardState.TRACK


@pytest.mark.promise("stays-inside-the-fence")
def test_acknowledged_in_its_fall_it_waits_until_it_lies(flight):
    flight.guard.stop(flight.now_ns)
    flight.fly(0.1)
    flight.guard.acknowledge(flight.now_ns)
    flight.guard.start_mission(flight.now_ns)
    began_ns, still_ns = flight.now_ns, flight.now_ns
    while flight.guard.state is GuardState.GROUND:
        flight.fly(0.01, UP)
        still_ns = flight.now_ns if flight.speed > 0.1 else still_ns
        assert flight.now_ns - began_ns < 5 * SECOND
    assert flight.guard.state is GuardState.TRACK
    assert flight.readings.position[2] < 0.3
    assert flight.now_ns - still_ns >= 400 * MS


@pytest.mark.promise("stays-inside-the-fence")
def test_a_robot_stopped_outside_the_fence_does_not_take_off(simulator):
    flight = Flight(simulator)
    _, y, z = LIMITS.fence_low
    flight.guard = flight.robot.guard = Guard(replace(LIMITS, fence_low=(0.1, y, z)))
    flight.guard.stop(flight.now_ns)
    flight.guard.acknowledge(flight.now_ns)
    flight.guard.start_mission(flight.now_ns)
    assert flight.fly(3.0, UP).guard.state is GuardState.GROUND


# Hostile clouds: the robot flies at most at 6 m/s, and its base stays inside the fence.

FACES = [(9.0, 0.0, 0.0), (-9.0, 0.0, 0.0), (0.0, 9.0, 0.0), (0.0, -9.0, 0.0), (0.0, 0.0, 9.0)]


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize("velocity", [*FACES, (0.0, 0.0, -9.0), (5.0, -5.0, 5.0), (-5.0,) * 3])
def test_full_speed_at_a_face_stops_before_it(flight, velocity):
    flight.fly(8.0, velocity)
    assert flight.room > 0.1
    assert flight.readings.position[2] > 0.25
    assert flight.guard.counts["limited_fence"] > 0


def check_hostile(simulator, seed):
    flight = Flight(simulator)
    flight.fly(1.0, UP)
    flight.fly(59.0, hostile(seed))
    assert flight.room > 0.0
    assert flight.readings.position[2] > 0.2


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize("seed", range(3))
def test_a_hostile_cloud_does_not_get_it_out_of_the_fence(simulator, seed):
    check_hostile(simulator, seed)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(3, 203))
def test_200_hostile_clouds_do_not_get_it_out_of_the_fence(simulator, seed):
    check_hostile(simulator, seed)
