"""An aborted take-off: on the ground the rotors stop, above it the robot climbs clear."""

from math import hypot, nan

import pytest

from cloudrc.geometry.fence import FLOOR_MARGIN
from cloudrc.messages import ZERO, Command, GuardState
from cloudrc.world.guard.hold import (
    GROUND_SPEED_MAX,
    LIFT_OFF_HEIGHT,
    STILL_SPEED,
    STILL_TICKS,
    TakeOff,
)
from cloudrc.world.guard.state import Guard
from cloudrc.world.low_level import LowLevel
from cloudrc.world.robot import Robot
from tests.world.guard.conftest import (
    LIMITS,
    MS,
    SECOND,
    TICK,
    armed,
    command,
    feed,
    run,
    sensed,
    states,
)

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
STANDS = (0.0, 0.0, 0.1)
FENCE = (LIMITS.fence_low, LIMITS.fence_high)
NOT_YET = "not off the ground yet, rotors stopped"


def above(height):
    return (STANDS[0], STANDS[1], STANDS[2] + height)


def standing(now_ns=0):
    """Return a guard in GROUND that has seen its place; a mission has started."""
    guard = armed(now_ns=now_ns)
    assert run(guard, now_ns, now_ns + TICK, STANDS) == [None]
    return guard


def taking_off(height=0.0, now_ns=0):
    """Return a guard in TRACK whose robot has this height since the next tick."""
    guard = standing(now_ns)
    guard.accept_command(command((0.0, 0.0, 1.0), now_ns), now_ns)
    run(guard, now_ns + TICK, now_ns + 10 * MS, above(height))
    assert guard.state is TRACK
    guard.take_changes()
    return guard


# Detection of a take-off


@pytest.mark.parametrize(
    ("height", "over"),
    [
        (LIFT_OFF_HEIGHT - 1e-6, False),
        (LIFT_OFF_HEIGHT, True),
        (-LIFT_OFF_HEIGHT, True),
        (nan, True),
    ],
)
def test_a_take_off_is_over_at_the_lift_off_height(height, over):
    take_off = TakeOff(*FENCE)
    for at in (3.0, 0.0):  # the last place on the ground counts
        take_off.look(sensed((0.0, 0.0, at)), flies=False)
    take_off.look(sensed((9.0, 0.0, height)), flies=True)
    assert take_off.over == over
    assert take_off.may_end(sensed()) == (not over)
    take_off.forget()
    assert not take_off.over
    never_seen = TakeOff(*FENCE)
    never_seen.look(sensed(STANDS), flies=True)
    assert never_seen.over


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(
    ("speed", "may"), [(0.99 * GROUND_SPEED_MAX, True), (GROUND_SPEED_MAX, False)]
)
def test_at_speed_the_rotors_do_not_stop(axis, speed, may):
    velocity = [0.0, 0.0, 0.0]
    velocity[axis] = speed
    assert TakeOff(*FENCE).may_end(sensed(STANDS, tuple(velocity))) == may


# Stopped by the operator or by a hit


def stopped():
    take_off = TakeOff(*FENCE)
    take_off.forget(stopped=True)
    return take_off


def lie(take_off, ticks, position=STANDS, velocity=ZERO):
    """Let the robot lie for some ticks; tell whether it may take off then."""
    for _ in range(ticks):
        take_off.look(sensed(position, velocity), flies=False)
    return take_off.allowed


def test_stopped_it_may_take_off_once_it_has_been_at_rest():
    take_off = stopped()
    assert not lie(take_off, STILL_TICKS - 1)
    take_off.forget()  # acknowledged
    assert lie(take_off, 1)
    assert not lie(take_off, 1, velocity=(1.0, 0.0, 0.0))  # it slides off an obstacle
    assert lie(take_off, STILL_TICKS)
    take_off.look(sensed(STANDS), flies=True)
    take_off.forget()
    assert take_off.allowed


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("speed", [STILL_SPEED, nan])
def test_a_tick_in_motion_restarts_the_count_of_still_ticks(axis, speed):
    take_off, velocity = stopped(), [0.0, 0.0, 0.0]
    velocity[axis] = speed
    lie(take_off, STILL_TICKS - 1)
    assert not lie(take_off, STILL_TICKS, velocity=tuple(velocity))
    assert not lie(take_off, STILL_TICKS - 1)
    velocity[axis] = 0.99 * STILL_SPEED
    assert lie(take_off, 1, velocity=tuple(velocity))


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("face", [0, 1])
def test_outside_the_fence_a_take_off_is_not_allowed(axis, face):
    """Nor so near a wall that it would scrape out of the fence."""
    position = list(STANDS)
    edge = FENCE[face][axis] - (0.5 if axis < 2 else 0.0) * (2 * face - 1)
    position[axis] = edge
    assert lie(stopped(), STILL_TICKS, tuple(position))
    for outside in (edge + (2 * face - 1) * 1e-6, nan):
        position[axis] = outside
        assert not lie(stopped(), 2 * STILL_TICKS, tuple(position))


