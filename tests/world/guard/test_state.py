# SPDX-License-Identifier: Apache-2.0

"""How the guard is armed, limits commands, holds, lands, stops, and takes off."""

from dataclasses import replace
from math import cos, dist, inf, nan, nextafter, radians, sin

import pytest

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.physics.geometry.fence import FLOOR_MARGIN
from cloudrc.physics.sim.readings import Readings
from cloudrc.wire.messages import ZERO, Cause, GuardState
from cloudrc.world.guard.hold import LAND_SPEED, STILL_SPEED
from cloudrc.world.guard.limits import COMMAND_MAX, ramp_ns
from cloudrc.world.guard.state import Guard
from tests.fences import FENCE
from tests.world.guard.conftest import (
    DT,
    HERE,
    LIMITS,
    MS,
    SECOND,
    TICK,
    armed,
    bring_down,
    command,
    feed,
    holding,
    landing,
    run,
    sensed,
    states,
    stopped,
    tracking,
)

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
LOW, NEAR, SINKS = (1.0, 2.0, 0.1), (1.0, 2.0, FLOOR_MARGIN), (0.0, 0.0, -LAND_SPEED)
BAD = command((nan, 0.0, 0.0))
DOWN = "at rest, switched off"


def told(guard):
    """Return the last change of the state: time, state, words."""
    change = guard.take_changes()[-1]
    assert guard.state is change.state
    return tuple(change)


# Arming


@pytest.mark.promise("only-the-operator-arms")
def test_fresh_commands_alone_never_arm():
    guard = Guard(LIMITS, FENCE)
    assert guard.accept_command(command(), 0) is None
    assert run(guard, 0, 10 * MS) == [None] * 5  # the rotors are stopped
    assert (guard.state, guard.armed, guard.reference, guard.yaw_rate) == (GROUND, False, ZERO, 0.0)
    assert (guard.changes, guard.cause) == ([], Cause.SPAWN)
    guard.start_mission(10 * MS)
    assert run(guard, 10 * MS, 12 * MS) == [None], "a command from before the start is not flown"
    guard.accept_command(command(basis_ns=12 * MS), 12 * MS)
    assert told(guard) == (12 * MS, TRACK, "fresh command")
    guard.start_mission(20 * MS)
    guard.acknowledge(20 * MS)
    run(guard, 20 * MS, 30 * MS)
    assert guard.state is TRACK, "a second start within a mission forgets nothing"


def test_put_on_the_ground_nothing_is_armed_or_remembered():
    guard = tracking()
    run(guard, 0, 300 * MS)
    now_ns = feed(guard, 300 * MS, 80)
    guard.put_on_ground(now_ns, "mission starts from spawn")
    assert told(guard) == (now_ns, GROUND, "mission starts from spawn")
    assert (guard.cause, guard.armed, guard.reference) == (Cause.SPAWN, False, ZERO)
    guard.accept_command(command(basis_ns=now_ns), now_ns)
    assert guard.state is GROUND
    guard.start_mission(now_ns)
    feed(guard, now_ns, 1, (0.0, 0.0, 1.0))
    assert guard.state is TRACK, "the last TRACK and HOLD do not count"
    assert guard.reference[2] == pytest.approx(12.0 * 0.01), "nor does their ramp"


# Limits of a command


@pytest.mark.parametrize("bad", [nan, inf, nextafter(COMMAND_MAX, inf), -1000.1])
@pytest.mark.parametrize("axis", range(4))
def test_a_command_with_an_absurd_value_is_rejected(bad, axis):
    guard = tracking((0.5, 0.0, 0.0))
    before = run(guard, 0, 100 * MS)[-1]
    *velocity, yaw_rate = (bad if k == axis else 0.1 for k in range(4))
    assert guard.accept_command(command(velocity, 100 * MS, yaw_rate), 100 * MS) == "range"
    assert run(guard, 100 * MS, 102 * MS) == [before]
    assert guard.yaw_rate == 0.0


