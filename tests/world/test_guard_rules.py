"""The guard's arithmetic: with any floats, the special ones first, it stays inside its bounds."""

from itertools import product
from math import hypot, inf, isfinite, nan, nextafter, sqrt

import pytest
from guard_play import DT, LIMITS, MS, TICK, armed, command, sensed
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.messages import ZERO, GuardState
from cloudrc.world import guard_rules as rules
from cloudrc.world.guard_rest import brake_rate, brake_start

BIG, TINY = 1.7976931348623157e308, 5e-324
SPECIAL = (0.0, -0.0, 1.0, -1.0, 6.0, TINY, -TINY, 2.2e-308, 1e154, -1e200, BIG, -BIG)
SPECIAL_BAD = (*SPECIAL, nan, inf, -inf)
ANY = st.floats(allow_nan=True, allow_infinity=True)
VECTORS = st.tuples(ANY, ANY, ANY)
PLACES = st.tuples(st.floats(-4, 10), st.floats(-9, 6), st.floats(-0.2, 3))
SPEEDS = st.tuples(*[st.floats(-8, 8)] * 3)


def test_the_way_to_a_stop_is_that_of_the_stop_rule():
    assert rules.stopping_distance(6.0, 0.45) == pytest.approx(8.7)


@pytest.mark.parametrize("reach", [TINY, 1e-9, 0.01, 0.5, 1.0, 7.0, 1000.0])
@pytest.mark.parametrize("caution", [rules.CAUTION, rules.REACTION])
def test_the_approach_is_the_solution_of_the_stop_rule(reach, caution):
    v = rules.approach(reach, caution)
    assert v * (caution + v / 6) == pytest.approx(reach, rel=1e-12)


def test_nearer_is_never_faster():
    speeds = [rules.approach(k * 0.001 - 2.0) for k in range(12_000)]
    assert speeds == sorted(speeds)
    assert speeds[0] == -rules.COME_BACK_MAX


@pytest.mark.parametrize("value", SPECIAL_BAD)
def test_within_answers_from_the_interval(value):
    assert -2.0 <= rules.within(value, -2.0, 3.0) <= 3.0


@pytest.mark.parametrize("length_max", [0.5, 6.0])
def test_shortened_is_short_and_points_the_same_way(length_max):
    for a in product(SPECIAL_BAD, repeat=3):
        b = rules.shortened(a, length_max)
        if not all(map(isfinite, a)):
            assert b == ZERO
            continue
        assert hypot(*b) <= length_max * (1 + 1e-15)
        assert all(x * y >= 0.0 for x, y in zip(a, b, strict=True))
        if hypot(*a) <= length_max * (1 - 1e-15):
            assert b is a


@pytest.mark.parametrize("step", [1e-9, 0.024, 3.0])
def test_towards_goes_a_step_and_not_beyond(step):
    assert rules.towards((0.0, 0.0, 0.0), (3.0, 0.0, 4.0), step)[2] == pytest.approx(0.8 * step)
    end = (step / 2, 0.0, 0.0)
    assert rules.towards(ZERO, end, step) is end


LOW = tuple(low + margin for low, margin in zip(LIMITS.fence_low, (0.2, 0.2, 0.35), strict=True))
HIGH = tuple(high - rules.MARGIN for high in LIMITS.fence_high)


@given(SPEEDS, PLACES)
@settings(max_examples=1000, deadline=None)
def test_towards_every_face_the_robot_can_stop(velocity, position):
    fenced = rules.fenced(velocity, position, LOW, HIGH)
    for v, at, low, high in zip(fenced, position, LIMITS.fence_low, LIMITS.fence_high, strict=True):
        room = high - at if v > 0 else at - low
        assert v == 0.0 or 0.2 * abs(v) + v * v / 6 <= room - 0.1 + 1e-12 or room > 5


