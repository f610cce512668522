# SPDX-License-Identifier: Apache-2.0

"""Captured datagrams are refused in the next run."""

import pytest

from cloudrc.wire.tunnel.codec import Kind, peek
from tests.faults.flight import FaultRun
from tests.faults.schedule import Schedule

HOVER = (
    "mission.waypoints=[{position_m: [0.5, 0, 0.8], dwell_s: 1}]",
    "mission.touch=null",
)


class Tapped(FaultRun):
    """Capture the datagrams to world and to cloud."""

    def __init__(self, life=1):
        super().__init__(Schedule(1, "ideal"), *HOVER, life=life)
        self.heard = {"world": [], "cloud": []}
        self.ends = {"world": self.world, "cloud": self.cloud}
        for name, end in self.ends.items():
            end.tamper = lambda data, now_ns, heard=self.heard[name]: heard.append(data) or [data]

    def replay(self, heard):
        for name, end in self.ends.items():
            for data in heard[name]:
                end.pass_on(data, self.run.now_ns)

    def accepted(self):
        """Return the counts of accepted datagrams, and the epochs."""
        names = ("used", "late", "repeated", "busy")
        inner = [end.inner for end in self.ends.values()]
        return [*(end.counts[name] for end in inner for name in names), *(e.epoch for e in inner)]


@pytest.fixture(scope="module")
def first():
    return Tapped().fly(6.0)


@pytest.mark.promise("old-datagrams-do-nothing")
@pytest.mark.parametrize("seconds", [0, 1])
def test_a_run_replayed_after_both_restarts_is_not_accepted(first, seconds):
    flight = Tapped(life=2)
    flight.fly(seconds)
    before = flight.accepted()
    flight.replay(first.heard)
    assert flight.accepted() == before
    drawn = [data for end in flight.ends.values() for data in end.take_datagrams()]
    # A challenge and a hello that answers an old one change nothing.
    assert {peek(data)[0] for data in drawn} <= {Kind.CHALLENGE, Kind.HELLO}
    assert len(drawn) <= 4, "a captured run of seconds makes nobody talk"
    flight.fly_mission(flight.now + 20.0)
    assert flight.mission.state == "done"
