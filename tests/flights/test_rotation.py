# SPDX-License-Identifier: Apache-2.0

"""A key file is rotated in flight; both ends read it at different times, in either order."""

from itertools import pairwise

import pytest

from cloudrc.wire.messages import GuardState
from cloudrc.wire.tunnel.keys import Key, KeySet
from tests.faults.flight import FaultRun
from tests.faults.inject import SECRET
from tests.faults.measures import epochs
from tests.faults.schedule import Schedule

pytestmark = pytest.mark.usefixtures("shared_files")

NEW = KeySet(Key(b"n" * 32), SECRET.current)
ONLY = KeySet(NEW.current)
DELAY = 0.05
"""One-way delay of the link in both directions [s]."""
HOLD_MAX = 2 * DELAY + 1.1
"""Longest HOLD of a change of keys [s]: a round trip, and the guard's settling time."""
HOVER = (
    "mission.waypoints=[{position_m: [0.5, 0, 0.8], dwell_s: 400, time_limit_s: 500}]",
    *("criteria.time_limit_s=500", "mission.touch=null", f"link.both.delay_ms={DELAY * 1e3}"),
)
ENDS = ("world", "cloud")


def key(flight):
    """The key with which both ends talk in one epoch."""
    world, cloud = (process.inner._session for process in (flight.world, flight.cloud))
    assert world.epoch == cloud.epoch != 0
    assert world.epoch_key == cloud.epoch_key
    return world.epoch_key


def held(flight):
    """How long each HOLD lasted [s]."""
    pairs = pairwise(flight.changes)
    return [(b.stamp_ns - a.stamp_ns) * 1e-9 for a, b in pairs if a.state is GuardState.HOLD]


def rotated(*steps):
    """Fly 5 s; then an end reads keys and the flight goes on for some seconds, again and again."""
    flight = FaultRun(Schedule(1, "ideal"), *HOVER).fly(5.0)
    for end, keys, seconds in steps:
        flight.replace_key(end, keys)
        flight.fly(flight.now + seconds)
    return flight


@pytest.mark.promise("keys-change-in-flight")
@pytest.mark.parametrize(("ends", "apart"), [(ENDS, 0.0), (ENDS[::-1], 8.0)])
def test_a_rotation_costs_one_short_hold_at_most(ends, apart):
    first, second = ends
    flight = rotated((first, NEW, apart), (second, NEW, apart + 6.0))
    assert key(flight) == NEW.current
    for end in ENDS:  # and once the old key is dropped, nothing happens
        flight.replace_key(end, ONLY)
        flight.fly(flight.now + 1.0)
    assert key(flight) == NEW.current
    assert epochs(flight) == [1, 2, 3], "a session, the start from the spawn, the new key"
    (hold,) = held(flight)
    assert hold < HOLD_MAX
    assert flight.count("tag") <= 12 * apart / 60 + 2, "no alert"


@pytest.mark.promise("old-keys-end")
@pytest.mark.parametrize("first", ENDS)
def test_a_dropped_key_ends_its_session_at_once(first):
    """The other end still has the old key alone."""
    flight = rotated((first, ONLY, 3.0))
    process = flight.world if first == "world" else flight.cloud
    assert process.inner.epoch == 0
    assert flight.guard_now()[0] is GuardState.HOLD
    for end in ENDS:
        flight.replace_key(end, ONLY)
    flight.fly(flight.now + 2.0)
    assert key(flight) == NEW.current
    assert flight.guard_now()[0] is GuardState.TRACK
