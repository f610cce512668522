# SPDX-License-Identifier: Apache-2.0

"""Braking, position hold and take-off, with numbers."""

from math import hypot, nan

import pytest

from cloudrc.config.robot import DEFAULT_LIMITS
from cloudrc.wire.messages import ZERO
from cloudrc.world.guard import hold as rules
from cloudrc.world.guard.hold import PositionHold, TakeOff, brake_start
from tests.fences import FENCE
from tests.world.guard.conftest import DT, HERE, sensed

LOW, HIGH = (-2.8, -8.3, 0.0), (9.0, 5.3, 2.3)
BRAKING = DEFAULT_LIMITS.braking_mps2
ENOUGH = 1.0
"""A tick that is long enough to reach any reference [s]."""


def holding_at(sink=0.0, speed_max=6.0, position=HERE):
    """Return a position hold with its hold point at `position`."""
    hold = PositionHold(LOW, HIGH, speed_max, BRAKING)
    reference = (0.0, 0.0, -sink)
    assert hold.follow(reference, sensed(position, reference), sink, ENOUGH) == reference
    assert not hold.brakes
    return hold


def moved(offset, velocity=ZERO):
    return sensed(tuple(a + b for a, b in zip(HERE, offset, strict=True)), velocity)


@pytest.mark.parametrize(("speed", "begins"), [(4.0, 3.0), (1.25, 0.25), (0.5, 0.1), (0.0, 0.0)])
@pytest.mark.parametrize("axis", range(3))
def test_braking_starts_1_mps_below_the_speed_but_above_0(axis, speed, begins):
    velocity, wanted = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]
    velocity[axis], wanted[axis] = speed, begins
    for reference in (velocity, [1.5 * v for v in velocity]):
        assert brake_start(tuple(reference), tuple(velocity)) == pytest.approx(wanted)
    # If both are as fast, braking starts from the reference.
    assert brake_start((0.0, 2.0, 0.0), (2.0, 0.0, 0.0)) == (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("reference", "sink", "rate"),
    [
        ((0.4, 0.0, 0.0), 0.0, 0.4 / rules.BRAKE_TIME_CONSTANT),
        ((0.0, 0.4, 0.1), 0.5, hypot(0.4, 0.6) / rules.BRAKE_TIME_CONSTANT),
        ((0.0, 0.0, 3.0), 0.0, rules.BRAKE_MAX),
        ((0.1, 0.0, 0.0), 0.0, rules.BRAKE_MIN),
    ],
)
def test_braking_goes_step_by_step_towards_rest(reference, sink, rate):
    hold, fast = PositionHold(LOW, HIGH, 6.0, BRAKING), sensed(velocity=(5.0, 5.0, 5.0))
    hold.follow(reference, fast, sink, DT)  # begins
    x, y, z = hold.follow(reference, fast, sink, DT)
    assert hypot(reference[0] - x, reference[1] - y, reference[2] - z) == pytest.approx(rate * DT)
    assert hypot(x, y, z + sink) < hypot(reference[0], reference[1], reference[2] + sink)
    hold.follow(reference, sensed(velocity=(0.0, 0.0, -sink)), sink, DT)
    assert hold.brakes, "the robot is at rest, but the reference is not"


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sink", [0.0, 0.5])
@pytest.mark.parametrize(("share", "still"), [(0.99, True), (1.01, False), (-1.01, False)])
def test_at_rest_the_robot_is_slow_in_every_direction(axis, sink, share, still):
    hold, velocity = PositionHold(LOW, HIGH, 6.0, BRAKING), [0.0, 0.0, -sink]
    assert hold.brakes is False
    velocity[axis] += share * rules.STILL_SPEED
    hold.follow((0.0, 0.0, -sink), sensed(velocity=tuple(velocity)), sink, ENOUGH)
    assert hold.brakes != still


@pytest.mark.parametrize(
    ("sink", "offset", "velocity", "wanted"),
    [
        (0.0, (0.1, -0.1, 0.05), (0.04, -0.02, 0.01), (-0.18, 0.14, -0.07)),
        (0.5, (0.1, 0.0, -1.0), (0.0, 0.1, -0.3), (-0.1, -0.2, -0.625)),  # sideways only
    ],
)
def test_the_position_hold_pulls_back_and_damps(sink, offset, velocity, wanted):
    reference = holding_at(sink).follow(ZERO, moved(offset, velocity), sink, ENOUGH)
    assert reference == pytest.approx([rules.POSITION_GAIN * v for v in wanted])


@pytest.mark.parametrize(("speed_max", "allowed"), [(6.0, rules.HOLD_SPEED_MAX), (0.3, 0.3)])
def test_the_position_hold_is_no_faster_than_its_limits(speed_max, allowed):
    hold = holding_at(speed_max=speed_max)
    assert hypot(*hold.follow(ZERO, moved((3.0, -4.0, 0.5)), 0.0, ENOUGH)) == pytest.approx(allowed)
    accelerated = hold.follow(ZERO, moved((3.0, 0.0, 0.0)), 0.0, DT)
    assert accelerated == pytest.approx((-BRAKING * DT, 0.0, 0.0))


