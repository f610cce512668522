# SPDX-License-Identifier: Apache-2.0

"""For any commands and readings, the guard's reference stays within its bounds.

Each case is one flight. The first reading may be anything; the next one differs from it by little.
"""

from math import dist, hypot, isfinite

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.wire.messages import GuardState
from cloudrc.world.guard.limits import COMMAND_MAX, growth
from tests.fences import FENCE
from tests.world.guard.conftest import DT, LIMITS, MS, TICK, armed, command, sensed
from tests.world.guard.test_limits import ANY, PLACES, SPEEDS, VECTORS
from tests.world.guard.test_plan import PLANS

TAKEN = st.tuples(*[st.floats(-COMMAND_MAX, COMMAND_MAX)] * 3)
"""Values that a command may have without being rejected."""
CHANGE_MAX = 0.8
"""Largest change of a velocity between two readings [m/s]."""
STEP_MAX = 0.04
"""The robot moves by less than this in a tick [m]."""


@pytest.mark.promise("commands-within-caps")
@given(
    first=st.one_of(SPEEDS, TAKEN),
    then=st.one_of(VECTORS, TAKEN, SPEEDS, SPEEDS),
    yaw_rate=st.one_of(ANY, st.floats(-COMMAND_MAX, COMMAND_MAX)),
    place=st.one_of(st.just(None), PLACES, PLACES, VECTORS),
    velocity=st.one_of(SPEEDS, VECTORS),
    change=st.tuples(*[st.floats(-CHANGE_MAX, CHANGE_MAX)] * 3),
    age_ms=st.integers(-2, 300),
    after_ns=st.sampled_from([TICK, TICK, 300 * MS]),
    plan=st.lists(st.one_of(SPEEDS, TAKEN, VECTORS), max_size=5).map(tuple),
    planned_ms=st.sampled_from([0, 1, 20, 5000]),
)
@settings(max_examples=400, deadline=None)
def test_any_input_is_flown_inside_the_caps(
    first, then, yaw_rate, place, velocity, change, age_ms, after_ns, plan, planned_ms
):
    """Fly one command, then another one with its plan or silence."""
    limits = PLANS if plan else LIMITS
    guard = armed(limits)
    position = (1.0, 1.0, 1.0) if place is None else place
    guard.accept_command(command(first), 0)
    check_flown(guard, guard.step(0, sensed(position, velocity), 1.0), position)
    before, limited = guard.reference, guard.counts["limited_fence"]
    sent = command(then, after_ns - age_ms * MS, yaw_rate)
    for _ in range(5 if age_ms < 0 else 1):  # five commands from the future lead to LAND
        guard.accept_command(
            sent._replace(plan=plan, planned_ns=after_ns + planned_ms * MS), after_ns
        )
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
    for now_ns in range(after_ns + TICK, after_ns + 60 * MS, TICK):
        check_flown(guard, guard.step(now_ns, sensed(position, velocity), DT), position)
        assert hypot(*guard.reference) <= limits.speed_max_mps


def check_flown(guard, reference, position):
    """Check that a reference is within the caps and lets the robot stop before the fence."""
    assert abs(guard.yaw_rate) <= LIMITS.yaw_rate_max_radps
    assert hypot(*reference) <= LIMITS.speed_max_mps  # therefore no component is infinite or NaN
    for v, at, low, high in zip(reference, position, FENCE.low, FENCE.high, strict=True):
        room = high - at if v > 0 else at - low
        if guard.state is not GuardState.LAND and v != 0.0 and isfinite(at):
            assert 0.2 * abs(v) + v * v / 6 <= room - 0.1 + 1e-9
