# SPDX-License-Identifier: Apache-2.0

"""The guard with a simulated robot: it brakes, holds, lands, stops, and resists hostile clouds."""

from math import dist, hypot
from random import Random

import pytest

from cloudrc.physics.geometry.fence import TAKE_OFF_MARGIN, Fence
from cloudrc.wire.messages import GuardState
from cloudrc.world.guard.state import Guard
from tests.conftest import nightly
from tests.fences import FENCE
from tests.world.guard.conftest import LIMITS, SECOND, UP, Flight, hostile


@pytest.fixture
def flight(simulator):
    """Return a flight at a height of 1.5 m, at rest."""
    flight = Flight(simulator)
    flight.fly(1.5, UP)
    return flight.fly(2.0, (0.0, 0.0, 0.0))


@pytest.mark.parametrize("velocity", [(0.0, -1.0, 0.3), *nightly((1.5, 0.0, 0.0))])
def test_without_commands_it_holds_and_lands_after_a_minute(flight, velocity):
    flight.fly(1.2, velocity)
    flight.fly(0.26)
    assert flight.guard.state is GuardState.HOLD
    flight.fly(1.0)
    still = flight.readings.position
    for _ in range(58):
        flight.fly(1.0)
        assert flight.speed < 0.05
        assert dist(flight.readings.position, still) < 0.10
    flight.fly(1.0)
    assert flight.guard.state is GuardState.LAND
    start, speeds = flight.readings.position, []
    while flight.guard.step(flight.now_ns, flight.readings, 0.0) is not None:
        flight.fly(0.1)
        speeds.append(-flight.readings.velocity[2])
        assert len(speeds) < 80
    assert max(speeds) < 0.65
    x, y, z = flight.readings.position
    assert z == pytest.approx(0.1, abs=0.01)
    assert hypot(x - start[0], y - start[1]) < 0.10
    flight.fly(1.0)
    assert flight.speed < 0.01


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 1.0), (1.5, 0.5, 2.0), (6.0, 0.0, 0.3)])
def test_a_take_off_aborted_at_any_time_does_not_scrape(simulator, velocity):
    ends = set()
    for centiseconds in (1, 3, 4, 5, 6, 7, 8, 10, 14, 20, 25, 40):
        flight = Flight(simulator).fly(0.02).fly(centiseconds / 100, velocity)
        simulator.take_contacts()
        flight.guard.end_mission(flight.now_ns)
        while flight.guard.state is not GuardState.GROUND and flight.now_ns < 6 * SECOND:
            flight.fly(0.01)
        assert flight.guard.state is GuardState.GROUND or simulator.take_contacts() == []
        assert flight.readings.position[2] > 0.29 or flight.guard.state is GuardState.GROUND
        assert flight.speed < 0.2
        ends.add(flight.guard.state)
    assert ends == {GuardState.GROUND, GuardState.HOLD}


# Hostile clouds: the robot flies at most at 6 m/s, and its base stays inside the fence.

FACES = [(9.0, 0.0, 0.0), (-9.0, 0.0, 0.0), (0.0, 9.0, 0.0), (0.0, -9.0, 0.0), (0.0, 0.0, 9.0)]
NIGHTLY = pytest.mark.full


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize("velocity", [*FACES, (0.0, 0.0, -9.0), (5.0, -5.0, 5.0), (-5.0,) * 3])
def test_full_speed_at_a_face_stops_before_it(flight, velocity):
    flight.fly(8.0, velocity)
    assert flight.room > 0.1
    assert flight.readings.position[2] > 0.25
    assert flight.guard.counts["limited_fence"] > 0


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize(
    "seeds", [range(1), pytest.param(range(1, 203), marks=NIGHTLY)], ids=("1", "202")
)
def test_a_hostile_cloud_does_not_get_it_out_of_the_fence(simulator, seeds):
    for seed in seeds:
        flight = Flight(simulator)
        flight.fly(1.0, UP)
        flight.fly(59.0, hostile(seed))
        assert flight.room > 0.0, seed
        assert flight.readings.position[2] > 0.2, seed


def stopped_by(simulator, seed, longest):
    """Fly a hostile cloud's commands for up to `longest` [s], then stop the rotors."""
    rng, flight = Random(seed), Flight(simulator)
    flight.fly(1.0, UP)
    flight.fly(rng.uniform(*longest), hostile(seed))
    flight.guard.stop(flight.now_ns)
    flight.fly(4.0)
    return rng, flight


@pytest.mark.parametrize("seeds", [range(5), pytest.param(range(5, 400), marks=NIGHTLY)])
def test_a_stopped_robot_lies_within_the_documented_distance(simulator, seeds):
    """docs/safety.md names a distance that no fall has reached."""
    outside = max(-stopped_by(simulator, seed, (1.0, 12.0))[1].room for seed in seeds)
    assert outside <= 1.5


def scrape(simulator, seed, room):
    """Return its smallest distance to a wall when it takes off from where it fell [m]."""
    rng, flight = stopped_by(simulator, seed, (0.3, 5.0))
    lies, axis, sign = flight.readings.position, rng.randrange(2), rng.choice((-1, 1))
    faces = {1: list(FENCE.high), -1: list(FENCE.low)}
    faces[sign][axis] = lies[axis] + sign * room
    faces[-sign][axis] = lies[axis] - sign * 5.0
    fence = Fence(tuple(faces[-1]), tuple(faces[1]))
    flight.guard = flight.robot.guard = Guard(LIMITS, fence)
    flight.guard.start_mission(flight.now_ns)
    outwards = [0.0, 0.0, rng.choice((-6.0, -0.3, 0.0, 0.2))]
    outwards[axis], outwards[1 - axis] = sign * rng.choice((0.1, 0.5, 6.0)), rng.choice((0, -3, 3))
    nearest = room
    for _ in range(60):
        flight.fly(0.05, tuple(outwards))
        nearest = min(nearest, sign * (faces[sign][axis] - flight.readings.position[axis]))
    return nearest


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize("seeds", [(48, 86, 90, 101), pytest.param(range(400), marks=NIGHTLY)])
def test_a_take_off_scrapes_less_far_than_to_the_fence(simulator, seeds):
    """A tilted robot scrapes along the floor before it rises. The four have the longest ways."""
    nearest = min(scrape(simulator, seed, TAKE_OFF_MARGIN) for seed in seeds)
    assert nearest >= 0.02