@pytest.mark.parametrize(
    ("offset", "seconds", "sink", "lean"),
    [
        ((0.03, -0.02, 0.01), 2.0, 0.0, (-0.012, 0.008, -0.004)),
        # It is limited: otherwise it would wind up against an obstacle.
        ((0.05, 0.05, 0.05), 60.0, 0.0, (-rules.INTEGRAL_MAX,) * 3),
        ((-0.05, -0.05, -0.05), 60.0, 0.0, (rules.INTEGRAL_MAX,) * 3),
        # Far from the hold point it stays: otherwise it would overshoot that point.
        ((0.06, 0.0, 0.0801), 1.0, 0.0, ZERO),
        ((0.0801, 0.06, 0.0), 1.0, 0.0, ZERO),
        ((0.0, 0.0801, 0.06), 1.0, 0.0, ZERO),
        ((0.03, -0.02, 0.5), 2.0, 0.5, (-0.012, 0.008, -0.5)),  # in a descent sideways only
    ],
)
def test_the_integral_works_against_a_steady_distance(offset, seconds, sink, lean):
    hold = holding_at(sink)
    for _ in range(round(seconds / 0.1)):
        hold.follow(ZERO, moved(offset), sink, 0.1)
    assert hold.follow(ZERO, moved(ZERO), sink, ENOUGH) == pytest.approx(lean)
    hold.forget()
    assert not hold.brakes
    hold.follow((0.0, 0.0, -sink), sensed(HERE, (0.0, 0.0, -sink)), sink, ENOUGH)
    fresh = hold.follow(ZERO, moved(ZERO), sink, ENOUGH)
    assert fresh == (0.0, 0.0, -sink), "a new hold point begins without it"


@pytest.mark.parametrize(
    ("position", "back"), [((9.1, 0.0, 1.0), (-0.08, 0, 0)), ((0.0, -8.4, 2.4), (0, 0.08, -0.08))]
)
def test_the_hold_point_is_inside_the_margins(position, back):
    reference = holding_at(position=position).follow(ZERO, sensed(position), 0.0, ENOUGH)
    assert reference == pytest.approx(back)


# Take-off

STANDS = (0.0, 0.0, 0.1)


@pytest.mark.parametrize(
    ("height", "over"), [(0.0199, False), (0.02, True), (-0.02, True), (nan, True)]
)
def test_a_take_off_is_over_at_the_lift_off_height(height, over):
    take_off = TakeOff(FENCE)
    for at in (3.0, 0.0):  # the last place on the ground counts
        take_off.look(sensed((0.0, 0.0, at)), flies=False)
    take_off.look(sensed((9.0, 0.0, height)), flies=True)
    assert take_off.over == over
    assert take_off.may_end(sensed()) == (not over)
    take_off.forget()
    assert not take_off.over
    never_seen = TakeOff(FENCE)
    never_seen.look(sensed(STANDS), flies=True)
    assert never_seen.over


@pytest.mark.parametrize(("height", "over"), [(0.0, False), (1.0, True)])
def test_what_others_saw_of_a_take_off_counts_as_what_it_saw_itself(height, over):
    told, saw = TakeOff(FENCE), TakeOff(FENCE)
    saw.look(sensed((0.0, 0.0, 0.0)), flies=False)
    saw.look(sensed((0.0, 0.0, height)), flies=True)
    told.stand(0.0)
    told.rise(is_over=over)
    assert vars(told) == vars(saw)


@pytest.mark.parametrize("axis", range(3))
def test_at_speed_the_rotors_do_not_stop(axis):
    for share, may in ((0.99, True), (1.0, False)):
        velocity = tuple(share * rules.GROUND_SPEED_MAX * (k == axis) for k in range(3))
        assert TakeOff(FENCE).may_end(sensed(STANDS, velocity)) == may


def stopped():
    take_off = TakeOff(FENCE)
    take_off.forget(stopped=True)
    return take_off


def lie(take_off, ticks, position=STANDS, velocity=ZERO):
    """Let the robot lie for some ticks; tell whether it may take off then."""
    for _ in range(ticks):
        take_off.look(sensed(position, velocity), flies=False)
    return take_off.allowed


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("speed", [rules.STILL_SPEED, nan])
def test_stopped_it_may_take_off_once_it_has_been_at_rest(axis, speed):
    take_off, velocity = stopped(), [0.0, 0.0, 0.0]
    velocity[axis] = speed
    assert not lie(take_off, rules.STILL_TICKS - 1)
    take_off.forget()  # acknowledged
    assert not lie(take_off, 1, velocity=tuple(velocity)), "it slides off an obstacle"
    assert not lie(take_off, rules.STILL_TICKS - 1)
    velocity[axis] = 0.99 * rules.STILL_SPEED
    assert lie(take_off, 1, velocity=tuple(velocity))
    take_off.look(sensed(STANDS), flies=True)
    take_off.forget()
    assert take_off.allowed


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("face", [0, 1])
def test_outside_the_fence_a_take_off_is_not_allowed(axis, face):
    """Nor so near a wall that it would scrape out of the fence."""
    position = list(STANDS)
    edge = (FENCE.low, FENCE.high)[face][axis] - (0.5 if axis < 2 else 0.0) * (2 * face - 1)
    position[axis] = edge
    assert lie(stopped(), rules.STILL_TICKS, tuple(position))
    for outside in (edge + (2 * face - 1) * 1e-6, nan):
        position[axis] = outside
        assert not lie(stopped(), 2 * rules.STILL_TICKS, tuple(position))
