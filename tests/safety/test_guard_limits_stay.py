"""The guard's limits come from world's experiment; nothing in the tunnel changes them."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from typing import Any

import pytest

from cloudrc.faults.adversary import POLICIES, at_bad_moments
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import generator
from cloudrc.messages import GuardState
from cloudrc.world.guard.state import Guard

HOSTILE = {"stop-and-go": 9, "false-basis": 8, "strange-numbers": 9, "refused-and-released": 3}
"""Hostile policies with a seed each; together they cause all ANSWERS, CAUSES and states."""
ANSWERS = (
    *("used", "limited_speed", "limited_yaw_rate"),
    *("range", "future", "stale", "start_refused"),
)
"""Counters of applied, limited and refused commands and requests."""
CAUSES = {
    *("mission starts from spawn", "mission ended"),
    *("emergency stop", "acknowledged before touch-down"),
}
"""Causes of state changes that requests bring about."""


def bounds(guard: Guard) -> dict[str, Any]:
    """Copy a guard's limits and the values that it derived from them."""
    parts = (
        (guard, ("_limits", "_speed_max", "_high", "_floor")),
        (guard._position_hold, ("_low", "_high", "_speed_max")),
        (guard._descent, ("_floor", "speed")),
        (guard._take_off, ("_low", "_high")),
    )
    found = {f"{type(part)} {name}": getattr(part, name) for part, names in parts for name in names}
    return deepcopy(found | {"walls": guard._low[:2]})


def fly_hostile(policy: str, seed: int) -> Flight:
    """Fly with a hostile cloud that has valid keys and sends the operator's requests.

    Check that the guard's bounds are the same before and after.
    """
    lie, words = POLICIES[policy](generator(seed, 666)), at_bad_moments(generator(seed, 667))
    flight = Flight(seed=seed, honest=False, lies=[lie], words=words)
    guard, limits = flight.robot.guard, flight.robot.guard._limits
    before = bounds(guard)
    flight.fly(8.0)
    assert flight.robot.guard is guard
    assert guard._limits is limits
    assert bounds(guard) == before == bounds(Guard(limits))
    return flight


@pytest.mark.promise("commands-within-caps")
def test_nothing_in_the_tunnel_changes_the_limits() -> None:
    answers, changes = Counter[str](), []
    for policy, seed in HOSTILE.items():
        flight = fly_hostile(policy, seed)
        answers.update({name: flight.count(name) for name in ANSWERS})
        changes += flight.changes
    assert [name for name in ANSWERS if not answers[name]] == []
    assert {change.state for change in changes} == set(GuardState)
    assert {change.cause for change in changes} >= CAUSES
