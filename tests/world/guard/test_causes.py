"""The cause that telemetry gives for the guard's state."""

from __future__ import annotations

from math import nan

import pytest

from cloudrc.messages import Cause, GuardState
from cloudrc.world.guard.state import Guard
from tests.world.guard.conftest import (
    HERE,
    MS,
    SECOND,
    armed,
    command,
    feed,
    holding,
    landing,
    run,
    tracking,
)

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
LOW = (1.0, 2.0, 0.1)


def told(guard: Guard) -> tuple[GuardState, Cause]:
    return guard.state, guard.cause


def test_causes_of_a_mission_from_command_to_end():
    guard = armed()
    assert told(guard) == (GROUND, Cause.SPAWN)
    guard.accept_command(command(), 0)
    assert told(guard) == (TRACK, Cause.COMMAND)
    guard.end_mission(SECOND)
    assert told(guard) == (HOLD, Cause.ENDED)


def test_causes_of_silence_and_its_end():
    guard = holding()
    assert told(guard) == (HOLD, Cause.SILENCE)
    now_ns = feed(guard, 2 * SECOND, 20)
    assert told(guard) == (TRACK, Cause.COMMANDS)
    guard.forget_commands()
    run(guard, now_ns, now_ns + 10 * MS)
    assert told(guard) == (HOLD, Cause.SESSION)


def test_after_touch_down_the_cause_is_that_of_the_landing():
    guard = landing()
    run(guard, 2 * SECOND, 3 * SECOND, LOW, (0.0, 0.0, -0.5))
    assert None in run(guard, 3 * SECOND, 5 * SECOND, LOW)
    assert guard.take_changes()[-1].cause == Cause.DOWN.words
    assert told(guard) == (LAND, landing().cause)
    assert guard.cause in (Cause.ALONE, Cause.IMPOSSIBLE)


def test_a_landing_acknowledged_low_has_its_causes():
    guard = landing()
    run(guard, 2 * SECOND, 3 * SECOND, LOW, (0.0, 0.0, -0.5))
    guard.acknowledge(3 * SECOND)
    run(guard, 3 * SECOND, 5 * SECOND, LOW)
    assert told(guard) == (GROUND, Cause.DOWN)


def test_causes_of_impossible_commands_and_long_silence():
    guard = tracking()
    for _ in range(5):
        guard.accept_command(command((nan, 0.0, 0.0)), 0)
    assert told(guard) == (LAND, Cause.IMPOSSIBLE)
    guard = holding()
    run(guard, 2 * SECOND, 61 * SECOND)
    assert told(guard) == (LAND, Cause.ALONE)


def test_causes_of_a_stop_and_its_release():
    guard = tracking()
    guard.stop(SECOND)
    assert told(guard) == (ESTOP, Cause.STOPPED)
    guard.acknowledge(SECOND)
    assert told(guard) == (GROUND, Cause.STILL_FIRST)
    guard.stop(2 * SECOND)
    run(guard, 2 * SECOND, 4 * SECOND, HERE)
    guard.acknowledge(4 * SECOND)
    assert told(guard) == (GROUND, Cause.ACKNOWLEDGED)


def test_cause_of_a_reset_to_the_spawn():
    guard = tracking()
    guard.put_on_ground(SECOND, "mission starts from spawn")
    assert told(guard) == (GROUND, Cause.SPAWN)


@pytest.mark.parametrize("cause", Cause)
def test_every_cause_has_words(cause: Cause):
    assert cause.words
    assert Cause(int(cause)) is cause