@pytest.mark.parametrize(
    ("age_ns", "answer"),
    [(0, None), (250 * MS, None), (250 * MS + 1, "stale"), (-1, "future"), (1 << 62, "stale")],
)
def test_a_command_is_fresh_while_its_basis_is(age_ns, answer):
    now_ns = 10 * SECOND
    assert armed().accept_command(command(basis_ns=now_ns - age_ns), now_ns) == answer


@pytest.mark.parametrize(
    ("asked", "allowed"), [(0.4, 0.4), (7.0, 1.0), (-7.0, -1.0), (COMMAND_MAX, 1.0)]
)
def test_speed_and_yaw_rate_are_capped(asked, allowed):
    guard = armed()
    for _ in range(2):
        assert guard.accept_command(command((asked,) * 3, yaw_rate=asked), 0) is None
    assert guard.yaw_rate == allowed
    assert guard.counts["limited_yaw_rate"] == 2 * (asked != allowed)
    assert guard.counts["limited_speed"] == 2 * (abs(asked) > 6.0)
    feed(guard, 0, 60, (asked, 0.0, 0.0), position=(-2.0, 0.0, 1.0))
    assert abs(guard.reference[0]) <= 6.0
    guard.forget_commands()
    assert guard.yaw_rate == 0.0


def test_the_fence_changes_the_reference_within_the_cap():
    """Beyond the margin it returns in one axis while another axis speeds up."""
    guard = tracking((0.0, 6.0, 0.0))
    before = ZERO
    for k in range(40):
        after = guard.step(2 * MS * k, sensed((-2.8 - 0.01 * k, -3.0, 1.3), (-5.0, 0.0, 0.0)), DT)
        assert dist(before, after) <= 0.024 + 1e-15
        before = after
    assert before[0] > 0.2
    assert before[1] > 0.3
    assert guard.counts["limited_fence"] == 39
    low = tracking((0.0, 0.0, -2.0))
    assert run(low, 0, 200 * MS, (1.0, 2.0, FLOOR_MARGIN - 0.01))[-1][2] == 0.0


# From TRACK to HOLD


@pytest.mark.promise("brakes-without-commands")
def test_hold_begins_with_the_first_tick_after_the_age_limit():
    guard = tracking()
    run(guard, 0, 252 * MS)
    assert guard.state is TRACK
    run(guard, 252 * MS, 254 * MS)
    assert told(guard) == (252 * MS, HOLD, "command age 0.252 s above 0.250 s")
    assert (guard.cause, guard.brakes) == (Cause.SILENCE, False)
    feed(guard, 2 * SECOND, 20)
    assert told(guard) == (2090 * MS, TRACK, "10 fresh commands within 0.090 s")
    assert guard.cause is Cause.COMMANDS
    guard.forget_commands()
    run(guard, 2200 * MS, 2202 * MS)
    assert told(guard) == (2200 * MS, HOLD, "new session")


# From HOLD to TRACK


