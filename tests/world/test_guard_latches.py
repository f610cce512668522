"""The guard: how it leaves HOLD, when it lands, and by whose word that ends."""

from math import nan

import pytest
from guard_play import (
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
    sensed,
    tracking,
)

from cloudrc.messages import ZERO, GuardState
from cloudrc.world.guard import LAND_SPEED, Guard

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


# From HOLD to TRACK


def resume(guard, start_ns, count, every_ns=10 * MS):
    feed(guard, start_ns, count, every_ns=every_ns)
    return guard.state


def test_ten_fresh_commands_within_half_a_second_end_a_hold():
    assert resume(holding(), 2 * SECOND, 9) is HOLD
    assert resume(holding(), 2 * SECOND, 10) is TRACK
    assert resume(holding(), 2 * SECOND, 10, every_ns=54 * MS) is TRACK
    assert resume(holding(), 2 * SECOND, 30, every_ns=56 * MS) is HOLD
    guard = holding()
    feed(guard, 2 * SECOND, 10)
    assert guard.take_changes()[-1].cause == "10 fresh commands within 0.090 s"


def test_stale_commands_do_not_count():
    guard = holding()
    for k in range(30):
        assert guard.offer(command(basis_ns=0), 2 * SECOND + k * MS) == "stale"
    assert guard.state is HOLD


def test_commands_from_before_a_hold_do_not_count():
    guard = holding()
    feed(guard, 2 * SECOND, 9)
    guard.forget_commands()
    assert resume(guard, 2100 * MS, 9) is HOLD


def test_after_a_hold_the_reference_rises_slowly_until_it_has_caught_up():
    guard = holding()
    now_ns = feed(guard, 2 * SECOND, 10, (1.0, 0.0, 0.0))
    start = guard.reference[0]
    feed(guard, now_ns, 10, (1.0, 0.0, 0.0))
    assert guard.reference[0] - start == pytest.approx(3.0 * 0.1)
    now_ns = feed(guard, now_ns + 100 * MS, 40, (1.0, 0.0, 0.0))
    assert guard.reference[0] == 1.0
    feed(guard, now_ns, 1, (2.0, 0.0, 0.0))
    assert guard.reference[0] == pytest.approx(1.0 + 12.0 * 0.01)


def test_a_link_that_comes_and_goes_does_not_chatter():
    """Fresh just long enough to be believed, then silent: again and again for 20 s."""
    guard = tracking()
    now_ns = 0
    while now_ns < 20 * SECOND:
        # The basis is as old as it may be: each burst is worth one tick of TRACK.
        for _ in range(12):
            guard.offer(command(basis_ns=now_ns - 249 * MS), now_ns)
            run(guard, now_ns, now_ns + 10 * MS)
            now_ns += 10 * MS
        run(guard, now_ns, now_ns + 20 * MS)
        now_ns += 20 * MS
    stamps = [change.stamp_ns for change in guard.take_changes()[1:]]
    assert len(stamps) > 20
    assert min(c - a for a, c in zip(stamps, stamps[2:], strict=False)) >= 1 * SECOND


def test_short_blackouts_are_over_within_a_second():
    for silent_ms in range(260, 1000, 20):
        guard = tracking()
        back_ns = silent_ms * MS
        run(guard, 0, back_ns)
        while guard.state is HOLD:
            back_ns = feed(guard, back_ns, 1)
        assert back_ns <= (silent_ms + 1000) * MS


# Landing


def test_a_minute_of_hold_in_a_mission_ends_in_land():
    guard = holding()
    run(guard, 2 * SECOND, 60_254 * MS)
    assert guard.state is HOLD
    run(guard, 60_254 * MS, 60_256 * MS)
    assert guard.take_changes()[-1][1:] == (LAND, "held for 60 s without the cloud")
    assert not guard.armed


def test_hold_between_missions_has_no_limit():
    guard = tracking()
    guard.end_mission(10 * MS)
    for minute in range(1, 10):
        run(guard, minute * 60 * SECOND, minute * 60 * SECOND + 10 * MS)
    assert guard.state is HOLD
    guard.start_mission(600 * SECOND)  # and the minute counts from the next start
    run(guard, 659 * SECOND, 659 * SECOND + 2 * MS)
    assert guard.state is HOLD
    run(guard, 661 * SECOND, 661 * SECOND + 2 * MS)
    assert guard.state is LAND


def test_a_mission_from_here_leaves_hold_as_any_other():
    guard = tracking()
    guard.end_mission(10 * MS)
    run(guard, 10 * MS, 2 * SECOND)
    guard.start_mission(2 * SECOND)
    assert resume(guard, 2 * SECOND, 9) is HOLD
    assert resume(guard, 2090 * MS, 1) is TRACK


@pytest.mark.parametrize("bad", [command((nan, 0.0, 0.0)), command(basis_ns=1 << 60)])
def test_five_impossible_commands_within_a_second_land(bad):
    guard = tracking((0.5, 0.0, 0.0))
    for k in range(5):
        assert guard.state is TRACK
        guard.offer(bad, k * 250 * MS)
        if k < 4:
            feed(guard, k * 250 * MS, 24, (0.5, 0.0, 0.0))
    assert guard.take_changes()[-1][1:] == (LAND, "5 impossible commands within 1 s")


