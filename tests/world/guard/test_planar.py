# SPDX-License-Identifier: Apache-2.0

"""The guard of a robot that stays on the ground: no heights, HOLD and LAND brake to rest."""

from dataclasses import replace
from itertools import pairwise

import pytest

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.wire.messages import ZERO, Cause, GuardState
from tests.fences import FENCE
from tests.world.guard.conftest import DT, LIMITS, MS, SECOND, armed, bring_down, command, feed, run

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
AT = (1.0, 2.0, 0.1)
FLAT = replace(FENCE, ground=AT[2])
MOVES, FAST = (1.0, 0.0, 0.0), (4.0, 0.0, 0.0)


def waiting(limits=LIMITS, fence=FLAT, **robot):
    """Return the armed guard of a robot on the ground."""
    return armed(limits, fence=fence, stop="brake", **robot)


def driving(velocity=MOVES, limits=LIMITS, **robot):
    """Return a guard in TRACK at 1 s, whose robot moves as commanded."""
    guard = waiting(limits, **robot)
    feed(guard, 0, 100, velocity, AT, velocity)
    assert guard.state is TRACK
    return guard


def test_near_the_floor_neither_height_nor_speed_is_limited():
    guard = driving((3.0, 0.0, 0.0))
    assert guard.reference == (3.0, 0.0, 0.0)
    assert not guard.counts


@pytest.mark.parametrize("z", [2.0, -1e-9])
def test_a_vertical_velocity_is_refused_and_a_few_make_it_land(z):
    guard = driving()
    for now_ns in range(SECOND, SECOND + 5 * MS, MS):
        assert guard.state is TRACK
        assert guard.accept_command(command((1.0, 0.5, z), now_ns), now_ns) == "vertical"
    assert (guard.state, guard.cause) == (LAND, Cause.IMPOSSIBLE)


def test_a_plan_that_leaves_the_ground_is_refused():
    guard, level, climbs = waiting(), (MOVES,) * 3, (MOVES, (1.0, 0.0, 0.1))
    for plan, reason in ((level, None), (climbs, "vertical")):
        planned = command(MOVES)._replace(plan=plan, planned_ns=0)
        assert guard.accept_command(planned, 0) == reason


@pytest.mark.parametrize("climb", [-1.0, 1.0])
def test_the_reference_stays_horizontal_while_the_robot_bounces(climb):
    guard = waiting()
    feed(guard, 0, 100, MOVES, (1.0, 2.0, 0.3), (1.0, 0.0, climb))
    assert guard.reference == MOVES


def test_the_walls_of_the_fence_hold_the_robot():
    guard = waiting()
    feed(guard, 0, 100, MOVES, (FENCE.inner_high[0], 0.0, 0.1))
    assert guard.reference == ZERO
    assert guard.counts["limited_fence"]


def test_a_hold_brakes_holds_the_position_and_goes_on_with_fresh_commands():
    guard = driving()
    assert run(guard, SECOND, 2 * SECOND, AT, MOVES)[-1] == pytest.approx(ZERO)
    run(guard, 2 * SECOND, 3 * SECOND, AT)
    assert guard.state is HOLD, "a robot at rest is not put to GROUND"
    x, y, z = run(guard, 3 * SECOND, 4 * SECOND, (1.2, 2.0, 0.1))[-1]
    assert (x, y, z) == (pytest.approx(-0.16, abs=0.06), 0.0, 0.0)
    feed(guard, 4 * SECOND, 100, MOVES, AT)
    assert guard.state is TRACK


def landing():
    guard = driving(limits=ResolvedGuard(hold_max_s=1.0))
    run(guard, SECOND, 2300 * MS, AT, MOVES)  # never at rest
    assert guard.state is LAND
    return guard


def test_a_landing_is_to_brake_and_to_stop_at_rest():
    guard = landing()
    moving = run(guard, 2300 * MS, 4 * SECOND, AT, (0.2, 0.0, 0.0))
    assert None not in moving
    assert moving[-1] == pytest.approx(ZERO)
    assert run(guard, 4 * SECOND, 4500 * MS, AT)[-1] is None
    assert (guard.state, guard.armed) == (LAND, False)
    guard.acknowledge(5 * SECOND)
    assert guard.state is GROUND


def test_an_acknowledged_landing_ends_in_ground_at_rest_not_in_hold():
    guard = landing()
    guard.acknowledge(2400 * MS)
    run(guard, 2400 * MS, 3 * SECOND, AT, (0.2, 0.0, -0.4))
    assert guard.state is LAND
    run(guard, 3 * SECOND, 3500 * MS, AT)
    assert guard.state is GROUND


@pytest.mark.parametrize(("x", "moves"), [(1.0, True), (FENCE.high[0] - 0.1, True), (99.0, False)])
def test_after_a_stop_it_moves_again_once_it_is_at_rest_inside_the_fence(x, moves):
    guard = driving()
    guard.stop(SECOND)
    guard.acknowledge(SECOND)
    run(guard, SECOND, 2 * SECOND, (x, 2.0, 0.1))
    guard.start_mission(2 * SECOND)
    feed(guard, 2 * SECOND, 1, MOVES, (x, 2.0, 0.1))
    assert (guard.state is TRACK) == moves


@pytest.mark.parametrize("braking", [1.0, 3.0, 6.0])
def test_the_braking_of_the_robot_sets_how_fast_a_hold_slows_down_and_speeds_up(braking):
    guard = driving(FAST, braking_mps2=braking)
    slowed = [x for x, _, _ in run(guard, SECOND, 2 * SECOND, AT, FAST)]
    steps = [a - b for a, b in pairwise(slowed) if a > b]
    assert max(steps[1:-1]) == pytest.approx(5.5 / 3.0 * braking * DT)
    run(guard, 2 * SECOND, 4 * SECOND, AT)
    assert guard.state is HOLD
    found = []
    for now_ns in range(4 * SECOND, 5 * SECOND, 10 * MS):
        feed(guard, now_ns, 1, FAST, AT)
        found.append(guard.reference[0])
    assert guard.state is TRACK
    assert max(b - a for a, b in pairwise(found)) == pytest.approx(braking * 0.01)


def test_a_robot_in_the_air_or_water_may_brake_instead_of_landing():
    guard = armed(stop="brake")
    feed(guard, 0, 100, (0.0, 0.0, -0.4))
    bring_down(guard, SECOND)
    guard.acknowledge(SECOND)
    references = run(guard, SECOND, SECOND + 100 * MS, velocity=(0.0, 0.0, -0.4))
    assert guard.state is LAND, "it does not hold, although it sinks and is acknowledged"
    assert min(z for _, _, z in references) >= -0.4, "it does not descend faster"
    assert run(guard, SECOND + 100 * MS, 2 * SECOND)[-1] is None
    assert guard.state is GROUND


def test_after_a_stop_it_moves_again_on_a_floor_at_any_height():
    high = replace(FLAT, low=(*FENCE.low[:2], 1.0), high=(*FENCE.high[:2], 3.0), ground=1.1)
    guard = waiting(fence=high)
    guard.stop(0)
    guard.acknowledge(0)
    run(guard, 0, SECOND, (1.0, 2.0, 1.1))
    guard.start_mission(SECOND)
    feed(guard, SECOND, 1, MOVES, (1.0, 2.0, 1.1))
    assert guard.state is TRACK
