"""The guard: what may be flown, for how long, and what happens then."""

from math import hypot, inf, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.messages import UPRIGHT, Command, GuardState
from cloudrc.world.guard import BRAKE, HOLD_SPEED_MAX, Guard, Limits
from cloudrc.world.readings import Readings

MS = 1_000_000
TICK = 2 * MS
HERE = (1.0, 2.0, 3.0)
STILL = (0.0, 0.0, 0.0)
LIMITS = Limits(command_age_max_ns=250 * MS, speed_max=6.0, acceleration_max=12.0)


def command(velocity=(1.0, 0.0, 0.0), basis_ns=0, yaw_rate=0.0):
    return Command(0, basis_ns, 0, velocity, yaw_rate)


def sensed(position, velocity):
    return Readings.of((*position, *UPRIGHT), (*velocity, *STILL))


@pytest.fixture
def guard():
    guard = Guard(LIMITS)
    guard.start_mission(0)
    return guard


def tracking(velocity, now_ns=0):
    guard = Guard(LIMITS)
    guard.start_mission(now_ns)
    guard.offer(command(velocity, basis_ns=now_ns), now_ns)
    return guard


def run(guard, start_ns, end_ns, position=HERE, velocity=STILL):
    """Tick through a time; returns the references."""
    return [
        guard.tick(now_ns, sensed(position, velocity), 0.002)
        for now_ns in range(start_ns, end_ns, TICK)
    ]


def test_fresh_commands_alone_never_arm():
    guard = Guard(LIMITS)
    assert guard.offer(command(), 0) is None
    assert guard.state is GuardState.GROUND


def test_a_started_mission_waits_on_the_ground_for_its_first_command(guard):
    assert guard.state is GuardState.GROUND
    guard.offer(command(), 0)
    assert guard.state is GuardState.TRACK


@pytest.mark.parametrize("bad", [nan, inf, -inf])
@pytest.mark.parametrize("axis", range(4))
def test_what_is_not_finite_is_refused_whole(guard, bad, axis):
    values = [1.0, 1.0, 1.0, 0.0]
    values[axis] = bad
    assert guard.offer(command(tuple(values[:3]), 0, values[3]), 0) == "not_finite"
    assert guard.state is GuardState.GROUND


@pytest.mark.parametrize(
    ("age_ms", "answer"), [(0, None), (250, None), (251, "stale"), (-1, "stale")]
)
def test_a_command_is_fresh_while_its_basis_is(guard, age_ms, answer):
    now_ns = 10_000 * MS
    assert guard.offer(command(basis_ns=now_ns - age_ms * MS), now_ns) == answer


def test_the_reference_follows_no_faster_than_the_acceleration_cap():
    references = run(tracking((3.0, 4.0, 0.0)), 0, 200 * MS)
    assert references[0] == pytest.approx((12 * 0.002 * 0.6, 12 * 0.002 * 0.8, 0.0))
    assert references[-1] == pytest.approx((1.44, 1.92, 0.0))  # 12 m/s^2 for 0.2 s


def test_the_speed_is_capped_and_keeps_its_direction():
    reference = run(tracking((30.0, 40.0, 0.0)), 0, 240 * MS)[-1]
    assert reference[1] / reference[0] == pytest.approx(4 / 3)
    guard = tracking((30.0, 40.0, 0.0))
    guard.reference = (3.6, 4.8, 0.0)
    assert guard.tick(0, sensed(HERE, STILL), 0.002) == pytest.approx((3.6, 4.8, 0.0))


def test_hold_begins_with_the_first_tick_after_the_age_limit():
    guard = tracking((1.0, 0.0, 0.0))
    run(guard, 0, 252 * MS)
    assert guard.state is GuardState.TRACK
    run(guard, 252 * MS, 254 * MS)
    assert guard.state is GuardState.HOLD
    assert guard.take_changes()[-1].cause == "command age 0.252 s above 0.250 s"