@pytest.mark.parametrize(
    ("count", "took_ns", "state"),
    [(9, 0, HOLD), (10, 0, TRACK), (10, SECOND // 2, TRACK), (10, SECOND // 2 + 9, HOLD)],
)
def test_ten_fresh_commands_within_half_a_second_end_a_hold(count, took_ns, state):
    guard = holding()
    for _ in range(30):
        assert guard.accept_command(command(basis_ns=0), 2 * SECOND - 1) == "stale"
    for k in range(count):
        now_ns = 2 * SECOND + k * took_ns // 9
        guard.accept_command(command(basis_ns=now_ns), now_ns)
    assert guard.state is state


def until_track(guard, start_ns):
    """Return when a stream of fresh commands from `start_ns` on ends the HOLD [ns], or None."""
    for now_ns in range(start_ns, start_ns + 3 * SECOND, 10 * MS):
        guard.accept_command(command(basis_ns=now_ns), now_ns)
        if guard.state is TRACK:
            return now_ns
    return None


def test_from_one_hold_or_track_to_the_next_it_takes_a_second():
    start_ns = 10 * SECOND
    guard = armed(now_ns=start_ns)
    feed(guard, start_ns, 300)
    guard.end_mission(start_ns + 3 * SECOND)
    guard.start_mission(start_ns + 3 * SECOND)
    # From 750 ms on the commands stay fresh until a second has passed.
    assert until_track(guard, start_ns + 3 * SECOND) == start_ns + 3750 * MS
    guard = armed(now_ns=start_ns)
    feed(guard, start_ns, 1)
    guard.forget_commands()
    run(guard, start_ns + 10 * MS, start_ns + 12 * MS)
    assert guard.state is HOLD
    assert until_track(guard, start_ns + 20 * MS) == start_ns + 1000 * MS


def test_the_end_of_a_mission_in_hold_is_recorded_once():
    """From then on the HOLD interrupts no mission, so that it no longer counts."""
    guard = holding()
    guard.take_changes()
    guard.end_mission(5 * SECOND)
    assert (guard.state, guard.armed) == (HOLD, False)
    assert told(guard) == (5 * SECOND, HOLD, Cause.ENDED.words)
    guard.end_mission(6 * SECOND)
    assert guard.take_changes() == []


@pytest.mark.parametrize(("speed_max", "ramp_s"), [(6.0, 2.0), (4.5, 1.5), (1.5, 1.0)])
def test_after_a_hold_the_ramp_lasts_until_the_cap(speed_max, ramp_s):
    """A first command of zero, or one that the reference reaches, does not end the ramp."""
    guard = holding(ResolvedGuard(speed_max_mps=speed_max))
    feed(guard, 2 * SECOND, 10, ZERO)
    assert guard.state is TRACK
    ends_ns = 2 * SECOND + 90 * MS + round(ramp_s * SECOND)
    for begin_ns, rate in ((ends_ns - 20 * MS, 3.0), (ends_ns, 12.0)):
        feed(guard, begin_ns - 10 * MS, 1, ZERO)
        assert guard.reference == ZERO, "slowing down is as fast as ever"
        feed(guard, begin_ns, 1, (1.0, 0.0, 0.0))
        assert guard.reference[0] == pytest.approx(rate * 0.01)


# To LAND


def test_a_long_hold_in_a_mission_ends_in_land():
    """Repeated starts do not delay it."""
    guard = holding(ResolvedGuard(hold_max_s=5.0))
    for second in range(2, 5):
        guard.start_mission(second * SECOND)
        run(guard, second * SECOND, second * SECOND + TICK)
    run(guard, 5 * SECOND, 5254 * MS)
    assert guard.state is HOLD
    run(guard, 5254 * MS, 5256 * MS)
    assert told(guard) == (5254 * MS, LAND, "held for 5 s without the cloud")
    assert (guard.cause, guard.armed) == (Cause.ALONE, False)
    aside = run(guard, 5256 * MS, 7 * SECOND, (1.2, 2.0, 1.0), (0.0, 0.0, -0.5))[-1]
    assert aside == pytest.approx((-0.16, 0.0, -LAND_SPEED)), "it keeps the hold point"


def test_with_fresh_commands_it_waits_until_it_may_take_off():
    """A robot that slides after a stop may not take off."""
    guard = stopped(Guard(LIMITS, FENCE))
    guard.acknowledge(0)
    guard.start_mission(0)
    for second in range(1, 120):
        guard.accept_command(command(basis_ns=second * SECOND), second * SECOND)
        run(guard, second * SECOND, second * SECOND + 3 * TICK, velocity=(0.2, 0.0, 0.0))
    assert (guard.state, guard.armed) == (GROUND, True)


def test_a_hold_that_sinks_to_its_point_does_not_land():
    """It moves like a descent and stands still as if on an obstacle."""
    guard, below = holding(), (1.0, 2.0, 2.2)
    assert run(guard, 2 * SECOND, 4 * SECOND, below)[-1] == SINKS
    assert guard.state is HOLD
    stood = run(bring_down(guard, 4 * SECOND), 4 * SECOND, 5 * SECOND, below)
    assert stood.index(None) * TICK == 400 * MS, "in LAND it does, after as long as ever"


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


@pytest.mark.parametrize("bad", [BAD, command(basis_ns=1 << 60)])
def test_five_impossible_commands_within_a_second_land(bad):
    guard = tracking((0.5, 0.0, 0.0))
    for k in range(5):
        assert guard.state is TRACK
        guard.accept_command(bad, k * 250 * MS)
        if k < 4:
            feed(guard, k * 250 * MS, 24, (0.5, 0.0, 0.0))
    assert told(guard) == (1000 * MS, LAND, "5 impossible commands within 1 s")
    assert guard.cause is Cause.IMPOSSIBLE


def test_impossible_commands_now_and_then_only_count():
    guard, now_ns, elsewhere = holding(), 2 * SECOND, (3.0, 2.0, 1.0)
    for _ in range(20):
        guard.accept_command(BAD, now_ns)
        now_ns = feed(guard, now_ns, 26, ZERO, position=elsewhere)
    assert guard.state is TRACK
    bring_down(guard, now_ns)
    assert run(guard, now_ns, now_ns + SECOND, elsewhere, SINKS)[-1] == SINKS, "where it is"
    on_ground, at_rest = armed(), tracking()
    at_rest.end_mission(0)
    for guard, state in ((on_ground, GROUND), (at_rest, HOLD)):  # nor without a mission
        for k in range(50):
            guard.accept_command(BAD, k * MS)
        assert guard.state is state


def test_land_sinks_slowly_and_stops_the_rotors_when_it_stands():
    guard = landing()
    cause = guard.cause
    down = run(guard, 2 * SECOND, 4 * SECOND, (1.0, 2.0, 0.6), SINKS)
    assert None not in down
    assert down[-1][2] == -LAND_SPEED
    stood = run(guard, 4 * SECOND, 5 * SECOND, LOW)
    assert stood.index(None) * TICK == 398 * MS  # it moved until 3.998 s
    assert set(stood[stood.index(None) :]) == {None}
    assert guard.reference == ZERO
    assert told(guard) == (4398 * MS, LAND, DOWN)
    assert guard.cause is cause, "why it landed"
    run(guard, 5 * SECOND, 6 * SECOND, LOW, (0.0, 0.0, -1.0))  # it slides off an obstacle
    guard.acknowledge(6 * SECOND)
    assert told(guard) == (6 * SECOND, GROUND, Cause.STILL_FIRST.words)
    guard.start_mission(6 * SECOND)
    feed(guard, 6 * SECOND, 1, position=LOW)
    assert guard.state is GROUND


@pytest.mark.parametrize(
    ("climb", "down_ms"),
    # At 3 m/s^2 the reference needs 83 ms to reach half the speed of the descent.
    [(0.0, 482), (STILL_SPEED, None), (-STILL_SPEED, None)],
)
def test_a_robot_that_moves_has_not_touched_down(climb, down_ms):
    stood = run(landing(), 2 * SECOND, 4 * SECOND, (1.0, 2.0, 1.0), (0.0, 0.0, climb))
    assert (stood.index(None) * TICK == down_ms * MS) if down_ms else (None not in stood)


@pytest.mark.parametrize(
    ("position", "velocity"), [(NEAR, SINKS), (HERE, (0.0, 0.0, -LAND_SPEED / 2)), (HERE, ZERO)]
)
def test_a_landing_acknowledged_too_low_goes_on_to_touch_down(position, velocity):
    """A HOLD there would scrape along the ground or climb into an obstacle."""
    guard = landing()
    run(guard, 2 * SECOND, 3 * SECOND, position, SINKS)
    guard.acknowledge(3 * SECOND)
    assert None not in run(guard, 3 * SECOND, 3 * SECOND + 300 * MS, position, velocity)
    assert guard.state is LAND
    run(guard, 3 * SECOND + 300 * MS, 5 * SECOND, position)
    assert guard.take_changes()[-1][1:] == (GROUND, DOWN)
    assert (guard.cause, guard.armed) == (Cause.DOWN, False)


def test_a_landing_acknowledged_in_a_climb_holds_once_it_sinks():
    guard, now_ns = landing(), 2 * SECOND
    guard.acknowledge(now_ns)
    for climb in (0.5, 0.0, -0.25):
        now_ns += 10 * MS
        run(guard, now_ns, now_ns + 10 * MS, velocity=(0.0, 0.0, climb))
        assert guard.state is LAND
    run(guard, now_ns + 10 * MS, now_ns + 12 * MS, velocity=(0.0, 0.0, -0.26))
    change = (now_ns + 10 * MS, HOLD, "acknowledged before touch-down")
    assert guard.take_changes()[-1] == change
    feed(guard, 3 * SECOND, 100)
    assert guard.state is HOLD, "it waits for a new start"
    guard.start_mission(5 * SECOND)
    now_ns = feed(guard, 5 * SECOND, 20)
    bring_down(guard, now_ns)
    run(guard, now_ns, now_ns + SECOND, velocity=SINKS)
    assert guard.state is LAND, "the acknowledgement does not count for the next landing"


@pytest.mark.parametrize("speed_max", [0.01, 0.2, 6.0])
def test_slow_sinking_under_a_low_cap_is_no_touch_down(speed_max):
    guard = landing(ResolvedGuard(speed_max_mps=speed_max))
    sinks = (0.0, 0.0, -0.5 * min(LAND_SPEED, 0.5 * speed_max))
    assert None not in run(guard, 2 * SECOND, 5 * SECOND, velocity=sinks)
    guard.acknowledge(5 * SECOND)
    run(guard, 5 * SECOND, 5 * SECOND + TICK, velocity=[2.01 * v for v in sinks])
    assert guard.state is HOLD, "and may be acknowledged in the air"


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
    assert (guard.state, guard.armed) == (state, False)


@pytest.mark.parametrize("make", [lambda: Guard(LIMITS, FENCE), armed, tracking, holding, landing])
@pytest.mark.parametrize(
    ("event", "text"), [("stop", "emergency stop"), ("fail", "onboard controller failed")]
)
def test_a_stop_and_a_failure_on_board_work_from_everywhere_at_once(make, event, text):
    guard = make()
    for now_ns in (3 * SECOND, 4 * SECOND):
        getattr(guard, event)(now_ns)
    assert told(guard) == (3 * SECOND, ESTOP, text)
    assert run(guard, 4 * SECOND, 4 * SECOND + 10 * MS) == [None] * 5
    assert (guard.latched, guard.armed, guard.reference) == (True, False, ZERO)


@pytest.mark.parametrize(
    ("velocity", "cause"), [(ZERO, Cause.ACKNOWLEDGED), (SINKS, Cause.STILL_FIRST)]
)
def test_an_acknowledgement_names_the_condition_of_a_take_off(velocity, cause):
    guard = stopped(tracking())
    run(guard, 1 * SECOND, 2 * SECOND, LOW, velocity)
    guard.acknowledge(2 * SECOND)
    assert told(guard) == (2 * SECOND, GROUND, cause.words)
    assert guard.cause is cause


# Turned over


def felt(tilt_deg=0.0):
    """Return the readings of a robot that is tilted about x."""
    half = radians(tilt_deg) / 2
    return Readings.of((*HERE, cos(half), sin(half), 0.0, 0.0), (0.0,) * 6)


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


# Taking off

STANDS = (0.0, 0.0, 0.1)


def taking_off(height=0.0):
    """Return a guard in TRACK that has seen its ground; it has this height since the next tick."""
    guard = armed()
    assert run(guard, 0, TICK, STANDS) == [None]
    guard.accept_command(command((0.0, 0.0, 1.0)), 0)
    run(guard, TICK, 10 * MS, (0.0, 0.0, 0.1 + height))
    assert states(guard) == [TRACK]
    return guard


def test_a_hold_on_the_ground_stops_the_rotors_not_the_mission():
    guard = taking_off(height=0.018)
    flown = run(guard, 250 * MS, 260 * MS, (0.0, 0.0, 0.118))
    assert flown[0] is not None
    assert set(flown[1:]) == {None}
    silent, not_yet = "command age 0.252 s above 0.250 s", "not off the ground yet, switched off"
    assert guard.take_changes() == [(252 * MS, HOLD, silent), (252 * MS, GROUND, not_yet)]
    assert guard.armed
    assert guard.reference == ZERO
    feed(guard, 2 * SECOND, 1, (0.0, 0.0, 1.0), position=STANDS)
    assert states(guard) == [TRACK]


@pytest.mark.promise("no-rotor-stop-in-the-air")
def test_above_the_ground_a_hold_climbs_clear_of_it():
    guard = taking_off(height=0.022)
    flown = run(guard, 10 * MS, 3 * SECOND, (0.0, 0.0, 0.122))
    assert states(guard) == [HOLD]
    assert flown[-1] == pytest.approx((0.0, 0.0, 0.8 * (FLOOR_MARGIN - 0.122)))


@pytest.mark.promise("no-rotor-stop-in-the-air")
def test_after_flying_the_rotors_do_not_stop_where_it_stood():
    """It may have taken off from a roof and be beside it now."""
    guard = taking_off(1.0)
    run(guard, 10 * MS, 3 * SECOND, STANDS)
    assert states(guard) == [HOLD]
    feed(guard, 3 * SECOND, 20, ZERO, position=STANDS)
    run(guard, 4 * SECOND, 6 * SECOND, STANDS)
    assert states(guard) == [TRACK, HOLD]


def test_c_may_run_the_steps_of_a_fresh_command_in_the_air():
    guard, half, wanted = taking_off(1.0), (0.0, 0.0, 0.5), (0.0, 0.0, 1.0)
    next_ns, *track = guard.plain_track(10 * MS)
    assert track == [wanted, 250 * MS]
    assert next_ns > 250 * MS, "there is no plan"
    assert guard.plain_track(252 * MS) is None
    assert guard.plain_track(20 * MS)[1:] == (wanted, 250 * MS)
    planned = command(wanted, 30 * MS)._replace(plan=(half, ZERO), planned_ns=32 * MS)
    assert guard.accept_command(planned, 30 * MS) is None
    for now_ms, next_ms, velocity in ((40, 42, wanted), (42, 52, half)):
        next_ns, asked, _ = guard.plain_track(now_ms * MS)
        assert (next_ns, asked) == (next_ms * MS, velocity)


def test_c_runs_no_step_of_a_planar_robot_before_take_off():
    guard = Guard(LIMITS, replace(FENCE, ground=0.1))
    guard.start_mission(0)
    assert guard.accept_command(command((0.0, 1.0, 0.0), 0), 0) is None
    assert states(guard) == [TRACK]
    assert guard.plain_track(0) is None


def test_c_runs_the_steps_of_a_robot_on_the_ground_until_it_lands_alone():
    guard = Guard(LIMITS, FENCE)
    assert guard.stands_until(0, 10 * MS) == 10 * MS
    guard.start_mission(0)
    alone_ns = round(LIMITS.hold_max_s * SECOND)
    assert guard.stands_until(alone_ns, 2 * alone_ns) == alone_ns + 1
    run(guard, alone_ns, alone_ns + 1, STANDS)
    assert states(guard) == []
    run(guard, alone_ns + 1, alone_ns + 2, STANDS)
    assert states(guard) == [LAND]


def test_c_runs_no_step_of_a_robot_that_has_to_come_to_rest_before_take_off():
    guard = taking_off(1.0)
    guard.stop(10 * MS)
    assert guard.stands_until(10 * MS, 20 * MS) == 10 * MS
    guard.acknowledge(10 * MS)
    assert states(guard) == [ESTOP, GROUND]
    assert guard.stands_until(10 * MS, 20 * MS) == 10 * MS


def test_c_runs_no_step_after_a_hold():
    guard = taking_off(1.0)
    run(guard, 10 * MS, 2 * SECOND, (0.0, 0.0, 1.1))
    now_ns = feed(guard, 2 * SECOND, 20, (0.0, 0.0, 1.0), position=(0.0, 0.0, 1.1))
    assert states(guard) == [HOLD, TRACK]
    assert guard.plain_track(now_ns) is None
    periods = 1 + ramp_ns(6.0, 3.0) // (10 * MS)
    now_ns = feed(guard, now_ns, periods, ZERO, position=(0.0, 0.0, 1.1))
    assert guard.plain_track(now_ns) is not None
