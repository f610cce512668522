"""How the guard is armed, limits commands, and enters HOLD."""

from itertools import pairwise
from math import hypot, inf, nan, nextafter

import pytest

from cloudrc.messages import ZERO, GuardState
from cloudrc.world.guard.hold import BRAKE_MAX, HOLD_SPEED_MAX
from cloudrc.world.guard.limits import COMMAND_MAX, Limits
from cloudrc.world.guard.state import Guard
from tests.world.guard.conftest import (
    HERE,
    LIMITS,
    MS,
    SECOND,
    armed,
    command,
    feed,
    holding,
    run,
    sensed,
    states,
    tracking,
)
from tests.world.guard.test_arithmetic import SPECIAL

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
BEYOND = [value for value in (*SPECIAL, 1e308, -1e308) if abs(value) > COMMAND_MAX]


# Arming


def test_at_first_nothing_is_armed_and_nothing_flown():
    guard = Guard(LIMITS)
    assert (guard.state, guard.armed, guard.reference, guard.yaw_rate) == (GROUND, False, ZERO, 0.0)
    assert guard.changes == []


@pytest.mark.promise("only-the-operator-arms")
def test_fresh_commands_alone_never_arm():
    guard = Guard(LIMITS)
    assert guard.accept_command(command(), 0) is None
    assert guard.state is GROUND
    assert run(guard, 0, 10 * MS) == [None] * 5  # the rotors are stopped


def test_a_started_mission_waits_for_its_first_command():
    guard = armed()
    assert run(guard, 0, 10 * MS) == [None] * 5
    guard.accept_command(command(basis_ns=10 * MS), 10 * MS)
    assert guard.state is TRACK
    assert [change.cause for change in guard.take_changes()] == ["fresh command"]


def test_commands_from_before_the_start_are_not_flown():
    guard = Guard(LIMITS)
    guard.accept_command(command(), 0)
    guard.start_mission(1 * MS)
    assert run(guard, 1 * MS, 3 * MS) == [None]


def test_a_second_start_within_a_mission_forgets_nothing():
    guard = tracking()
    guard.start_mission(10 * MS)
    run(guard, 10 * MS, 20 * MS)
    assert guard.state is TRACK


def test_the_fence_changes_the_reference_within_the_cap():
    """Beyond the margin it returns in one axis while another axis speeds up."""
    guard = tracking((0.0, 6.0, 0.0))
    before = ZERO
    for k in range(40):
        now_ns, x = 2 * MS * k, -2.8 - 0.01 * k
        after = guard.step(now_ns, sensed((x, -3.0, 1.3), (-5.0, 0.0, 0.0)), 0.002)
        assert hypot(*(b - a for a, b in zip(before, after, strict=True))) <= 0.024 + 1e-15
        before = after
    assert before[0] > 0.2
    assert before[1] > 0.3


def test_put_on_the_ground_nothing_is_armed_or_remembered():
    guard = tracking()
    run(guard, 0, 10 * MS)
    guard.put_on_ground(10 * MS, "mission starts from spawn")
    assert guard.take_changes()[-1] == (10 * MS, GROUND, "mission starts from spawn")
    assert (guard.state, guard.armed, guard.reference) == (GROUND, False, ZERO)
    guard.accept_command(command(basis_ns=10 * MS), 10 * MS)
    assert guard.state is GROUND


# Limits of a command


@pytest.mark.parametrize("bad", [*BEYOND, nan, inf, -inf, nextafter(COMMAND_MAX, inf), -1000.1])
@pytest.mark.parametrize("axis", range(4))
def test_a_command_with_an_absurd_value_is_rejected(bad, axis):
    guard = tracking((0.5, 0.0, 0.0))
    before = run(guard, 0, 100 * MS)[-1]
    values = [1.0, 1.0, 1.0, 0.1]
    values[axis] = bad
    assert (
        guard.accept_command(command(tuple(values[:3]), 100 * MS, values[3]), 100 * MS) == "range"
    )
    assert run(guard, 100 * MS, 102 * MS) == [before]
    assert guard.yaw_rate == 0.0


