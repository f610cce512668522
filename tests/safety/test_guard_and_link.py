"""Promises of guard and link, end to end: from received bytes to the robot's motion."""

from math import hypot, isfinite, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.faults.adversary import POLICIES, at_bad_moments
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import generator
from cloudrc.messages import GuardState
from cloudrc.records import GroundTruth
from cloudrc.world.guard.state import Guard
from tests.flights.conftest import talking

FLOATS = st.one_of(
    st.floats(width=64),
    st.floats(-1e3, 1e3),
    st.sampled_from([nan, float("inf"), -float("inf"), 1e308, -1e308, 5e-324, -0.0, 6.0, 1e3]),
)


@pytest.mark.promise("commands-within-caps")
@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(FLOATS, FLOATS, FLOATS), min_size=20, max_size=60))
def test_any_command_is_flown_finite_and_within_the_caps(velocities):
    talk = talking()
    climb = [(0.0, 0.0, 0.5)] * 30
    for velocity in (*climb, *(velocity for velocity in velocities for _ in range(2))):
        talk.wait(10)
        talk.send(talk.command(velocity))
    for record in talk.take(GroundTruth):
        assert all(map(isfinite, (*record.reference, *record.odometry.position)))
        assert hypot(*record.reference) <= 6.0 + 1e-9


HOSTILE = {"stop-and-go": 9, "false-basis": 8, "strange-numbers": 9, "refused-and-released": 3}
"""Hostile policies with a seed each; together they cause all states."""
BOUNDS = {"_limits", "_speed_max", "_floor", "_high", "speed"}
"""Attributes of a guard and of its parts that are its limits or are derived from them."""


def bounds(guard):
    parts = (guard, guard._position_hold, guard._descent, guard._take_off)
    found = [vars(part)[name] for part in parts for name in sorted(BOUNDS & vars(part).keys())]
    return *found, guard._low[:2], guard._position_hold._low, guard._take_off._low


@pytest.mark.promise("commands-within-caps")
def test_nothing_in_the_tunnel_changes_the_limits():
    """They come from world's experiment."""
    states = set()
    for policy, seed in HOSTILE.items():
        lie, words = POLICIES[policy](generator(seed, 666)), at_bad_moments(generator(seed, 667))
        flight = Flight(seed=seed, honest=False, lies=[lie], words=words)
        guard, before = flight.robot.guard, bounds(flight.robot.guard)
        flight.fly(8.0)
        assert bounds(flight.robot.guard) == before == bounds(Guard(guard._limits))
        states |= {change.state for change in flight.changes}
    assert states == set(GuardState)
