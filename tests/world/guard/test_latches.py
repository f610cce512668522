"""When the guard lands, and how a landing or an emergency stop ends."""

from math import nan

import pytest

from cloudrc.messages import ZERO, GuardState
from cloudrc.world.guard.hold import LAND_SPEED, STILL_SPEED
from cloudrc.world.guard.state import Guard
from tests.world.guard.conftest import (
    HERE,
    LIMITS,
    MS,
    SECOND,
    TICK,
    armed,
    command,
    feed,
    holding,
    landing,
    run,
    tracking,
)

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


# Landing


def test_a_minute_of_hold_in_a_mission_ends_in_land():
    guard = holding()
    run(guard, 2 * SECOND, 60_254 * MS)
    assert guard.state is HOLD
    run(guard, 60_254 * MS, 60_256 * MS)
    held = (60_254 * MS, LAND, "held for 60 s without the cloud")
    assert guard.take_changes()[-1] == held
    assert not guard.armed


def test_repeated_starts_do_not_delay_the_landing():
    """No command need arrive for that."""
    guard = holding()
    for second in range(3, 61):
        guard.start_mission(second * SECOND)
    run(guard, 61 * SECOND, 61 * SECOND + TICK)
    assert guard.state is LAND


def test_a_mission_on_the_ground_waits_a_minute_for_its_cloud():
    """Then the state is LAND, without a touch-down."""
    guard = armed()
    guard.accept_command(command(basis_ns=-300 * MS), SECOND)  # a stale command does not count
    assert run(guard, 0, 60 * SECOND + TICK)[-1] is None
    assert (guard.state, guard.armed) == (GROUND, True)
    assert run(guard, 60 * SECOND + TICK, 60 * SECOND + 2 * TICK) == [None]
    (change,) = guard.take_changes()
    assert change == (60 * SECOND + TICK, LAND, "held for 60 s without the cloud")
    feed(guard, 61 * SECOND, 20)
    assert (guard.state, guard.armed) == (LAND, False)
    guard.acknowledge(62 * SECOND)
    assert guard.state is GROUND


def test_with_fresh_commands_it_waits_until_it_may_take_off():
    """A robot that slides after a stop may not take off."""
    guard = Guard(LIMITS)
    guard.stop(0)
    guard.acknowledge(0)
    guard.start_mission(0)
    for second in range(1, 120):
        guard.accept_command(command(basis_ns=second * SECOND), second * SECOND)
        run(guard, second * SECOND, second * SECOND + 3 * TICK, velocity=(0.2, 0.0, 0.0))
    assert (guard.state, guard.armed) == (GROUND, True)


def test_a_hold_that_sinks_to_its_point_does_not_land():
    """It moves like a descent and stands still as if on an obstacle."""
    guard = holding()
    down = run(guard, 2 * SECOND, 4 * SECOND, (1.0, 2.0, 2.2))
    assert down[-1] == (0.0, 0.0, -LAND_SPEED)
    assert guard.state is HOLD


def test_hold_between_missions_has_no_limit():
    guard = tracking()
    guard.end_mission(10 * MS)
    for minute in range(1, 10):
        run(guard, minute * 60 * SECOND, minute * 60 * SECOND + 10 * MS)
    assert guard.state is HOLD
    guard.start_mission(600 * SECOND)  # the minute counts from the next start
    run(guard, 659 * SECOND, 659 * SECOND + 2 * MS)
    assert guard.state is HOLD
    run(guard, 661 * SECOND, 661 * SECOND + 2 * MS)
    assert guard.state is LAND


@pytest.mark.parametrize(
    "bad", [command((nan, 0.0, 0.0)), command((1e308, 0.0, 0.0)), command(basis_ns=1 << 60)]
)
def test_five_impossible_commands_within_a_second_land(bad):
    guard = tracking((0.5, 0.0, 0.0))
    for k in range(5):
        assert guard.state is TRACK
        guard.accept_command(bad, k * 250 * MS)
        if k < 4:
            feed(guard, k * 250 * MS, 24, (0.5, 0.0, 0.0))
    landed = (1000 * MS, LAND, "5 impossible commands within 1 s")
    assert guard.take_changes()[-1] == landed


def test_impossible_commands_now_and_then_only_count():
    guard = tracking()
    now_ns = 0
    for _ in range(20):
        guard.accept_command(command((nan, 0.0, 0.0)), now_ns)
        now_ns = feed(guard, now_ns, 26)
    assert guard.state is TRACK
    for _ in range(5):
        guard.accept_command(command((nan, 0.0, 0.0)), now_ns)
    assert guard.state is LAND