def test_impossible_commands_now_and_then_only_count():
    guard = tracking()
    now_ns = 0
    for _ in range(20):
        guard.offer(command((nan, 0.0, 0.0)), now_ns)
        now_ns = feed(guard, now_ns, 26)
    assert guard.state is TRACK


def test_impossible_commands_lift_or_land_nothing_that_is_not_on_a_mission():
    on_ground, at_rest = armed(), tracking()
    at_rest.end_mission(0)
    for guard, state in ((on_ground, GROUND), (at_rest, HOLD)):
        for k in range(50):
            guard.offer(command((nan, 0.0, 0.0)), k * MS)
        assert guard.state is state


@pytest.mark.parametrize("make", [tracking, holding])
@pytest.mark.parametrize(("rate", "state"), [(2.9, None), (3.1, LAND), (-3.1, LAND)])
def test_a_robot_that_a_hit_has_spun_round_lands(make, rate, state):
    guard = make()
    before = guard.state
    readings = sensed()._replace(angular_velocity_body=(0.0, 0.0, rate))
    guard.tick(10 * MS if before is TRACK else 2 * SECOND, readings, 0.002)
    assert guard.state is (state or before)


def test_land_goes_down_slowly_and_stops_the_rotors_once_it_stands():
    guard = landing()
    down = run(guard, 2 * SECOND, 4 * SECOND, (1.0, 2.0, 0.6), (0.0, 0.0, -0.5))
    assert down[-1] == pytest.approx((0.0, 0.0, -LAND_SPEED), abs=0.7)
    assert down[-1][2] == -LAND_SPEED
    assert None not in down
    stood = run(guard, 4 * SECOND, 5 * SECOND, (1.0, 2.0, 0.1))
    assert stood.index(None) * TICK == pytest.approx(400 * MS, abs=TICK)
    assert set(stood[stood.index(None) :]) == {None}
    assert guard.reference == ZERO
    assert guard.take_changes()[-1][1:] == (LAND, "touched down, rotors stopped")


def test_a_descent_that_stands_still_for_a_moment_has_not_touched_down():
    guard = landing()
    run(guard, 2 * SECOND, 4 * SECOND, velocity=(0.0, 0.0, -0.5))
    for k in range(10):
        start_ns = 4 * SECOND + k * 400 * MS
        assert None not in run(guard, start_ns, start_ns + 390 * MS)
        assert None not in run(guard, start_ns + 390 * MS, start_ns + 400 * MS, HERE, (0, 0, -0.3))


def test_land_holds_the_place_that_hold_had_found():
    guard = holding()
    run(guard, 2 * SECOND, 60_256 * MS)
    aside = run(guard, 60_256 * MS, 62 * SECOND, (1.2, 2.0, 1.0), (0.0, 0.0, -0.5))[-1]
    assert aside == pytest.approx((-0.16, 0.0, -LAND_SPEED))


# Latches


@pytest.mark.promise("P-GUARD-4")
@pytest.mark.parametrize("make", [landing, lambda: stopped(tracking())])
def test_nothing_but_the_acknowledgement_leads_out_of_a_latch(make):
    guard = make()
    state = guard.state
    assert guard.latched
    assert not guard.start_mission(3 * SECOND)
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
    assert guard.take_changes()[-1].cause == "emergency stop"
    stopped(guard, 4 * SECOND)
    assert guard.take_changes() == []


def test_an_acknowledged_stop_is_on_the_ground_and_arms_nothing():
    guard = stopped(tracking())
    guard.acknowledge(1 * SECOND)
    assert (guard.state, guard.armed, guard.latched) == (GROUND, False, False)
    feed(guard, 1 * SECOND, 20)
    assert guard.state is GROUND
    assert guard.start_mission(2 * SECOND)
    feed(guard, 2 * SECOND, 1)
    assert guard.state is TRACK


def test_a_landing_that_is_acknowledged_in_the_air_holds():
    guard = landing()
    run(guard, 2 * SECOND, 3 * SECOND, velocity=(0.0, 0.0, -0.5))
    guard.acknowledge(3 * SECOND)
    assert guard.take_changes()[-1] == (3 * SECOND, HOLD, "acknowledged before touch-down")
    assert run(guard, 3 * SECOND, 5 * SECOND)[-1] == ZERO
    feed(guard, 5 * SECOND, 100)
    assert guard.state is HOLD


def test_a_landing_that_is_acknowledged_on_the_ground_is_over():
    guard = landing()
    run(guard, 2 * SECOND, 4 * SECOND, (1.0, 2.0, 0.1))
    guard.acknowledge(4 * SECOND)
    assert guard.take_changes()[-1] == (4 * SECOND, GROUND, "acknowledged")


@pytest.mark.parametrize("make", [lambda: Guard(LIMITS), armed, tracking, holding])
def test_there_is_nothing_to_acknowledge_elsewhere(make):
    guard = make()
    state, armed_before = guard.state, guard.armed
    guard.take_changes()
    guard.acknowledge(2 * SECOND)
    assert (guard.state, guard.armed, guard.take_changes()) == (state, armed_before, [])
