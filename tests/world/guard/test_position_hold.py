"""Braking and position hold, with numbers."""

from math import hypot

import pytest

from cloudrc.messages import ZERO
from cloudrc.world.guard.hold import (
    BRAKE_MAX,
    BRAKE_MIN,
    BRAKE_SHARE_MIN,
    BRAKE_TIME_CONSTANT,
    DAMPING_GAIN,
    HOLD_SPEED_MAX,
    INTEGRAL_GAIN,
    INTEGRAL_MAX,
    POSITION_GAIN,
    STILL_SPEED,
    PositionHold,
    brake_start,
)
from cloudrc.world.guard.limits import BRAKE
from tests.world.guard.conftest import DT, HERE, sensed

LOW, HIGH = (-2.8, -8.3, 0.0), (9.0, 5.3, 2.3)
ENOUGH = 1.0
"""A tick that is long enough to reach any reference [s]."""


def holding_at(sink=0.0, speed_max=6.0, position=HERE):
    """Return a position hold with its hold point at `position`."""
    hold = PositionHold(LOW, HIGH, speed_max)
    reference = (0.0, 0.0, -sink)
    assert hold.follow(reference, sensed(position, reference), sink, ENOUGH) == reference
    assert not hold.brakes
    return hold


def moved(offset, velocity=ZERO):
    return sensed(tuple(a + b for a, b in zip(HERE, offset, strict=True)), velocity)


# Braking


def test_a_new_position_hold_does_not_brake():
    assert PositionHold(LOW, HIGH, 6.0).brakes is False


@pytest.mark.parametrize(
    ("speed", "begins"), [(4.0, 3.0), (2.0, 1.0), (1.25, 0.25), (0.5, 0.1), (0.0, 0.0)]
)
@pytest.mark.parametrize("axis", range(3))
def test_braking_starts_1_mps_below_the_speed_but_above_0(axis, speed, begins):
    velocity = [0.0, 0.0, 0.0]
    velocity[axis] = speed
    assert BRAKE_SHARE_MIN == 0.2
    for reference in (velocity, [1.5 * v for v in velocity]):
        start = brake_start(tuple(reference), tuple(velocity))
        assert start[axis] == pytest.approx(begins)
        assert hypot(*start) == pytest.approx(begins)


def test_braking_starts_from_the_reference_if_both_are_as_fast():
    assert brake_start((0.0, 2.0, 0.0), (2.0, 0.0, 0.0)) == (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("reference", "sink", "rate"),
    [
        ((0.4, 0.0, 0.0), 0.0, 0.4 / BRAKE_TIME_CONSTANT),
        ((0.0, 0.4, 0.0), 0.0, 0.4 / BRAKE_TIME_CONSTANT),
        ((0.0, 0.0, 0.4), 0.0, 0.4 / BRAKE_TIME_CONSTANT),
        ((0.0, 0.0, 0.1), 0.5, 0.6 / BRAKE_TIME_CONSTANT),
        ((0.0, 0.0, 3.0), 0.0, BRAKE_MAX),
        ((0.1, 0.0, 0.0), 0.0, BRAKE_MIN),
    ],
)
def test_braking_goes_step_by_step_towards_rest(reference, sink, rate):
    hold = PositionHold(LOW, HIGH, 6.0)
    hold.follow(reference, sensed(velocity=(5.0, 5.0, 5.0)), sink, DT)  # begins
    after = hold.follow(reference, sensed(velocity=(5.0, 5.0, 5.0)), sink, DT)
    way = hypot(*(a - b for a, b in zip(reference, after, strict=True)))
    assert way == pytest.approx(rate * DT)
    x, y, z = after
    assert hypot(x, y, z + sink) < hypot(reference[0], reference[1], reference[2] + sink)
    assert hold.brakes


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sink", [0.0, 0.5])
@pytest.mark.parametrize(("share", "still"), [(0.99, True), (1.01, False), (-1.01, False)])
def test_at_rest_the_robot_is_slow_in_every_direction(axis, sink, share, still):
    hold, velocity = PositionHold(LOW, HIGH, 6.0), [0.0, 0.0, -sink]
    velocity[axis] += share * STILL_SPEED
    hold.follow((0.0, 0.0, -sink), sensed(velocity=tuple(velocity)), sink, ENOUGH)
    assert hold.brakes != still


def test_at_the_limit_it_is_not_yet_at_rest():
    hold = PositionHold(LOW, HIGH, 6.0)
    hold.follow(ZERO, sensed(velocity=(STILL_SPEED, 0.0, 0.0)), 0.0, ENOUGH)
    assert hold.brakes


