# SPDX-License-Identifier: Apache-2.0

"""No limit can be switched off, and the arithmetic keeps them for any float."""

from math import hypot, inf, isfinite, nan
from unittest.mock import patch

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.config.resolved import Bounds, ResolvedGuard, speed_cap
from cloudrc.config.robot import DEFAULT_LIMITS, RobotLimits
from cloudrc.wire.messages import ZERO, GuardState
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard.hold import brake_start
from tests.fences import FENCE
from tests.world.guard.conftest import LIMITS, MS, SECOND, TICK, armed, command, run

STOP = rules.stop_coefficient(DEFAULT_LIMITS.braking_mps2)


@pytest.mark.promise("commands-within-caps")
@pytest.mark.parametrize("name", ResolvedGuard.model_fields)
def test_a_limit_cannot_be_switched_off_or_changed(name):
    # Without plans, the age of commands alone counts.
    for value in (2.001 if name == "plan_max_s" else 0.0, -1.0, inf, nan):
        with pytest.raises(ValueError, match=name):
            ResolvedGuard(**{name: value})
    with pytest.raises(ValueError, match="frozen"):
        setattr(LIMITS, name, getattr(LIMITS, name))


@pytest.mark.parametrize(("age_ms", "fastest"), [(250, 6.0), (400, 5.645805), (800, 4.823043)])
def test_a_speed_beyond_the_stop_rule_is_refused(age_ms, fastest):
    # v (T + 0.2) + v^2 / 6 = 8.7 m, solved by hand.
    way = fastest * (age_ms / 1000 + rules.REACTION + fastest * STOP)
    assert way == pytest.approx(8.7, abs=1e-4), "the guard brakes as the cap assumes"
    for plan_ms in (0, age_ms // 2):
        times = {"command_age_max_ms": age_ms - plan_ms, "plan_max_s": plan_ms / 1000}
        ResolvedGuard(**times, speed_max_mps=fastest)
        with pytest.raises(ValueError, match="speed_max_mps"):
            ResolvedGuard(**times, speed_max_mps=fastest + 1e-3)
    ResolvedGuard(command_age_max_ms=10_000.0, speed_max_mps=0.5)
    with pytest.raises(ValueError, match="command_age_max_ms"):
        ResolvedGuard(command_age_max_ms=10_001.0, speed_max_mps=0.5)


def test_the_cap_is_no_higher_than_the_speed_of_the_robot():
    assert speed_cap(250.0, 0.0, Bounds(RobotLimits(speed_max_mps=1.5), 8.7)) == 1.5
    assert speed_cap(250.0, 0.0, Bounds(RobotLimits(speed_max_mps=9.0), 8.7)) == 6.0


@pytest.mark.parametrize(("hold_s", "waited_s"), [(0.1, 10), (11, 11)])
def test_on_the_ground_it_waits_for_a_mission_for_10_s_at_least(hold_s, waited_s):
    """The longest hold may be too short for a first command to arrive."""
    guard = armed(ResolvedGuard(hold_max_s=hold_s))
    guard.accept_command(command(basis_ns=-300 * MS), SECOND)  # a stale command does not count
    run(guard, 0, waited_s * SECOND + TICK)
    assert guard.state is GuardState.GROUND
    assert run(guard, waited_s * SECOND + TICK, waited_s * SECOND + 2 * TICK) == [None]
    assert (guard.state, guard.armed) == (GuardState.LAND, False)
    assert guard.take_changes()[-1].cause == f"held for {waited_s} s without the cloud"
    guard.acknowledge(62 * SECOND)
    assert guard.state is GuardState.GROUND, "without a touch-down"


ANY = st.floats(allow_nan=True, allow_infinity=True)
VECTORS = st.tuples(ANY, ANY, ANY)
PLACES = st.tuples(st.floats(-4, 10), st.floats(-9, 6), st.floats(-0.2, 3))
SPEEDS = st.tuples(*[st.floats(-8, 8)] * 3)
LOW, HIGH = FENCE.inner_low, FENCE.inner_high
MANY = settings(max_examples=400, deadline=None)


def fenced(velocity, position, low=LOW):
    return rules.limit_to_fence(velocity, position, low, HIGH, STOP)


@pytest.mark.parametrize("caution", [rules.FENCE_REACTION, rules.REACTION])
@pytest.mark.parametrize("braking", [0.1, 2.0, 3.0, 10.0])
def test_approach_speed_solves_the_stop_rule(braking, caution):
    stop = rules.stop_coefficient(braking)
    for reach in (5e-324, 0.01, 1.0, 7.0, 1e6):
        v = rules.approach_speed(reach, stop, caution)
        assert v * (caution + v / (2.0 * braking)) == pytest.approx(reach, rel=1e-12)
    for reach, speed in ((-0.1, -0.1), (-3.0, -0.5), (0.0, 0.0), (nan, 0.0), (1e6 + 1, inf)):
        assert rules.approach_speed(reach, stop, caution) == speed


@pytest.mark.parametrize("length_max", [0.5, 6.0])
@given(a=SPEEDS | VECTORS)
@MANY
def test_limit_length_limits_length_and_keeps_direction(length_max, a):
    b = rules.limit_length(a, length_max)
    if not all(map(isfinite, a)):
        assert b == ZERO
        return
    assert hypot(*b) <= length_max * (1 + 1e-15)
    assert all(x * y >= 0.0 for x, y in zip(a, b, strict=True))
    if hypot(*a) <= length_max * (1 - 1e-15):
        assert b is a


def test_limit_length_keeps_a_vector_of_the_allowed_length():
    """Otherwise it would count as limited. A slightly longer vector is not taken for NaN."""
    allowed, longer = (1.0, 0.0, 0.0), (1.0, 2.0**-26, 0.0)
    assert rules.limit_length(allowed, 1.0) is allowed
    assert rules.limit_length(longer, 1.0) == longer  # rounding makes its length 1.0 again


@given(SPEEDS, PLACES)
@MANY
def test_limit_to_fence_lets_the_robot_stop_before_each_face(velocity, position):
    axes = zip(fenced(velocity, position), position, FENCE.low, FENCE.high, strict=True)
    for v, at, low, high in axes:
        room = high - at if v > 0 else at - low
        assert v == 0.0 or 0.2 * abs(v) + v * v / 6 <= room - 0.1 + 1e-12 or room > 5


@given(SPEEDS, PLACES)
@MANY
def test_a_quick_look_at_faces_that_are_far_changes_no_bit(velocity, position):
    quick = fenced(velocity, position)
    with patch.object(rules, "ROOM", inf):  # no face is far
        assert repr(fenced(velocity, position)) == repr(quick)


@pytest.mark.parametrize(
    ("velocity", "position", "limited"),
    [
        # Beyond the margin the robot comes back.
        (ZERO, (9.1, 5.4, 1), (-0.1, -0.1, 0)),
        (ZERO, (-2.9, -8.4, 1), (0.1, 0.1, 0)),
        (ZERO, (0, 0, 2.45), (0, 0, -0.15)),
        # A robot on the floor is not told to climb.
        (ZERO, (0, 0, 0.1), ZERO),
        # Near the floor the sideways speed is limited.
        ((3, 4, 0), (0, -2, 0.2), (0.6, 0.8, 0)),
        ((3, 4, 0), (0, -2, 0.25), (3, 4, 0)),
        # A wall does not slow a robot that flies past it.
        ((0, 6, 0), (-2.5, -5, 2.2), (0, 6, 0)),
    ],
)
def test_limit_to_fence_by_hand_worked_numbers(velocity, position, limited):
    assert fenced(velocity, position) == pytest.approx(limited)


def test_the_stop_rule_holds_at_the_floor_but_not_in_land():
    v = -fenced((0.0, 0.0, -9.0), (0, 0, 1.35))[2]
    assert 0.2 * v + v * v / 6 == pytest.approx(1.0)
    down = (0.0, 0.0, -0.5)
    assert fenced(down, (0.0, 0.0, 0.1), (LOW[0], LOW[1], -inf)) == down


def test_limit_sink_limits_how_fast_the_reference_sinks():
    for wanted, before, climb, lowest in (
        (-3.0, 0.0, -0.2, -0.2 - rules.SINK_LEAD_MAX),
        (-0.6, 0.0, -0.2, -0.6),
        (-0.2 - rules.SINK_LEAD_MAX, 0.0, -0.2, -0.2 - rules.SINK_LEAD_MAX),
        (-1.0, 0.5, 3.0, 0.5),  # it does not rise again while the robot still climbs
    ):
        reference = (1.0, 0.0, wanted)
        kept = rules.limit_sink(reference, (1.0, 0.0, before), climb, speed_max=6.0)
        assert kept == (1.0, 0.0, lowest)
        assert (kept is reference) == (wanted == lowest)
    capped = rules.limit_sink((5.9, 0.0, -1.0), (0.0, 0.0, 5.9), 1e308, speed_max=6.0)
    assert hypot(*capped) == pytest.approx(6.0)


@given(SPEEDS, VECTORS)
@settings(max_examples=500, deadline=None)
def test_brake_start_is_no_faster_than_the_reference(reference, velocity):
    assert hypot(*brake_start(reference, velocity)) <= hypot(*reference)


@given(SPEEDS, SPEEDS, st.floats(1e-3, 0.1))
@MANY
def test_limit_growth_speeds_up_by_at_most_a_step(before, after, step):
    kept, exact = rules.limit_growth(before, after, step), (-step, 0.0, 0.0)
    assert rules.limit_growth(ZERO, exact, step) is exact
    grown = [rules.growth(a, b) for a, b in zip(before, kept, strict=True)]
    assert hypot(*grown) <= step * (1 + 1e-12) + 1e-15
    for wanted, got in zip(after, kept, strict=True):
        assert abs(got) <= abs(wanted)
        assert got * wanted >= 0.0
    if hypot(*(rules.growth(a, b) for a, b in zip(before, after, strict=True))) <= step:
        assert kept == pytest.approx(after, abs=1e-15)


@pytest.mark.parametrize(
    ("before", "after", "grown"),
    [(1.0, 3.0, 2.0), (3.0, 1.0, 0.0), (-1.0, 3.0, 3.0), (1.0, -3.0, 3.0), (-1.0, -3.0, 2.0)],
)
def test_growth_is_the_speed_up_away_from_rest(before, after, grown):
    assert rules.growth(before, after) == grown
