"""The guard's arithmetic stays within its bounds for any float, special ones included."""

from itertools import product
from math import hypot, inf, isfinite, nan, nextafter, sqrt

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.messages import ZERO
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard.hold import brake_rate, brake_start
from tests.world.guard.conftest import LIMITS

BIG, TINY = 1.7976931348623157e308, 5e-324
SPECIAL = (0.0, -0.0, 1.0, -1.0, 6.0, TINY, -TINY, 2.2e-308, 1e154, -1e200, BIG, -BIG)
SPECIAL_BAD = (*SPECIAL, nan, inf, -inf)
ANY = st.floats(allow_nan=True, allow_infinity=True)
VECTORS = st.tuples(ANY, ANY, ANY)
PLACES = st.tuples(st.floats(-4, 10), st.floats(-9, 6), st.floats(-0.2, 3))
SPEEDS = st.tuples(*[st.floats(-8, 8)] * 3)


def test_stopping_distance_is_that_of_the_stop_rule():
    assert rules.stopping_distance(6.0, 0.45) == pytest.approx(8.7)


@pytest.mark.parametrize("reach", [TINY, 1e-9, 0.01, 0.5, 1.0, 7.0, 1000.0])
@pytest.mark.parametrize("caution", [rules.FENCE_REACTION, rules.REACTION])
def test_approach_speed_solves_the_stop_rule(reach, caution):
    v = rules.approach_speed(reach, caution)
    assert v * (caution + v / 6) == pytest.approx(reach, rel=1e-12)


@pytest.mark.parametrize(("reach", "back"), [(-0.1, -0.1), (-0.5, -0.5), (-3.0, -0.5), (0.0, 0.0)])
def test_beyond_a_face_the_return_speed_grows_with_distance(reach, back):
    assert rules.approach_speed(reach) == back


def test_approach_speed_of_nan_is_zero():
    assert rules.approach_speed(nan) == 0.0


def test_nearer_is_never_faster():
    speeds = [rules.approach_speed(k * 0.001 - 2.0) for k in range(12_000)]
    assert speeds == sorted(speeds)
    assert speeds[0] == -rules.RETURN_SPEED_MAX


@pytest.mark.parametrize("value", SPECIAL_BAD)
def test_clamp_stays_in_its_interval(value):
    assert -2.0 <= rules.clamp(value, -2.0, 3.0) <= 3.0


@pytest.mark.parametrize("length_max", [0.5, 6.0])
def test_limit_length_limits_length_and_keeps_direction(length_max):
    for a in product(SPECIAL_BAD, repeat=3):
        b = rules.limit_length(a, length_max)
        if not all(map(isfinite, a)):
            assert b == ZERO
            continue
        assert hypot(*b) <= length_max * (1 + 1e-15)
        assert all(x * y >= 0.0 for x, y in zip(a, b, strict=True))
        if hypot(*a) <= length_max * (1 - 1e-15):
            assert b is a


def test_limit_length_keeps_a_vector_of_the_allowed_length():
    """Otherwise it would count as limited. A slightly longer vector is not taken for NaN."""
    allowed, longer = (1.0, 0.0, 0.0), (1.0, 2.0**-26, 0.0)
    assert rules.limit_length(allowed, 1.0) is allowed
    assert rules.limit_length(longer, 1.0) == longer  # rounding makes its length 1.0 again


@pytest.mark.parametrize("step", [1e-9, 0.024, 3.0])
def test_step_towards_moves_by_at_most_a_step(step):
    assert rules.step_towards((0.0, 0.0, 0.0), (3.0, 0.0, 4.0), step)[2] == pytest.approx(
        0.8 * step
    )
    for share in (0.5, 1.0):
        end = (share * step, 0.0, 0.0)
        assert rules.step_towards(ZERO, end, step) is end


LOW = tuple(low + margin for low, margin in zip(LIMITS.fence_low, (0.2, 0.2, 0.35), strict=True))
HIGH = tuple(high - rules.FENCE_MARGIN for high in LIMITS.fence_high)


@given(SPEEDS, PLACES)
@settings(max_examples=1000, deadline=None)
def test_limit_to_fence_lets_the_robot_stop_before_each_face(velocity, position):
    limited = rules.limit_to_fence(velocity, position, LOW, HIGH)
    for v, at, low, high in zip(
        limited, position, LIMITS.fence_low, LIMITS.fence_high, strict=True
    ):
        room = high - at if v > 0 else at - low
        assert v == 0.0 or 0.2 * abs(v) + v * v / 6 <= room - 0.1 + 1e-12 or room > 5


