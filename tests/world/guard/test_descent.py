"""A landing that the operator acknowledges before touch-down, and one with a low speed cap."""

from dataclasses import replace

import pytest

from cloudrc.geometry import fence
from cloudrc.messages import ZERO, Cause, GuardState
from cloudrc.world.guard.hold import LAND_SPEED
from tests.world.guard.conftest import (
    HERE,
    LIMITS,
    MS,
    SECOND,
    bring_down,
    feed,
    landing,
    run,
)

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
NEAR = (1.0, 2.0, fence.FLOOR_MARGIN)
SINKS = (0.0, 0.0, -LAND_SPEED)
DOWN = "touched down, rotors stopped"


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
    stood = run(guard, 3 * SECOND + 300 * MS, 5 * SECOND, position)
    assert set(stood[stood.index(None) :]) == {None}
    assert guard.take_changes()[-1][1:] == (GROUND, DOWN)
    assert guard.cause is Cause.DOWN
    assert not guard.armed
    guard.start_mission(5 * SECOND)
    feed(guard, 5 * SECOND, 1, position=position)
    assert guard.state is TRACK


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


def test_a_slow_landing_can_be_acknowledged_in_the_air():
    """With a cap of 0.3 m/s the robot sinks at 0.15 m/s."""
    guard, sinks = landing(replace(LIMITS, speed_max=0.3)), (0.0, 0.0, -0.15)
    assert run(guard, 2 * SECOND, 3 * SECOND, velocity=sinks)[-1] == sinks
    guard.acknowledge(3 * SECOND)
    run(guard, 3 * SECOND, 3 * SECOND + 10 * MS, velocity=sinks)
    assert guard.state is HOLD


def test_a_landing_near_the_fence_touches_down():
    x, y, _ = fence.HIGH
    guard = landing()
    assert None in run(guard, 2 * SECOND, 4 * SECOND, (x, y - 0.4, 0.1))
    assert guard.take_changes()[-1].cause == DOWN


@pytest.mark.parametrize("speed_max", [0.01, 0.2, 6.0])
def test_slow_sinking_under_a_low_cap_is_no_touch_down(speed_max):
    guard = landing(replace(LIMITS, speed_max=speed_max))
    sinks = (0.0, 0.0, -0.5 * min(LAND_SPEED, 0.5 * speed_max))
    assert None not in run(guard, 2 * SECOND, 5 * SECOND, velocity=sinks)
    assert None in run(guard, 5 * SECOND, 6 * SECOND)
