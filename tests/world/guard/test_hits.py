"""A robot that has turned over stops its rotors, and only the operator releases it."""

from math import cos, radians, sin

import pytest

from cloudrc.messages import ZERO, Cause, GuardState
from cloudrc.world.guard.limits import RECHECK_NS
from cloudrc.world.guard.state import OVERTURNED_COSINE
from cloudrc.world.readings import Readings
from tests.world.guard.conftest import (
    DT,
    HERE,
    MS,
    SECOND,
    TICK,
    armed,
    command,
    holding,
    landing,
    run,
    tracking,
)

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


def felt(tilt_deg=0.0, velocity=ZERO, rate=ZERO):
    """Return the readings of a robot that is tilted about x."""
    half = radians(tilt_deg) / 2
    return Readings.of((*HERE, cos(half), sin(half), 0.0, 0.0), (*velocity, *rate))


@pytest.mark.parametrize("make", [tracking, holding, landing])
@pytest.mark.parametrize(
    ("tilt_deg", "stops"), [(78.0, False), (79.0, True), (-120.0, True), (180.0, True)]
)
def test_a_robot_that_turns_over_stops_its_rotors(make, tilt_deg, stops):
    assert cos(radians(78.5)) == pytest.approx(OVERTURNED_COSINE, abs=0.001)
    guard = make()
    now_ns = 10 * MS if make is tracking else 2 * SECOND
    assert (guard.step(now_ns, felt(tilt_deg), DT) is None) == stops
    assert (guard.state is ESTOP) == stops


@pytest.mark.parametrize("make", [tracking, holding, landing])
def test_turned_over_the_rotors_stop_and_the_mission_is_over(make):
    guard = make()
    now_ns = 10 * MS if make is tracking else 2 * SECOND
    assert guard.step(now_ns, felt(120.0), DT) is None
    assert guard.take_changes()[-1] == (now_ns, ESTOP, Cause.OVERTURNED.words)
    assert (guard.armed, guard.latched, guard.reference) == (False, True, ZERO)
    assert guard.accept_command(command(basis_ns=now_ns), now_ns) is None
    assert run(guard, now_ns + TICK, now_ns + 10 * MS) == [None] * 4
    guard.acknowledge(now_ns + 10 * MS)
    assert guard.state is GROUND


def test_between_two_checks_the_readings_are_not_used():
    """The usual tick is fast."""
    guard = tracking((0.5, 0.0, 0.0))
    run(guard, 0, 200 * MS)
    guard.accept_command(command((0.5, 0.0, 0.0), 200 * MS), 200 * MS)
    run(guard, 300 * MS, 300 * MS + TICK)
    for now_ns in (302 * MS, 310 * MS):
        assert guard.step(now_ns, None, DT) == (0.5, 0.0, 0.0)


def test_a_robot_on_the_ground_may_lie_on_its_back():
    guard = armed()
    assert guard.step(0, felt(180.0), DT) is None
    assert guard.state is GROUND


def test_a_robot_that_has_landed_may_turn_over():
    guard = landing()
    run(guard, 2 * SECOND, 5 * SECOND, (1.0, 2.0, 0.1))
    assert guard.take_changes()[-1].cause == "touched down, rotors stopped"
    assert guard.step(5 * SECOND, felt(90.0), DT) is None
    assert guard.state is LAND


@pytest.mark.parametrize("flown_ticks", range(50, 57))
def test_a_steady_flight_notices_it_within_12_ms(flown_ticks):
    guard = armed()
    for now_ns in range(0, (flown_ticks + 7) * TICK, TICK):
        over = now_ns >= flown_ticks * TICK
        guard.accept_command(command((0.0, 0.0, 0.5), now_ns), now_ns)
        guard.step(now_ns, felt(120.0 if over else 0.0), DT)
    changes = guard.take_changes()
    assert [change.state for change in changes] == [TRACK, ESTOP]
    assert changes[1].stamp_ns - flown_ticks * TICK <= RECHECK_NS + TICK
