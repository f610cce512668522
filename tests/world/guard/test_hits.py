"""After a hit the rotors stop, and only the operator releases the robot."""

from math import cos, radians, sin

import pytest

from cloudrc.messages import UPRIGHT, ZERO, Cause, GuardState
from cloudrc.world.guard.limits import RECHECK_NS
from cloudrc.world.guard.state import (
    JOLT_MAX,
    JOLT_RATE_MAX,
    OVERTURNED_COSINE,
    SPIN_MAX,
    TUMBLE_MAX,
    HitDetector,
)
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
SPUN, JOLTED, OVER = Cause.SPUN, Cause.JOLTED, Cause.OVERTURNED


def felt(velocity=ZERO, rate=ZERO, tilt_deg=0.0, position=HERE):
    """Return the readings of a robot that is tilted about x."""
    half = radians(tilt_deg) / 2
    return Readings.of((*position, cos(half), sin(half), 0.0, 0.0), (*velocity, *rate))


RATES = [
    ((0.0, 0.0, SPIN_MAX + 0.01), SPUN),
    ((0.0, 0.0, -SPIN_MAX - 0.01), SPUN),
    ((TUMBLE_MAX + 0.01, 0.0, 0.0), SPUN),
    ((0.0, -TUMBLE_MAX - 0.01, 0.0), SPUN),
    ((0.8 * TUMBLE_MAX, -0.65 * TUMBLE_MAX, 0.0), SPUN),
    ((0.0, 0.0, SPIN_MAX), None),
    ((0.8 * TUMBLE_MAX, 0.59 * TUMBLE_MAX, -SPIN_MAX), None),
]


@pytest.mark.parametrize(("rate", "cause"), RATES)
def test_a_high_rate_is_a_hit(rate, cause):
    assert HitDetector().felt(0, felt(rate=rate)) == cause


@pytest.mark.parametrize(("tilt_deg", "cause"), [(78.0, None), (79.0, OVER), (180.0, OVER)])
def test_a_robot_on_its_side_has_turned_over(tilt_deg, cause):
    assert cos(radians(78.5)) == pytest.approx(OVERTURNED_COSINE, abs=0.001)
    assert HitDetector().felt(0, felt(tilt_deg=tilt_deg)) == cause


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("after_ns", [TICK, 10 * MS])
def test_a_sudden_change_of_velocity_is_a_hit(axis, sign, after_ns):
    most = JOLT_MAX + JOLT_RATE_MAX * after_ns
    for change, cause in ((most + 0.001, JOLTED), (most - 0.001, None)):
        hits, velocity = HitDetector(), [1.0, -2.0, 0.5]
        assert hits.felt(SECOND, felt(tuple(velocity))) is None
        velocity[axis] += sign * change
        assert hits.felt(SECOND + after_ns, felt(tuple(velocity))) == cause
        assert hits.felt(SECOND + 2 * after_ns, felt(tuple(velocity))) is None


@pytest.mark.parametrize("axis", range(3))
def test_values_at_the_limits_are_no_hit(axis):
    hits, velocity = HitDetector(), [0.0, 0.0, 0.0]
    velocity[axis] = JOLT_MAX + JOLT_RATE_MAX * TICK
    at_limit = felt(rate=(TUMBLE_MAX, 0.0, SPIN_MAX))
    at_limit = at_limit._replace(axes=(*at_limit.axes[:8], OVERTURNED_COSINE))
    assert hits.felt(0, at_limit) is None
    assert hits.felt(TICK, at_limit._replace(velocity=tuple(velocity))) is None


def test_the_first_reading_is_no_hit():
    hits = HitDetector()
    assert hits.felt(0, felt((5.0, 0.0, 0.0))) is None
    hits.forget()
    assert hits.felt(TICK, felt((-5.0, 0.0, 0.0))) is None


@pytest.mark.parametrize("make", [tracking, holding, landing])
def test_after_a_hit_the_rotors_stop_and_the_mission_is_over(make):
    guard = make()
    now_ns = 10 * MS if make is tracking else 2 * SECOND
    assert guard.tick(now_ns, felt(tilt_deg=120.0), DT) is None
    assert guard.take_changes()[-1] == (now_ns, ESTOP, OVER.words)
    assert (guard.armed, guard.latched, guard.reference) == (False, True, ZERO)
    assert guard.offer(command(basis_ns=now_ns), now_ns) is None
    assert run(guard, now_ns + TICK, now_ns + 10 * MS) == [None] * 4
    guard.acknowledge(now_ns + 10 * MS)
    assert guard.state is GROUND


def test_a_hit_is_detected_within_10_ms_of_a_steady_command():
    guard = tracking((0.5, 0.0, 0.0))
    run(guard, 0, 200 * MS)
    assert guard.reference == (0.5, 0.0, 0.0)
    ticks = [guard.tick(200 * MS + k * TICK, felt(rate=(0.0, 0.0, 9.0)), DT) for k in range(6)]
    assert ticks[-1] is None


def test_between_two_checks_the_readings_are_not_used():
    """The usual tick is fast."""
    guard = tracking((0.5, 0.0, 0.0))
    run(guard, 0, 200 * MS)
    guard.offer(command((0.5, 0.0, 0.0), 200 * MS), 200 * MS)
    run(guard, 300 * MS, 300 * MS + TICK)
    for now_ns in (302 * MS, 310 * MS):
        assert guard.tick(now_ns, None, DT) == (0.5, 0.0, 0.0)


def test_a_robot_on_the_ground_detects_no_hit():
    """On the ground, stopped or landed, no hit is detected; a new flight compares nothing."""
    guard = armed()
    upside_down = felt((3.0, 0.0, 0.0), (9.0, 9.0, 9.0), 180.0)
    assert guard.tick(0, upside_down, DT) is None
    assert guard.state is GROUND
    guard.offer(command(), 2 * MS)
    guard.tick(2 * MS, felt((-3.0, 0.0, 0.0)), DT)
    assert guard.state is TRACK
    guard.put_on_ground(4 * MS, "mission starts from spawn")
    guard.start_mission(4 * MS)
    guard.offer(command(basis_ns=4 * MS), 4 * MS)
    guard.tick(4 * MS, felt((3.0, 0.0, 0.0)), DT)
    assert guard.state is TRACK


def test_a_robot_that_has_landed_detects_no_hit():
    guard = landing()
    run(guard, 2 * SECOND, 5 * SECOND, (1.0, 2.0, 0.1))
    assert guard.take_changes()[-1].cause == "touched down, rotors stopped"
    assert guard.tick(5 * SECOND, felt(tilt_deg=90.0), DT) is None
    assert guard.state is LAND


def test_readings_without_tilt_are_upright():
    assert felt() == Readings.of((*HERE, *UPRIGHT), (*ZERO, *ZERO))


@pytest.mark.parametrize("flown_ticks", range(50, 57))
def test_far_from_the_fence_a_hit_is_detected_within_12_ms(flown_ticks):
    """The guard checks every 10 ms, and a hit lasts longer."""
    guard = armed()
    for now_ns in range(0, (flown_ticks + 7) * TICK, TICK):
        hit = now_ns >= flown_ticks * TICK
        guard.offer(command((0.0, 0.0, 0.5), now_ns), now_ns)
        guard.tick(now_ns, felt(rate=(0.0, 0.0, 9.0) if hit else ZERO), DT)
    changes = guard.take_changes()
    assert [change.state for change in changes] == [TRACK, ESTOP]
    assert changes[1].stamp_ns - flown_ticks * TICK <= RECHECK_NS + TICK