def test_without_a_mission_impossible_commands_do_nothing():
    on_ground, at_rest = armed(), tracking()
    at_rest.end_mission(0)
    for guard, state in ((on_ground, GROUND), (at_rest, HOLD)):
        for k in range(50):
            guard.accept_command(command((nan, 0.0, 0.0)), k * MS)
        assert guard.state is state


def test_land_sinks_slowly_and_stops_the_rotors_when_it_stands():
    guard = landing()
    down = run(guard, 2 * SECOND, 4 * SECOND, (1.0, 2.0, 0.6), (0.0, 0.0, -0.5))
    assert down[-1] == pytest.approx((0.0, 0.0, -LAND_SPEED), abs=0.7)
    assert down[-1][2] == -LAND_SPEED
    assert None not in down
    stood = run(guard, 4 * SECOND, 5 * SECOND, (1.0, 2.0, 0.1))
    assert stood.index(None) * TICK == 398 * MS  # it moved until 3.998 s
    assert set(stood[stood.index(None) :]) == {None}
    assert guard.reference == ZERO
    assert guard.take_changes()[-1] == (4398 * MS, LAND, "touched down, rotors stopped")


def test_after_touch_down_it_may_slide_off_an_obstacle():
    guard = landing()
    run(guard, 2 * SECOND, 4 * SECOND, (1.0, 2.0, 0.6), (0.0, 0.0, -0.5))
    run(guard, 4 * SECOND, 5 * SECOND, (1.0, 2.0, 0.5))
    run(guard, 5 * SECOND, 6 * SECOND, (1.0, 2.0, 0.3), (0.0, 0.0, -1.0))
    guard.acknowledge(6 * SECOND)
    guard.start_mission(6 * SECOND)
    feed(guard, 6 * SECOND, 1, position=(1.0, 2.0, 0.3))
    assert guard.state is GROUND
    run(guard, 7 * SECOND, 8 * SECOND, (1.0, 2.0, 0.1))
    feed(guard, 8 * SECOND, 1, position=(1.0, 2.0, 0.1))
    assert guard.state is TRACK


def test_land_from_a_fast_descent_touches_down():
    guard = tracking((0.0, 0.0, -2.0))
    assert run(guard, 0, 100 * MS, (1.0, 2.0, 1.0))[-1][2] == pytest.approx(-LAND_SPEED)
    for _ in range(5):
        guard.accept_command(command((nan, 0.0, 0.0)), 100 * MS)
    stood = run(guard, 100 * MS, 2 * SECOND, (1.0, 2.0, 1.0))
    assert 400 * MS <= stood.index(None) * TICK < 1 * SECOND


def test_a_robot_at_the_still_speed_has_not_touched_down():
    for speed in (STILL_SPEED, -STILL_SPEED):
        down = run(landing(), 2 * SECOND, 4 * SECOND, (1.0, 2.0, 1.0), (0.0, 0.0, speed))
        assert None not in down


def test_a_robot_that_does_not_sink_yet_has_not_touched_down():
    """At 3 m/s^2 the reference needs 83 ms to reach half the speed of the descent."""
    stood = run(landing(), 2 * SECOND, 4 * SECOND, (1.0, 2.0, 1.0))
    assert stood.index(None) * TICK == 482 * MS


def test_a_short_stop_of_a_descent_is_no_touch_down():
    guard = landing()
    run(guard, 2 * SECOND, 4 * SECOND, velocity=(0.0, 0.0, -0.5))
    for k in range(10):
        start_ns = 4 * SECOND + k * 400 * MS
        assert None not in run(guard, start_ns, start_ns + 390 * MS)
        assert None not in run(guard, start_ns + 390 * MS, start_ns + 400 * MS, HERE, (0, 0, -0.3))


def test_land_keeps_the_hold_point():
    guard = holding()
    run(guard, 2 * SECOND, 60_256 * MS)
    aside = run(guard, 60_256 * MS, 62 * SECOND, (1.2, 2.0, 1.0), (0.0, 0.0, -0.5))[-1]
    assert aside == pytest.approx((-0.16, 0.0, -LAND_SPEED))


