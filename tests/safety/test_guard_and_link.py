"""Promises of guard and link, end to end: from received bytes to the robot's motion."""

from collections import Counter
from copy import deepcopy
from math import hypot, isfinite, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.faults.adversary import POLICIES, at_bad_moments
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import generator
from cloudrc.messages import GuardState
from cloudrc.records import CommandApplied, GroundTruth
from cloudrc.world.guard.state import Guard
from tests.flights.conftest import talking

FLOATS = st.one_of(
    st.floats(width=64),
    st.floats(-1e3, 1e3),
    st.sampled_from([nan, float("inf"), -float("inf"), 1e308, -1e308, 5e-324, -0.0, 6.0, 1e3]),
)


def fly(talk, seconds, velocity):
    """Send a command every 10 ms."""
    for _ in range(round(seconds * 100)):
        talk.wait(10)
        talk.send(talk.command(velocity))


@pytest.mark.promise("commands-within-caps")
@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(FLOATS, FLOATS, FLOATS), min_size=20, max_size=60))
def test_any_command_is_flown_finite_and_within_the_caps(velocities):
    talk = talking()
    fly(talk, 0.3, (0.0, 0.0, 0.5))
    for velocity in velocities:
        fly(talk, 0.02, velocity)
    for record in talk.take(GroundTruth):
        assert all(map(isfinite, (*record.reference, *record.odometry.position)))
        assert hypot(*record.reference) <= 6.0 + 1e-9


@pytest.mark.promise("forged-datagrams-do-nothing")
def test_a_datagram_with_a_changed_bit_has_no_effect():
    talk = talking()
    fly(talk, 0.2, (0.0, 0.0, 0.5))
    applied = len(talk.take(CommandApplied))
    valid = talk.command((3.0, 3.0, 3.0))
    for bit in range(8 * len(valid)):
        forged = bytearray(valid)
        forged[bit // 8] ^= 1 << bit % 8
        talk.send(bytes(forged))
    for cut in range(len(valid)):
        talk.send(valid[:cut])
    talk.wait(100)
    assert len(talk.take(CommandApplied)) <= applied + 1  # one was already queued
    assert all(r.velocity != (3.0, 3.0, 3.0) for r in talk.take(CommandApplied))
    talk.send(valid)
    talk.wait(20)
    assert talk.take(CommandApplied)[-1].velocity == (3.0, 3.0, 3.0)


HOSTILE = {"stop-and-go": 9, "false-basis": 8, "strange-numbers": 9, "refused-and-released": 3}
"""Hostile policies with a seed each; together they cause all ANSWERS and states."""
ANSWERS = ("used", "limited_speed", "limited_yaw_rate", "range", "future", "stale", "start_refused")
"""Counters of applied, limited and refused commands and requests."""


def bounds(guard):
    """Copy a guard's limits and the values that it derived from them."""
    parts = (
        (guard, ("_limits", "_speed_max", "_high", "_floor")),
        (guard._position_hold, ("_low", "_high", "_speed_max")),
        (guard._descent, ("_floor", "speed")),
        (guard._take_off, ("_low", "_high")),
    )
    found = {f"{type(part)} {name}": getattr(part, name) for part, names in parts for name in names}
    return deepcopy(found | {"walls": guard._low[:2]})


@pytest.mark.promise("commands-within-caps")
def test_nothing_in_the_tunnel_changes_the_limits():
    """They come from world's experiment."""
    answers, states = Counter[str](), set()
    for policy, seed in HOSTILE.items():
        lie, words = POLICIES[policy](generator(seed, 666)), at_bad_moments(generator(seed, 667))
        flight = Flight(seed=seed, honest=False, lies=[lie], words=words)
        guard, limits = flight.robot.guard, flight.robot.guard._limits
        before = bounds(guard)
        flight.fly(8.0)
        assert flight.robot.guard is guard
        assert guard._limits is limits
        assert bounds(guard) == before == bounds(Guard(limits))
        answers.update({name: flight.count(name) for name in ANSWERS})
        states |= {change.state for change in flight.changes}
    assert [name for name in ANSWERS if not answers[name]] == []
    assert states == set(GuardState)
