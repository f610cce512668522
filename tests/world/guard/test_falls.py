"""Where a robot with stopped rotors comes to lie, and how it takes off again."""

from dataclasses import replace
from random import Random

import pytest

from cloudrc.messages import GuardState
from cloudrc.world.guard.hold import TAKE_OFF_MARGIN
from cloudrc.world.guard.state import Guard
from cloudrc.world.simulator import Simulator
from tests.world.guard.conftest import LIMITS, UP, Flight, hostile


@pytest.fixture(scope="module")
def simulator():
    return Simulator("pelican", "empty")


def check_stopped(simulator, seed, figure):
    """docs/safety.md names a distance that no fall has reached."""
    flight = Flight(simulator)
    flight.fly(1.0, UP)
    flight.fly(Random(seed).uniform(1.0, 12.0), hostile(seed))
    flight.guard.stop(flight.now_ns)
    flight.fly(4.0, UP)
    figure("stopped by a hostile cloud: outside the fence by", -flight.room, "<=", 1.5, "m")
    assert flight.room > -1.5


@pytest.mark.parametrize("seed", range(5))
def test_a_stopped_robot_lies_within_the_documented_distance(simulator, seed, figure):
    check_stopped(simulator, seed, figure)


@pytest.mark.full
@pytest.mark.parametrize("seed", range(5, 400))
def test_a_stopped_robot_lies_as_documented_in_400_falls(simulator, seed, figure):
    check_stopped(simulator, seed, figure)


# A tilted robot scrapes along the floor before it rises.


def scrapes(simulator, seed, room):
    """Return its smallest distance to a wall when it takes off from where it fell [m]."""
    rng, flight = Random(seed), Flight(simulator)
    flight.fly(1.0, UP)
    flight.fly(rng.uniform(0.3, 5.0), hostile(seed))
    flight.guard.stop(flight.now_ns)
    flight.fly(4.0)
    lies, axis, sign = flight.readings.position, rng.randrange(2), rng.choice((-1, 1))
    faces = {1: list(LIMITS.fence_high), -1: list(LIMITS.fence_low)}
    faces[sign][axis] = lies[axis] + sign * room
    faces[-sign][axis] = lies[axis] - sign * 5.0
    low, high = tuple(faces[-1]), tuple(faces[1])
    flight.guard = flight.robot.guard = Guard(replace(LIMITS, fence_low=low, fence_high=high))
    flight.guard.start_mission(flight.now_ns)
    outwards = [0.0, 0.0, rng.choice((-6.0, -0.3, 0.0, 0.2))]
    outwards[axis], outwards[1 - axis] = sign * rng.choice((0.1, 0.5, 6.0)), rng.choice((0, -3, 3))
    nearest = room
    for _ in range(60):
        flight.fly(0.05, tuple(outwards))
        nearest = min(nearest, sign * (faces[sign][axis] - flight.readings.position[axis]))
    return nearest


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize("seed", [48, 86, 90, 101])
def test_a_take_off_scrapes_less_far_than_to_the_fence(simulator, seed):
    """Check the seeds with the longest ways, of 400."""
    assert scrapes(simulator, seed, TAKE_OFF_MARGIN) > 0.02


@pytest.mark.full
def test_a_take_off_scrapes_less_far_in_400_take_offs(simulator, figure):
    seeds = range(400)
    nearest = min(scrapes(simulator, seed, TAKE_OFF_MARGIN) for seed in seeds)
    name = "taken off 0.5 m from the fence: nearest to it"
    figure(name, nearest, ">=", 0.02, "m", count=len(seeds))
    assert nearest > 0.02


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize("nearer", [0.01, -0.01])
def test_near_a_wall_a_stopped_robot_does_not_take_off(simulator, nearer):
    flight = Flight(simulator)
    _, y, z = LIMITS.fence_low
    far = replace(LIMITS, fence_low=(-TAKE_OFF_MARGIN + nearer, y, z))
    flight.guard = flight.robot.guard = Guard(far)
    flight.guard.stop(flight.now_ns)
    flight.fly(1.0)
    flight.guard.acknowledge(flight.now_ns)
    flight.guard.start_mission(flight.now_ns)
    flight.fly(0.1, UP)
    assert flight.guard.state is (GuardState.GROUND if nearer > 0 else GuardState.TRACK)
