"""Hostile commands in whole flights do not change the limits of the guard."""

import pytest

from cloudrc.faults import adversary
from cloudrc.faults.flight import FaultRun
from cloudrc.faults.schedule import Schedule
from cloudrc.messages import GuardState
from cloudrc.world.guard.state import Guard
from tests.fences import FENCE

HOSTILE = {"stop-and-go": 9, "false-basis": 8, "strange-numbers": 9, "rejected-and-released": 3}
"""Name of a hostile cloud's policy -> seed. Together, these flights reach all guard states."""
BOUNDS = {
    *("command_age_max_ns", "acceleration_max", "_hold_max_ns", "_plan_max_ns", "_ramp_ns"),
    *("_yaw_rate_max", "_speed_max", "_floor", "_high", "speed"),
}
"""Names of attributes of a guard and its parts that contain limits."""


def bounds(guard):
    parts = (guard, guard._position_hold, guard._descent, guard._take_off)
    found = [vars(part)[name] for part in parts for name in sorted(BOUNDS & vars(part).keys())]
    return *found, guard._low[:2], guard._position_hold._low, guard._take_off._low


@pytest.mark.promise("commands-within-caps")
def test_nothing_in_the_tunnel_changes_the_limits(monkeypatch):
    monkeypatch.setattr(adversary, "SPEAKING", (*HOSTILE,))  # all of them also forge requests
    states = set()
    for policy, seed in HOSTILE.items():
        flight = FaultRun(Schedule(seed, policy=policy))
        before = bounds(flight.robot.guard)
        flight.fly(8.0)
        assert bounds(flight.robot.guard) == before == bounds(Guard(flight.experiment.guard, FENCE))
        states |= {change.state for change in flight.changes}
    assert states == set(GuardState)