def test_land_from_track_descends_where_the_robot_is():
    guard, elsewhere = holding(), (3.0, 2.0, 1.0)
    now_ns = feed(guard, 2 * SECOND, 20, ZERO, position=elsewhere)
    assert guard.state is TRACK
    for _ in range(5):
        guard.accept_command(command((nan, 0.0, 0.0)), now_ns)
    assert guard.state is LAND
    down = run(guard, now_ns, now_ns + 1 * SECOND, elsewhere, (0.0, 0.0, -LAND_SPEED))
    assert down[-1] == (0.0, 0.0, -LAND_SPEED)


# Latches


@pytest.mark.promise("only-the-operator-arms")
@pytest.mark.parametrize("make", [landing, lambda: stopped(tracking())])
def test_only_an_acknowledgement_leads_out_of_a_latch(make):
    guard = make()
    state = guard.state
    assert guard.latched
    guard.start_mission(3 * SECOND)
    feed(guard, 3 * SECOND, 100)
    guard.end_mission(4 * SECOND)
    assert guard.state is state
    assert not guard.armed


def stopped(guard, now_ns=0):
    guard.stop(now_ns)
    return guard


@pytest.mark.parametrize("make", [lambda: Guard(LIMITS), armed, tracking, holding, landing])
def test_the_emergency_stop_works_from_everywhere_at_once(make):
    guard = stopped(make(), 3 * SECOND)
    assert guard.state is ESTOP
    assert run(guard, 3 * SECOND, 3 * SECOND + 10 * MS) == [None] * 5
    assert guard.reference == ZERO
    assert guard.take_changes()[-1] == (3 * SECOND, ESTOP, "emergency stop")
    stopped(guard, 4 * SECOND)
    assert guard.take_changes() == []


def test_an_acknowledged_stop_is_on_the_ground_and_arms_nothing():
    guard = stopped(tracking())
    guard.acknowledge(1 * SECOND)
    assert (guard.state, guard.armed, guard.latched) == (GROUND, False, False)
    feed(guard, 1 * SECOND, 20)
    run(guard, 1 * SECOND, 2 * SECOND)
    assert guard.state is GROUND
    guard.start_mission(2 * SECOND)
    feed(guard, 2 * SECOND, 1)
    assert guard.state is TRACK


@pytest.mark.parametrize(
    ("position", "velocity", "condition"),
    [
        ((1.0, 2.0, 0.1), ZERO, ""),
        (
            (1.0, 2.0, 0.1),
            (0.0, 0.0, -0.5),
            ", takes off once it has been still, 0.5 m inside the fence",
        ),
        ((9e9, 2.0, 0.1), ZERO, ", takes off once it has been still, 0.5 m inside the fence"),
    ],
)
def test_an_acknowledgement_names_the_condition_of_a_take_off(position, velocity, condition):
    guard = stopped(tracking())
    run(guard, 1 * SECOND, 2 * SECOND, position, velocity)
    guard.acknowledge(2 * SECOND)
    assert guard.take_changes()[-1] == (2 * SECOND, GROUND, f"acknowledged{condition}")


def test_a_landing_that_is_acknowledged_in_the_air_holds():
    guard = landing()
    run(guard, 2 * SECOND, 3 * SECOND, velocity=(0.0, 0.0, -0.5))
    guard.acknowledge(3 * SECOND)
    run(guard, 3 * SECOND, 3 * SECOND + TICK, velocity=(0.0, 0.0, -0.5))
    assert guard.take_changes()[-1] == (3 * SECOND, HOLD, "acknowledged before touch-down")
    assert run(guard, 3 * SECOND + TICK, 5 * SECOND)[-1] == ZERO
    feed(guard, 5 * SECOND, 100)
    assert guard.state is HOLD


def test_a_landing_that_is_acknowledged_on_the_ground_is_over():
    guard = landing()
    run(guard, 2 * SECOND, 4 * SECOND, (1.0, 2.0, 0.1))
    guard.acknowledge(4 * SECOND)
    assert guard.take_changes()[-1] == (4 * SECOND, GROUND, "acknowledged")


@pytest.mark.parametrize("make", [lambda: Guard(LIMITS), armed, tracking, holding])
def test_in_other_states_an_acknowledgement_does_nothing(make):
    guard = make()
    state, armed_before = guard.state, guard.armed
    guard.take_changes()
    guard.acknowledge(2 * SECOND)
    assert (guard.state, guard.armed, guard.take_changes()) == (state, armed_before, [])