@given(SPEEDS, PLACES, st.tuples(*[st.floats(-rules.GLIMPSE, rules.GLIMPSE)] * 3))
@settings(max_examples=1000, deadline=None)
def test_far_from_the_fence_it_changes_nothing_here_and_near_by(velocity, position, step):
    if rules.is_far(velocity, position, LOW, HIGH):
        near = tuple(at + d for at, d in zip(position, step, strict=True))
        assert rules.fenced(velocity, near, LOW, HIGH) == pytest.approx(velocity, abs=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_nowhere_is_not_far(axis, bad):
    position = [1.0, 1.0, 1.0]
    assert rules.is_far(ZERO, tuple(position), LOW, HIGH)
    position[axis] = bad
    assert not rules.is_far(ZERO, tuple(position), LOW, HIGH)


@pytest.mark.parametrize(("axis", "sign"), [(a, s) for a in range(3) for s in (-1, 1)])
def test_it_is_far_up_to_where_the_robot_has_to_slow_down(axis, sign):
    position, velocity = [1.0, 1.0, 1.3], [0.0, 0.0, 0.0]
    velocity[axis] = 0.3 * sign
    caution = rules.REACTION if (axis, sign) == (2, -1) else rules.CAUTION
    reach = 0.3 * (caution + 0.3 / 6) + rules.GLIMPSE
    edge = HIGH[axis] - reach if sign > 0 else LOW[axis] + reach
    for beyond, far in ((-1e-9, True), (1e-9, False)):
        position[axis] = edge + sign * beyond
        assert rules.is_far(tuple(velocity), tuple(position), LOW, HIGH) == far


@pytest.mark.parametrize(
    ("position", "axis", "sign"),
    [((9.1, 0, 1), 0, -1), ((-2.9, 0, 1), 0, 1), ((0, 5.4, 1), 1, -1), ((0, 0, 2.45), 2, -1)],
)
def test_beyond_the_margin_the_robot_comes_back(position, axis, sign):
    assert rules.fenced(ZERO, position, LOW, HIGH)[axis] * sign > 0.05


def test_whoever_stands_on_the_floor_is_not_asked_to_take_off():
    assert rules.fenced(ZERO, (0.0, 0.0, 0.1), LOW, HIGH) == ZERO
    assert rules.fenced((0.0, 0.0, -1.0), (0.0, 0.0, 0.1), LOW, HIGH) == ZERO
    assert rules.fenced((0.0, 0.0, 0.9), (0.0, 0.0, 0.1), LOW, HIGH) == (0.0, 0.0, 0.9)


def test_near_the_floor_the_robot_goes_no_faster_than_it_can_touch():
    assert rules.fenced((3.0, 4.0, 0.0), (0, -2, 0.2), LOW, HIGH)[:2] == pytest.approx((0.6, 0.8))
    assert rules.fenced((3.0, 4.0, 0.0), (0, -2, 0.25), LOW, HIGH)[:2] == (3.0, 4.0)


def test_the_floor_is_approached_as_the_stop_rule_says():
    v = -rules.fenced((0.0, 0.0, -9.0), (0, 0, 1.35), LOW, HIGH)[2]
    assert 0.2 * v + v * v / 6 == pytest.approx(1.0)


def test_a_face_that_is_far_limits_nothing():
    assert rules.approach(1e6) == pytest.approx(2447.7, abs=0.1)
    assert rules.approach(1e6 + 1) == inf


def test_in_land_the_floor_is_no_face():
    low = (LOW[0], LOW[1], -inf)
    assert rules.fenced((0.0, 0.0, -0.5), (0.0, 0.0, 0.1), low, HIGH) == (0.0, 0.0, -0.5)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("bad", SPECIAL_BAD)
def test_whatever_is_sensed_the_fence_answers_with_a_speed(bad, axis):
    position = [0.0, 0.0, 1.0]
    position[axis] = bad
    for velocity in ((6.0, 6.0, 6.0), (-6.0, -6.0, -6.0), ZERO):
        assert all(abs(v) <= 6.0 for v in rules.fenced(velocity, tuple(position), LOW, HIGH))


def test_the_reference_does_not_fall_faster_than_the_robot_can():
    kept = rules.upright((1.0, 0.0, -3.0), (1.0, 0.0, 0.0), climb=-0.2, speed_max=6.0)
    assert kept == (1.0, 0.0, -0.2 - rules.SINK_LAG)
    same = (1.0, 0.0, -0.6)
    assert rules.upright(same, (1.0, 0.0, 0.0), climb=-0.2, speed_max=6.0) is same
    # Nor does it rise again while the robot still climbs.
    assert rules.upright((0.0, 0.0, -1.0), (0.0, 0.0, 0.5), climb=3.0, speed_max=6.0)[2] == 0.5


@pytest.mark.parametrize("climb", SPECIAL_BAD)
def test_whatever_is_sensed_the_reference_stays_below_the_cap(climb):
    before = (0.0, 0.0, 5.9)
    kept = rules.upright((5.9, 0.0, -1.0), before, climb, speed_max=6.0)
    assert hypot(*kept) <= 6.0 * (1 + 1e-15)


@given(SPEEDS, VECTORS)
@settings(max_examples=500, deadline=None)
def test_braking_begins_with_no_more_than_what_was_flown(reference, velocity):
    start = brake_start(reference, velocity)
    assert hypot(*start) <= hypot(*reference)


@pytest.mark.parametrize(("speed", "rate"), [(0.0, 1.0), (0.5, 2.0), (5.0, 5.5), (inf, 5.5)])
def test_braking_is_hard_first_and_gentle_in_the_end(speed, rate):
    assert brake_rate(speed) == rate


# The whole guard, with any commands and any readings.

CASES_A_FLIGHT = 40
EVENTS = st.lists(
    st.tuples(
        st.one_of(VECTORS, SPEEDS, SPEEDS),
        ANY,
        st.one_of(st.just(None), PLACES, VECTORS),
        st.one_of(SPEEDS, VECTORS),
        st.integers(-2, 300),
    ),
    min_size=CASES_A_FLIGHT,
    max_size=CASES_A_FLIGHT,
)


def check_flight(events):
    """Whatever is commanded and sensed, what is flown is finite, in the caps, and can stop."""
    guard, now_ns, speed_max = armed(), 0, LIMITS.speed_max
    guard.offer(command((1.0, 0.0, 0.5)), 0)
    for velocity, yaw_rate, place, sensed_velocity, age_ms in events:
        now_ns += TICK
        guard.offer(command(velocity, now_ns - age_ms * MS, yaw_rate), now_ns)
        position = (1.0, 1.0, 1.0) if place is None else place
        before, was = guard.reference, guard.state
        reference = guard.tick(now_ns, sensed(position, sensed_velocity), DT)
        assert abs(guard.yaw_rate) <= LIMITS.yaw_rate_max
        if reference is None:
            assert guard.state in (GuardState.LAND, GuardState.ESTOP)
            continue
        assert hypot(*reference) <= speed_max  # so no component is infinite or not a number
        for axis in range(3):
            v, at = reference[axis], position[axis]
            room = LIMITS.fence_high[axis] - at if v > 0 else at - LIMITS.fence_low[axis]
            if guard.state is not GuardState.LAND and v != 0.0 and isfinite(at):
                assert 0.2 * abs(v) + v * v / 6 <= room - 0.1 + 1e-9
        if place is None and guard.state is was is GuardState.TRACK:
            # Far from the fence, and not kept from falling: no step beyond the cap.
            step = hypot(*(b - a for a, b in zip(before, reference, strict=True)))
            assert step <= 12.0 * DT * (1 + 1e-9) or reference[2] >= sensed_velocity[2] - 0.5 - 1e-9


@pytest.mark.promise("P-GUARD-2")
@given(EVENTS)
@settings(max_examples=10_000 // CASES_A_FLIGHT, deadline=None)
def test_whatever_is_commanded_and_sensed_what_is_flown_is_inside_the_caps(events):
    check_flight(events)


@pytest.mark.full
@given(EVENTS)
@settings(max_examples=1_000_000 // CASES_A_FLIGHT, deadline=None)
def test_a_million_commands_and_readings_stay_inside_the_caps(events):
    check_flight(events)


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("value", SPECIAL)
def test_every_special_float_in_a_command_is_flown_inside_the_caps(axis, value):
    values = [0.5, 0.5, 0.5, 0.5]
    values[axis] = value
    check_flight([(tuple(values[:3]), values[3], None, ZERO, 0)] * 300)


def test_the_cap_holds_to_the_last_bit():
    """Speeds whose square rounds down."""
    for k in range(2000):
        v = nextafter(6.0, 0.0) / sqrt(1 + k * k * 1e-6)
        w = rules.shortened((v, v * k * 1e-3, 0.0), 6.0 * rules.JUST_BELOW)
        assert hypot(*w) <= 6.0