@given(SPEEDS, PLACES, st.tuples(*[st.floats(-rules.RECHECK_DISTANCE, rules.RECHECK_DISTANCE)] * 3))
@settings(max_examples=1000, deadline=None)
def test_far_from_the_fence_limit_to_fence_changes_nothing(velocity, position, step):
    if rules.is_far_from_fence(velocity, position, LOW, HIGH):
        near = tuple(at + d for at, d in zip(position, step, strict=True))
        assert rules.limit_to_fence(velocity, near, LOW, HIGH) == pytest.approx(velocity, abs=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_a_nan_position_is_not_far_from_the_fence(axis, bad):
    position = [1.0, 1.0, 1.0]
    assert rules.is_far_from_fence(ZERO, tuple(position), LOW, HIGH)
    position[axis] = bad
    assert not rules.is_far_from_fence(ZERO, tuple(position), LOW, HIGH)


@pytest.mark.parametrize(("axis", "sign"), [(a, s) for a in range(3) for s in (-1, 1)])
def test_far_from_the_fence_ends_where_the_robot_must_slow_down(axis, sign):
    position, velocity = [1.0, 1.0, 1.3], [0.0, 0.0, 0.0]
    velocity[axis] = 0.3 * sign
    caution = rules.REACTION if (axis, sign) == (2, -1) else rules.FENCE_REACTION
    reach = 0.3 * (caution + 0.3 / 6) + rules.RECHECK_DISTANCE
    edge = HIGH[axis] - reach if sign > 0 else LOW[axis] + reach
    for beyond, far in ((-1e-9, True), (1e-9, False)):
        position[axis] = edge + sign * beyond
        assert rules.is_far_from_fence(tuple(velocity), tuple(position), LOW, HIGH) == far


@pytest.mark.parametrize(
    ("position", "axis", "sign"),
    [((9.1, 0, 1), 0, -1), ((-2.9, 0, 1), 0, 1), ((0, 5.4, 1), 1, -1), ((0, 0, 2.45), 2, -1)],
)
def test_beyond_the_margin_the_robot_comes_back(position, axis, sign):
    assert rules.limit_to_fence(ZERO, position, LOW, HIGH)[axis] * sign > 0.05


def test_a_robot_on_the_floor_is_not_told_to_climb():
    assert rules.limit_to_fence(ZERO, (0.0, 0.0, 0.1), LOW, HIGH) == ZERO
    assert rules.limit_to_fence((0.0, 0.0, -1.0), (0.0, 0.0, 0.1), LOW, HIGH) == ZERO
    assert rules.limit_to_fence((0.0, 0.0, 0.9), (0.0, 0.0, 0.1), LOW, HIGH) == (0.0, 0.0, 0.9)


def test_near_the_floor_the_sideways_speed_is_limited():
    assert rules.limit_to_fence((3.0, 4.0, 0.0), (0, -2, 0.2), LOW, HIGH)[:2] == pytest.approx(
        (0.6, 0.8)
    )
    assert rules.limit_to_fence((3.0, 4.0, 0.0), (0, -2, 0.25), LOW, HIGH)[:2] == (3.0, 4.0)


def test_the_floor_is_approached_as_the_stop_rule_says():
    v = -rules.limit_to_fence((0.0, 0.0, -9.0), (0, 0, 1.35), LOW, HIGH)[2]
    assert 0.2 * v + v * v / 6 == pytest.approx(1.0)


def test_a_face_that_is_far_limits_nothing():
    assert rules.approach_speed(1e6) == pytest.approx(2447.7, abs=0.1)
    assert rules.approach_speed(1e6 + 1) == inf


def test_in_land_the_floor_is_no_face():
    low = (LOW[0], LOW[1], -inf)
    assert rules.limit_to_fence((0.0, 0.0, -0.5), (0.0, 0.0, 0.1), low, HIGH) == (0.0, 0.0, -0.5)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("bad", SPECIAL_BAD)
def test_limit_to_fence_of_any_reading_is_finite(bad, axis):
    position = [0.0, 0.0, 1.0]
    position[axis] = bad
    for velocity in ((6.0, 6.0, 6.0), (-6.0, -6.0, -6.0), ZERO):
        assert all(
            abs(v) <= 6.0 for v in rules.limit_to_fence(velocity, tuple(position), LOW, HIGH)
        )


def test_limit_sink_limits_how_fast_the_reference_sinks():
    kept = rules.limit_sink((1.0, 0.0, -3.0), (1.0, 0.0, 0.0), climb=-0.2, speed_max=6.0)
    assert kept == (1.0, 0.0, -0.2 - rules.SINK_LEAD_MAX)
    same = (1.0, 0.0, -0.6)
    assert rules.limit_sink(same, (1.0, 0.0, 0.0), climb=-0.2, speed_max=6.0) is same
    same = (1.0, 0.0, -0.2 - rules.SINK_LEAD_MAX)
    assert rules.limit_sink(same, (1.0, 0.0, 0.0), climb=-0.2, speed_max=6.0) is same
    # And it does not rise again while the robot still climbs.
    assert rules.limit_sink((0.0, 0.0, -1.0), (0.0, 0.0, 0.5), climb=3.0, speed_max=6.0)[2] == 0.5


@pytest.mark.parametrize("climb", SPECIAL_BAD)
def test_limit_sink_of_any_reading_stays_below_the_cap(climb):
    before = (0.0, 0.0, 5.9)
    kept = rules.limit_sink((5.9, 0.0, -1.0), before, climb, speed_max=6.0)
    assert hypot(*kept) <= 6.0 * (1 + 1e-15)


@given(SPEEDS, VECTORS)
@settings(max_examples=500, deadline=None)
def test_brake_start_is_no_faster_than_the_reference(reference, velocity):
    start = brake_start(reference, velocity)
    assert hypot(*start) <= hypot(*reference)


@pytest.mark.parametrize(("speed", "rate"), [(0.0, 1.0), (0.5, 2.0), (5.0, 5.5), (inf, 5.5)])
def test_braking_is_hard_first_and_gentle_in_the_end(speed, rate):
    assert brake_rate(speed) == rate


@given(SPEEDS, SPEEDS, st.floats(1e-3, 0.1))
@settings(max_examples=1000, deadline=None)
def test_limit_growth_speeds_up_by_at_most_a_step(before, after, step):
    kept = rules.limit_growth(before, after, step)
    grown = [rules.growth(a, b) for a, b in zip(before, kept, strict=True)]
    assert hypot(*grown) <= step * (1 + 1e-12) + 1e-15
    for wanted, got in zip(after, kept, strict=True):
        assert abs(got) <= abs(wanted)
        assert got * wanted >= 0.0
    if hypot(*(rules.growth(a, b) for a, b in zip(before, after, strict=True))) <= step:
        assert kept == pytest.approx(after, abs=1e-15)


def test_limit_growth_does_not_limit_slowing_down():
    braked = (1.0, -1.0, 0.0)
    assert rules.limit_growth((5.0, -5.0, 5.0), braked, 0.024) is braked
    a_step = (-0.25, 0.0, 0.0)
    assert rules.limit_growth(ZERO, a_step, 0.25) is a_step
    assert rules.limit_growth((3.0, 0.0, 0.0), (1.0, 1.0, 0.0), 0.5) == (1.0, 0.5, 0.0)
    assert rules.limit_growth((1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 0.25) == (-0.25, 0.0, 0.0)


@pytest.mark.parametrize(
    ("before", "after", "grown"),
    [(1.0, 3.0, 2.0), (3.0, 1.0, 0.0), (-1.0, 3.0, 3.0), (1.0, -3.0, 3.0), (-1.0, -3.0, 2.0)],
)
def test_growth_is_the_speed_up_away_from_rest(before, after, grown):
    assert rules.growth(before, after) == grown


def test_the_cap_holds_to_the_last_bit():
    """Use speeds whose square is rounded down."""
    for k in range(2000):
        v = nextafter(6.0, 0.0) / sqrt(1 + k * k * 1e-6)
        w = rules.limit_length((v, v * k * 1e-3, 0.0), 6.0 * rules.ROUNDING_FACTOR)
        assert hypot(*w) <= 6.0


def test_the_papers_flight_is_not_slowed_by_its_walls():
    """The paper's flight asks for 4.83 m/s at 2.07 m from the wall, and presses on the board."""
    for velocity, position in (
        ((-0.05, -4.83, -0.06), (-0.93, 3.4, 0.74)),
        ((0.59, 0.0, 0.0), (7.5, -6.42, 0.7)),
        ((0.08, 0.0, 0.0), (8.135, -6.42, 0.7)),
        ((2.0, -2.0, 0.0), (0.9, -4.6, 0.7)),
    ):
        assert rules.limit_to_fence(velocity, position, LOW, HIGH) == velocity


@pytest.mark.parametrize(("y", "velocity"), [(-5.0, (0.0, 6.0, 0.0)), (3.0, (0.0, -6.0, 0.0))])
def test_a_wall_does_not_slow_a_robot_that_flies_past_it(y, velocity):
    place = (LIMITS.fence_low[0] + 0.5, y, 2.2)
    assert rules.limit_to_fence(velocity, place, LOW, HIGH) == velocity