def test_hold_brakes_and_then_pulls_back_to_where_it_came_to_rest():
    guard = tracking((1.5, 0.0, 0.0))
    run(guard, 0, 252 * MS)
    speed = hypot(*guard.reference)
    references = run(guard, 252 * MS, 1252 * MS)
    assert references[0][0] == pytest.approx(speed - BRAKE * 0.002)
    assert references[-1] == STILL
    assert run(guard, 1252 * MS, 1254 * MS, (1.2, 2.0, 3.0))[0] == pytest.approx((-0.2, 0.0, 0.0))
    far = run(guard, 1254 * MS, 1256 * MS, (9.0, 2.0, 3.0))[0]
    assert hypot(*far) == pytest.approx(HOLD_SPEED_MAX)


def test_hold_waits_for_the_robot_to_come_to_rest_before_it_drops_anchor():
    guard = tracking((1.0, 0.0, 0.0))
    run(guard, 0, 1000 * MS, velocity=(0.5, 0.0, 0.0))
    assert run(guard, 1000 * MS, 1002 * MS, (5.0, 2.0, 3.0), (0.5, 0.0, 0.0)) == [STILL]
    run(guard, 1002 * MS, 1004 * MS, (6.0, 2.0, 3.0), STILL)
    assert run(guard, 1004 * MS, 1006 * MS, (6.0, 2.0, 3.0), STILL) == [STILL]


def test_a_fresh_command_ends_the_hold():
    guard = tracking((1.0, 0.0, 0.0))
    run(guard, 0, 500 * MS)
    guard.offer(command((2.0, 0.0, 0.0), basis_ns=490 * MS), 500 * MS)
    assert guard.state is GuardState.TRACK


def test_the_end_of_a_mission_holds_whatever_the_cloud_says():
    guard = tracking((1.0, 0.0, 0.0))
    guard.end_mission(10 * MS)
    assert guard.state is GuardState.HOLD
    guard.offer(command((2.0, 0.0, 0.0), basis_ns=20 * MS), 20 * MS)
    assert guard.state is GuardState.HOLD
    guard.start_mission(30 * MS)
    guard.offer(command((2.0, 0.0, 0.0), basis_ns=30 * MS), 30 * MS)
    assert guard.state is GuardState.TRACK


def test_a_mission_from_here_forgets_what_came_before_it():
    guard = tracking((1.0, 0.0, 0.0))
    guard.end_mission(10 * MS)
    guard.start_mission(20 * MS)
    assert run(guard, 20 * MS, 22 * MS)
    assert guard.state is GuardState.HOLD


def test_back_on_the_ground_nothing_is_armed():
    guard = tracking((1.0, 0.0, 0.0))
    guard.put_on_ground(10 * MS, "mission starts from spawn")
    guard.offer(command(basis_ns=10 * MS), 10 * MS)
    assert guard.state is GuardState.GROUND
    assert guard.reference == STILL


@given(
    st.lists(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3), max_size=20),
    st.floats(0.5, 20.0),
)
@settings(max_examples=60, deadline=None)
def test_whatever_is_commanded_the_reference_stays_inside_the_caps(velocities, speed_max):
    guard = Guard(Limits(speed_max=speed_max))
    guard.start_mission(0)
    before = STILL
    for number, velocity in enumerate(velocities):
        guard.offer(command(velocity, basis_ns=number * TICK), number * TICK)
        if guard.state is GuardState.GROUND:
            continue
        after = guard.tick(number * TICK, sensed(HERE, STILL), 0.002)
        assert hypot(*after) <= speed_max * (1 + 1e-12)
        step = hypot(*(b - a for a, b in zip(before, after, strict=True)))
        assert step <= 12.0 * 0.002 * (1 + 1e-9)
        before = after


@pytest.mark.parametrize(("asked", "allowed"), [(0.4, 0.4), (7.0, 1.0), (-7.0, -1.0)])
def test_the_yaw_rate_is_capped(guard, asked, allowed):
    guard.offer(command(yaw_rate=asked), 0)
    assert guard.yaw_rate == allowed