@pytest.mark.parametrize(
    ("age_ns", "answer"),
    [(0, None), (250 * MS, None), (250 * MS + 1, "stale"), (-1, "future"), (1 << 62, "stale")],
)
def test_a_command_is_fresh_while_its_basis_is(age_ns, answer):
    now_ns = 10 * SECOND
    assert armed().accept_command(command(basis_ns=now_ns - age_ns), now_ns) == answer


def test_the_speed_is_capped_and_keeps_its_direction():
    guard = tracking((30.0, 40.0, 0.0))
    feed(guard, 10 * MS, 60, (30.0, 40.0, 0.0), position=(1.0, -3.0, 1.0))
    assert guard.reference[1] / guard.reference[0] == pytest.approx(4 / 3)
    assert 5.99 < hypot(*guard.reference) <= 6.0
    assert guard.counts["limited_speed"] == 61


@pytest.mark.parametrize("most", [COMMAND_MAX, -COMMAND_MAX])
def test_a_too_fast_command_in_range_is_shortened(most):
    guard = armed()
    assert guard.accept_command(command((most, most, most), yaw_rate=most), 0) is None
    assert guard.counts == {"limited_speed": 1, "limited_yaw_rate": 1}


@pytest.mark.parametrize(("asked", "allowed"), [(0.4, 0.4), (7.0, 1.0), (-7.0, -1.0)])
def test_the_yaw_rate_is_capped(asked, allowed):
    guard = armed()
    for _ in range(2):
        guard.accept_command(command(yaw_rate=asked), 0)
    assert guard.yaw_rate == allowed
    assert guard.counts["limited_yaw_rate"] == 2 * (asked != allowed)
    guard.forget_commands()
    assert guard.yaw_rate == 0.0


def test_the_reference_changes_within_the_acceleration_cap():
    references = run(tracking((3.0, 4.0, 0.0)), 0, 200 * MS, position=(1.0, -3.0, 1.3))
    assert references[0] == pytest.approx((12 * 0.002 * 0.6, 12 * 0.002 * 0.8, 0.0))
    assert references[-1] == pytest.approx((1.44, 1.92, 0.0))  # 12 m/s^2 for 0.2 s


def test_one_command_is_slowed_more_and_more_near_the_fence():
    guard = tracking((0.0, 2.0, 0.0))
    feed(guard, 0, 30, (0.0, 2.0, 0.0), position=(1.0, 0.0, 1.3))
    assert guard.reference == (0.0, 2.0, 0.0)
    assert guard.counts == {}
    flown = []
    for k, y in enumerate((3.0, 4.0, 4.5, 5.0, 5.4)):  # no faster than a robot can move
        start_ns = (300 + 40 * k) * MS
        flown.append(run(guard, start_ns, start_ns + 2 * MS, (1.0, y, 1.3))[0][1])
    assert flown[0] == 2.0
    assert flown[1:] == sorted(flown[1:], reverse=True)
    assert flown[-1] <= 0.0
    assert guard.counts == {"limited_fence": 4}


# From TRACK to HOLD


@pytest.mark.promise("brakes-without-commands")
def test_hold_begins_with_the_first_tick_after_the_age_limit():
    guard = tracking()
    run(guard, 0, 252 * MS)
    assert guard.state is TRACK
    run(guard, 252 * MS, 254 * MS)
    assert guard.state is HOLD
    assert guard.take_changes()[-1].cause == "command age 0.252 s above 0.250 s"


def test_a_new_session_holds_at_once_and_says_why():
    guard = tracking()
    run(guard, 0, 10 * MS)
    guard.forget_commands()
    run(guard, 10 * MS, 12 * MS)
    assert guard.take_changes()[-1][1:] == (HOLD, "new session")