# On the ground


def test_a_hold_on_the_ground_stops_the_rotors_not_the_mission():
    guard = taking_off(0.9 * LIFT_OFF_HEIGHT)
    flown = run(guard, 250 * MS, 260 * MS, above(0.9 * LIFT_OFF_HEIGHT))
    assert flown[0] is not None
    assert set(flown[1:]) == {None}
    cause = "command age 0.252 s above 0.250 s"
    assert guard.take_changes() == [(252 * MS, HOLD, cause), (252 * MS, GROUND, NOT_YET)]
    assert guard.armed
    assert guard.reference == ZERO
    feed(guard, 2 * SECOND, 1, (0.0, 0.0, 1.0), position=STANDS)
    assert states(guard) == [TRACK]


def test_a_mission_that_ends_on_the_ground_ends_in_ground():
    guard = taking_off()
    guard.end_mission(10 * MS)
    assert run(guard, 10 * MS, 20 * MS, STANDS) == [None] * 5
    assert states(guard) == [HOLD, GROUND]
    assert not guard.armed


# Above the ground


def test_a_robot_that_is_fast_brakes_before_its_rotors_stop():
    guard = taking_off()
    run(guard, 10 * MS, 300 * MS, STANDS, (0.3, 0.0, 0.0))
    assert states(guard) == [HOLD]
    run(guard, 300 * MS, 310 * MS, STANDS, (0.1, 0.0, 0.0))
    assert states(guard) == [GROUND]


@pytest.mark.promise("no-rotor-stop-in-the-air")
def test_above_the_ground_a_hold_climbs_clear_of_it():
    guard = taking_off(1.1 * LIFT_OFF_HEIGHT)
    flown = run(guard, 10 * MS, 3 * SECOND, above(1.1 * LIFT_OFF_HEIGHT))
    assert states(guard) == [HOLD]
    assert flown[-1][:2] == (0.0, 0.0)
    assert flown[-1][2] == pytest.approx(0.8 * (FLOOR_MARGIN - STANDS[2] - 1.1 * LIFT_OFF_HEIGHT))


@pytest.mark.promise("no-rotor-stop-in-the-air")
def test_after_flying_the_rotors_do_not_stop_where_it_stood():
    """It may have taken off from a roof and be beside it now."""
    guard = taking_off(1.0)
    run(guard, 10 * MS, 3 * SECOND, STANDS)
    assert states(guard) == [HOLD]
    feed(guard, 3 * SECOND, 20, ZERO, position=STANDS)
    run(guard, 4 * SECOND, 6 * SECOND, STANDS)
    assert states(guard) == [TRACK, HOLD]


def test_a_take_off_within_one_tick_knows_its_ground():
    """Otherwise a robot that scrapes along the ground would count as flying."""
    guard = standing()
    guard.stop(10 * MS)
    run(guard, 10 * MS, 1 * SECOND, STANDS)
    guard.acknowledge(1 * SECOND)
    guard.start_mission(1 * SECOND)
    guard.accept_command(command((0.0, 0.0, 1.0), 1 * SECOND), 1 * SECOND)
    assert states(guard) == [ESTOP, GROUND, TRACK]
    run(guard, 1 * SECOND, 2 * SECOND, STANDS)
    assert states(guard) == [HOLD, GROUND]


# With a simulated robot


def broken_off(simulator, ticks, velocity):
    """Fly a command for some ticks, then send nothing for 6 s."""
    guard = Guard(LIMITS)
    robot = Robot(simulator, LowLevel(), guard)
    robot.put_on_ground(0, "test")
    guard.start_mission(0)
    now_ns = robot.run(0, 20 * MS)
    left_ns = now_ns + ticks * TICK
    while now_ns < left_ns:
        guard.accept_command(Command(0, min(now_ns, left_ns - 251 * MS), 0, velocity, 0.0), now_ns)
        now_ns = robot.run(now_ns, min(now_ns + 10 * MS, left_ns))
    touched = []
    for now_ns in range(left_ns, left_ns + 6 * SECOND, 10 * MS):
        robot.run(now_ns, now_ns + 10 * MS)
        touched += [touch for touch in simulator.take_contacts() if guard.state is not GROUND]
    return guard, touched


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 1.0), (1.5, 0.5, 2.0), (6.0, 0.0, 0.3)])
def test_a_take_off_aborted_at_any_time_does_not_scrape(simulator, velocity):
    ends = set()
    for ticks in (1, 5, 12, 16, 20, 28, 30, 35, 40, 50, 70, 100, 125, 200):
        guard, touched = broken_off(simulator, ticks, velocity)
        assert touched == []
        z = simulator.readings.position[2]
        assert (z < 0.11) if guard.state is GROUND else (z > 0.29)
        assert hypot(*simulator.readings.velocity) < 0.05
        ends.add(guard.state)
    assert ends == {GROUND, HOLD}