def test_it_is_not_at_rest_before_its_reference_is():
    hold = PositionHold(LOW, HIGH, 6.0)
    hold.follow((1.0, 0.0, 0.0), sensed(velocity=(3.0, 0.0, 0.0)), 0.0, DT)
    hold.follow((1.0, 0.0, 0.0), sensed(velocity=ZERO), 0.0, DT)
    assert hold.brakes


# Holding


def test_the_position_hold_pulls_back_and_damps():
    reference = holding_at().follow(
        ZERO, moved((0.1, -0.1, 0.05), (0.04, -0.02, 0.01)), 0.0, ENOUGH
    )
    pull = (-0.1 * POSITION_GAIN, 0.1 * POSITION_GAIN, -0.05 * POSITION_GAIN)
    damped = (0.04 * DAMPING_GAIN, -0.02 * DAMPING_GAIN, 0.01 * DAMPING_GAIN)
    assert reference == pytest.approx(tuple(a - b for a, b in zip(pull, damped, strict=True)))


@pytest.mark.parametrize(("speed_max", "allowed"), [(6.0, HOLD_SPEED_MAX), (0.3, 0.3)])
def test_the_position_hold_is_no_faster_than_its_limit(speed_max, allowed):
    hold = holding_at(speed_max=speed_max)
    assert hypot(*hold.follow(ZERO, moved((3.0, -4.0, 0.5)), 0.0, ENOUGH)) == pytest.approx(allowed)


def test_the_position_hold_accelerates_no_more_than_brake():
    reference = holding_at().follow(ZERO, moved((3.0, 0.0, 0.0)), 0.0, DT)
    assert reference == pytest.approx((-BRAKE * DT, 0.0, 0.0))


def after_offset(offset, seconds, sink=0.0):
    """Return the reference at the hold point [m/s] after some seconds at an offset from it [m]."""
    hold = holding_at(sink)
    for _ in range(round(seconds / 0.1)):
        hold.follow(ZERO, moved(offset), sink, 0.1)
    return hold.follow(ZERO, moved(ZERO), sink, ENOUGH)


def test_the_integral_works_against_a_steady_distance():
    beside = (0.03, -0.02, 0.01)
    lean = tuple(-INTEGRAL_GAIN * each * 2.0 for each in beside)
    assert after_offset(beside, 2.0) == pytest.approx(lean)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_integral_is_limited(sign):
    """Otherwise it would wind up against an obstacle."""
    beside = (0.05 * sign, 0.05 * sign, 0.05 * sign)
    assert after_offset(beside, 60.0) == pytest.approx((-INTEGRAL_MAX * sign,) * 3)


@pytest.mark.parametrize("order", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_far_from_the_hold_point_it_does_not_integrate(order):
    """Otherwise it would overshoot the hold point."""
    near, far = (0.06, 0.0, 0.0799), (0.06, 0.0, 0.0801)
    assert after_offset(tuple(near[axis] for axis in order), 1.0) != ZERO
    assert after_offset(tuple(far[axis] for axis in order), 1.0) == ZERO


def test_in_a_descent_it_integrates_sideways_only():
    assert after_offset((0.03, -0.02, 0.5), 2.0, 0.5) == pytest.approx((-0.012, 0.008, -0.5))


def test_a_new_hold_point_starts_with_a_zero_integral():
    hold = holding_at()
    for _ in range(20):
        hold.follow(ZERO, moved((0.03, 0.0, 0.0)), 0.0, 0.1)
    hold.forget()
    hold.follow(ZERO, sensed(HERE, ZERO), 0.0, ENOUGH)
    assert hold.follow(ZERO, moved(ZERO), 0.0, ENOUGH) == ZERO


def test_in_a_descent_it_holds_the_position_sideways_only():
    reference = holding_at(0.5).follow(ZERO, moved((0.1, 0.0, -1.0), (0.0, 0.1, -0.3)), 0.5, ENOUGH)
    assert reference == pytest.approx((-0.1 * POSITION_GAIN, -0.1 * DAMPING_GAIN, -0.5))


@pytest.mark.parametrize(
    ("position", "hold_point"),
    [((9.1, 0.0, 1.0), (9.0, 0.0, 1.0)), ((0.0, -8.4, 2.4), (0.0, -8.3, 2.3))],
)
def test_the_hold_point_is_inside_the_margins(position, hold_point):
    reference = holding_at(position=position).follow(ZERO, sensed(position), 0.0, ENOUGH)
    wanted = tuple(POSITION_GAIN * (a - b) for a, b in zip(hold_point, position, strict=True))
    assert reference == pytest.approx(wanted)


def test_after_forget_it_sets_a_new_hold_point():
    hold = holding_at()
    hold.forget()
    hold.follow(ZERO, moved((1.0, 0.0, 0.0)), 0.0, ENOUGH)
    assert hold.follow(ZERO, moved((1.0, 0.0, 0.0)), 0.0, ENOUGH) == ZERO
