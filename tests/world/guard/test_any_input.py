"""For any commands and readings, the guard's reference stays within its bounds.

Each case is one flight. The first reading may be anything; the next one differs from it by little.
"""

import random
import struct
from collections import Counter
from math import dist, hypot, isfinite

import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from cloudrc.messages import ZERO, GuardState
from cloudrc.world.guard.limits import COMMAND_MAX, growth
from tests.world.guard.conftest import DT, LIMITS, MS, TICK, armed, command, sensed
from tests.world.guard.test_arithmetic import ANY, PLACES, SPECIAL, SPECIAL_BAD, SPEEDS, VECTORS

TAKEN = st.tuples(*[st.floats(-COMMAND_MAX, COMMAND_MAX)] * 3)
"""Values that a command may have without being rejected."""
CHANGE_MAX = 0.8
"""Largest change of a velocity between two readings [m/s]."""
STEP_MAX = 0.04
"""The robot moves by less than this in a tick [m]."""
CASES_AT_ONCE = 4
CASE = st.tuples(
    st.one_of(SPEEDS, TAKEN),
    st.one_of(VECTORS, TAKEN, SPEEDS, SPEEDS),
    st.one_of(ANY, st.floats(-COMMAND_MAX, COMMAND_MAX)),
    st.one_of(st.just(None), PLACES, PLACES, VECTORS),
    st.one_of(SPEEDS, VECTORS),
    st.tuples(*[st.floats(-CHANGE_MAX, CHANGE_MAX)] * 3),
    st.integers(-2, 300),
    st.sampled_from([TICK, TICK, 300 * MS]),
)
CASES = st.lists(CASE, min_size=CASES_AT_ONCE, max_size=CASES_AT_ONCE)


def check_case(first, then, yaw_rate, place, velocity, change, age_ms, after_ns):
    """Fly one command, then another one or silence; return the last state."""
    guard = armed()
    position = (1.0, 1.0, 1.0) if place is None else place
    guard.accept_command(command(first), 0)
    check_flown(guard, guard.step(0, sensed(position, velocity), 1.0), position)
    before, limited = guard.reference, guard.counts["limited_fence"]
    for _ in range(5 if age_ms < 0 else 1):  # five commands from the future lead to LAND
        guard.accept_command(command(then, after_ns - age_ms * MS, yaw_rate), after_ns)
    if place is not None:
        position = tuple(at + STEP_MAX * d for at, d in zip(position, change, strict=True))
    velocity = tuple(v + d if abs(v) < 1e3 else v for v, d in zip(velocity, change, strict=True))
    after = guard.step(after_ns, sensed(position, velocity), DT)
    check_flown(guard, after, position)
    if place is None and guard.state is GuardState.TRACK:
        # Far from the fence nothing grows beyond the cap. Only near it, where the robot must be
        # slower, the reference may change by more.
        step_max = 12.0 * DT * (1 + 1e-9)
        assert hypot(*(growth(a, b) for a, b in zip(before, after, strict=True))) <= step_max
        assert dist(before, after) <= step_max or guard.counts["limited_fence"] > limited
    return guard.state


def check_flown(guard, reference, position):
    """Check that a reference is within the caps and lets the robot stop before the fence."""
    assert abs(guard.yaw_rate) <= LIMITS.yaw_rate_max
    assert hypot(*reference) <= LIMITS.speed_max  # therefore no component is infinite or NaN
    for v, at, low, high in zip(
        reference, position, LIMITS.fence_low, LIMITS.fence_high, strict=True
    ):
        room = high - at if v > 0 else at - low
        if guard.state is not GuardState.LAND and v != 0.0 and isfinite(at):
            assert 0.2 * abs(v) + v * v / 6 <= room - 0.1 + 1e-9


def any_float(rng):
    """Draw a float of any bits, of any size up to COMMAND_MAX, or a special one."""
    (value,) = struct.unpack("d", rng.randbytes(8))
    small = rng.choice((-1.0, 1.0)) * COMMAND_MAX * 10.0 ** rng.uniform(-320.0, 0.0)
    return rng.choice((value, small, rng.choice(SPECIAL_BAD)))


def vector(rng, low=-8.0, high=8.0):
    """Draw a velocity [m/s] or position [m] between two bounds, or three numbers of any kind."""
    draw = (lambda: rng.uniform(low, high)) if rng.random() < 0.7 else (lambda: any_float(rng))
    return draw(), draw(), draw()


def case_by_chance(rng):
    """Draw a case like CASE a hundred times faster, without shrinking."""
    first = tuple(v if abs(v) <= COMMAND_MAX else 0.0 for v in vector(rng))
    place = rng.choice((None, vector(rng, -4.0, 10.0), vector(rng, 0.0, 2.5)))
    change = tuple(rng.uniform(-CHANGE_MAX, CHANGE_MAX) for _ in range(3))
    after_ns, age_ms = rng.choice((TICK, TICK, 300 * MS)), rng.randint(-2, 300)
    return first, vector(rng), any_float(rng), place, vector(rng), change, age_ms, after_ns


@pytest.mark.promise("commands-within-caps")
@given(CASES)
@settings(max_examples=1_000 // CASES_AT_ONCE, deadline=None)
def test_any_input_is_flown_inside_the_caps(cases):
    for case in cases:
        check_case(*case)


@pytest.mark.promise("commands-within-caps")
def test_ten_thousand_cases_by_chance_stay_inside_the_caps():
    rng = random.Random(0)
    seen = Counter(check_case(*case_by_chance(rng)) for _ in range(10_000))
    assert min(seen[state] for state in (GuardState.TRACK, GuardState.HOLD, GuardState.LAND)) >= 50


@pytest.mark.full
def test_two_million_cases_stay_inside_the_caps(figure):
    rng, seen = random.Random(1), Counter()
    for _ in range(1_000_000):
        seen[check_case(*case_by_chance(rng))] += 1
    for state in (GuardState.TRACK, GuardState.HOLD, GuardState.LAND):
        assert seen[state] >= 5_000
    parts = 25  # hypothesis remembers all examples of a part
    for part in range(parts):

        @seed(part)
        @settings(max_examples=1_000_000 // parts // CASES_AT_ONCE, deadline=None, database=None)
        @given(CASES)
        def search(cases):
            seen.update(check_case(*case) for case in cases)

        search()
    figure("commands and readings: outside the caps", 0, "==", 0, count=seen.total())
    assert seen.total() >= 2_000_000


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize(
    "value", [v for v in (*SPECIAL, COMMAND_MAX, -COMMAND_MAX) if abs(v) <= COMMAND_MAX]
)
def test_every_accepted_special_float_is_flown_in_the_caps(axis, value):
    values = [0.5, 0.5, 0.5, 0.5]
    values[axis] = value
    velocity, yaw_rate = tuple(values[:3]), values[3]
    for first, then in ((velocity, ZERO), (ZERO, velocity), (velocity, velocity)):
        state = check_case(first, then, yaw_rate, None, ZERO, ZERO, 0, TICK)
        assert state is GuardState.TRACK
