"""A robot that has turned over stops its rotors, and only the operator releases it."""

from math import cos, radians, sin

import pytest

from cloudrc.messages import ZERO, Cause, GuardState
from cloudrc.world.guard.limits import RECHECK_NS
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


def felt(tilt_deg=0.0):
    """Return the readings of a robot that is tilted about x."""
    half = radians(tilt_deg) / 2
    return Readings.of((*HERE, cos(half), sin(half), 0.0, 0.0), (*ZERO, *ZERO))


@pytest.mark.parametrize("make", [tracking, holding, landing])
@pytest.mark.parametrize("tilt_deg", [79.0, -120.0])
def test_a_robot_that_turns_over_stops_its_rotors(make, tilt_deg):
    guard, now_ns = make(), 10 * MS if make is tracking else 2 * SECOND
    assert guard.step(now_ns - TICK, felt(78.0), DT) is not None, "almost"
    assert guard.step(now_ns, felt(tilt_deg), DT) is None
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


def test_a_robot_with_stopped_rotors_may_lie_on_its_back():
    landed = landing()
    run(landed, 2 * SECOND, 5 * SECOND, (1.0, 2.0, 0.1))
    for guard, now_ns in ((armed(), 0), (landed, 5 * SECOND)):
        state = guard.state
        assert guard.step(now_ns, felt(180.0), DT) is None
        assert guard.state is state


@pytest.mark.parametrize("flown_ticks", range(50, 57))
def test_a_steady_flight_notices_it_within_12_ms(flown_ticks):
    guard = armed()
    for now_ns in range(0, (flown_ticks + 7) * TICK, TICK):
        guard.accept_command(command((0.0, 0.0, 0.5), now_ns), now_ns)
        guard.step(now_ns, felt(120.0 * (now_ns >= flown_ticks * TICK)), DT)
    tracks, hit = guard.take_changes()
    assert (tracks.state, hit.state) == (TRACK, ESTOP)
    assert hit.stamp_ns - flown_ticks * TICK <= RECHECK_NS + TICK