def test_hold_brakes_at_once_and_then_holds_the_position():
    guard = tracking((1.5, 0.0, 0.0))
    run(guard, 0, 252 * MS, velocity=(1.5, 0.0, 0.0))
    first, *rest = run(guard, 252 * MS, 900 * MS, velocity=(1.5, 0.0, 0.0))
    assert hypot(*first) < 1.0  # below the speed of the robot, which follows late
    assert rest[-1] == ZERO
    assert guard.brakes
    run(guard, 900 * MS, 902 * MS, velocity=(0.75, 0.0, 0.0))
    run(guard, 902 * MS, 904 * MS)
    assert not guard.brakes
    assert run(guard, 904 * MS, 906 * MS, (1.02, 2.0, 1.3))[0][0] < 0.0
    far = run(guard, 906 * MS, 2 * SECOND, (3.0, 2.0, 1.3))[-1]
    assert far == pytest.approx((-HOLD_SPEED_MAX, 0.0, 0.0))


def test_a_robot_that_lags_its_reference_brakes_from_where_it_is():
    guard = tracking((5.0, 0.0, 0.0))
    run(guard, 0, 252 * MS, velocity=(0.2, 0.0, 0.0))
    assert guard.reference[0] > 2.5
    run(guard, 252 * MS, 254 * MS, velocity=(0.2, 0.0, 0.0))
    assert hypot(*guard.reference) <= 0.2


def test_the_reference_brakes_no_harder_than_its_limit():
    guard = tracking((3.0, 0.0, 0.0))
    run(guard, 0, 252 * MS, velocity=(3.0, 0.0, 0.0))
    references = run(guard, 252 * MS, 1200 * MS, velocity=(3.0, 0.0, 0.0))
    steps = [a[0] - b[0] for a, b in pairwise(references)]
    assert max(steps) <= BRAKE_MAX * 0.002 * (1 + 1e-9)


def test_the_next_hold_has_a_new_hold_point():
    guard = holding()
    now_ns = feed(guard, 2 * SECOND, 20, (0.0, 0.0, 0.0))
    assert guard.state is TRACK
    elsewhere = run(guard, now_ns, now_ns + 2 * SECOND, (3.0, 2.0, 1.3))
    assert guard.state is HOLD
    assert set(elsewhere) == {ZERO}


def test_a_command_into_the_floor_ends_above_it():
    guard = tracking((0.0, 0.0, -2.0))
    lower = run(guard, 0, 200 * MS, (1.0, 2.0, 0.40))[-1][2]
    assert 0.2 * -lower + lower * lower / 6 == pytest.approx(0.05)
    assert run(guard, 200 * MS, 210 * MS, (1.0, 2.0, 0.34))[-1][2] == 0.0


def test_position_hold_is_damped():
    guard = holding()
    assert run(guard, 2 * SECOND, 3 * SECOND, HERE, (0.0, 0.2, 0.0))[-1][1] < -0.2


def test_after_the_end_of_a_mission_it_holds_despite_commands():
    guard = tracking()
    guard.end_mission(10 * MS)
    assert guard.take_changes()[-1] == (10 * MS, HOLD, "mission ended")
    assert guard.armed is False
    feed(guard, 20 * MS, 300)
    assert guard.state is HOLD
    assert states(guard) == []


# Slow robots


def test_a_low_speed_cap_holds_for_hold_and_land_too():
    guard = tracking(limits=Limits(LIMITS.fence_low, LIMITS.fence_high, speed_max=0.2))
    run(guard, 0, 2 * SECOND)
    fastest = max(hypot(*r) for r in run(guard, 2 * SECOND, 4 * SECOND, (5.0, -2.0, 0.4)))
    assert fastest <= 0.2
    for _ in range(5):
        guard.accept_command(command((nan, 0.0, 0.0)), 4 * SECOND)
    down = run(guard, 4 * SECOND, 6 * SECOND, (5.0, -2.0, 0.4), (0.0, 0.0, -0.1))
    assert max(hypot(*r) for r in down) <= 0.2


def test_the_first_reading_may_be_anything():
    guard = tracking()
    assert guard.step(0, sensed((nan, nan, nan), (nan, inf, -inf)), 0.002) is not None
