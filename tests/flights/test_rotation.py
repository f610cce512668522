"""A key file is rotated in flight; both ends read it at different times, in either order."""

from __future__ import annotations

from itertools import pairwise

import pytest

from cloudrc import assembly
from cloudrc.cloud.endpoint import CloudIdentity
from cloudrc.config.load import load_experiment
from cloudrc.drivers.virtual import VirtualRun
from cloudrc.messages import GuardState
from cloudrc.records import Counted, GuardChange, Record, SessionOpened
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.world.endpoint import WorldIdentity
from tests.flights.conftest import SHARED_CLOCK

S = 1_000_000_000
OLD, NEW = KeySet(Key(b"o" * 32)), KeySet(Key(b"n" * 32), Key(b"o" * 32))
ORDERS = (("world", "cloud"), ("cloud", "world"))
DELAY = 0.05
"""One-way delay of the link in both directions [s]."""
HOLD_MAX = 2 * DELAY + 1.1
"""Longest HOLD of a change of keys [s]: a round trip, and the guard's settling time."""
CHANGES = {
    "link.profile": "ideal",
    "link.uplink.delay_ms": DELAY * 1e3,
    "link.downlink.delay_ms": DELAY * 1e3,
    "mission.waypoints.0.dwell_s": 400,
    "mission.waypoints.0.time_limit_s": 500,
    "criteria.time_limit_s": 500,
}
EXPERIMENT = load_experiment("hover", [f"{name}={value}" for name, value in CHANGES.items()])


class Flight:
    """Fly with one key file per end."""

    def __init__(self, **keys: KeySet) -> None:
        self.rings = {end: KeyRing(keys.get(end, OLD)) for end in ("world", "cloud")}
        self.records: list[Record] = []
        world = WorldIdentity(SHARED_CLOCK, b"world".ljust(16), ring=self.rings["world"])
        cloud = CloudIdentity(SHARED_CLOCK, b"cloud".ljust(16), self.rings["cloud"])
        self.world = assembly.build_world(EXPERIMENT, world)
        self.cloud = assembly.build_cloud(EXPERIMENT, cloud)
        self.run = VirtualRun(self.world, self.cloud, *assembly.build_links(EXPERIMENT))

    def fly(self, seconds: float) -> None:
        def sink(of_world: list[Record], of_cloud: list[Record]) -> None:
            self.records += of_world

        self.run.fly(lambda: False, self.run.now_ns + round(seconds * S), sink)

    def of(self, kind: type) -> list[Record]:
        return [record for record in self.records if isinstance(record, kind)]

    def held(self) -> list[float]:
        """How long each HOLD lasted [s]."""
        changes = [r for r in self.records if isinstance(r, GuardChange)]
        pairs = pairwise(changes)
        return [
            (then.stamp_ns - now.stamp_ns) * 1e-9
            for now, then in pairs
            if now.state is GuardState.HOLD
        ]

    def key(self) -> Key:
        """The key with which both ends talk in one epoch."""
        world, cloud = self.world._session, self.cloud._session
        assert world.epoch == cloud.epoch != 0
        assert world.epoch_key == cloud.epoch_key
        return world.epoch_key

    def refused(self) -> int:
        totals = [r.total for r in self.records if isinstance(r, Counted) and r.name == "tag"]
        return totals[-1] if totals else 0


@pytest.mark.promise("keys-change-in-flight")
@pytest.mark.parametrize("apart", [0.0, 0.02, 60.0])
@pytest.mark.parametrize("order", ORDERS)
def test_a_rotation_costs_one_short_hold_at_most(order: tuple[str, str], apart: float) -> None:
    flight = Flight()
    flight.fly(5.0)
    epochs = len(flight.of(SessionOpened))
    for end in order:
        flight.rings[end].keys = NEW
        flight.fly(apart)
    flight.fly(6.0)
    assert flight.key() == NEW.current
    for end in order:  # and once the old key is dropped, nothing happens
        flight.rings[end].keys = KeySet(NEW.current)
        flight.fly(1.0)
    assert flight.key() == NEW.current
    assert len(flight.of(SessionOpened)) == epochs + 1
    (held,) = flight.held()
    assert held < HOLD_MAX
    assert flight.refused() <= 12 * apart / 60 + 2, "no alert"


@pytest.mark.parametrize("ends", [{"world": NEW}, {"cloud": NEW}, {"world": NEW, "cloud": NEW}])
def test_ends_that_start_amid_a_rotation_find_their_key(ends: dict[str, KeySet]) -> None:
    flight = Flight(**ends)
    flight.fly(2.0)
    assert flight.key() == (NEW if len(ends) == 2 else OLD).current
    assert flight.held() == []


@pytest.mark.promise("old-keys-end")
@pytest.mark.parametrize("first", ["world", "cloud"])
def test_a_dropped_key_ends_its_session_at_once(first: str) -> None:
    """The other end still has the old key alone."""
    flight, only = Flight(), KeySet(NEW.current)
    flight.fly(5.0)
    flight.rings[first].keys = only
    flight.fly(3.0)
    ends = {"world": flight.world, "cloud": flight.cloud}
    assert ends[first]._session.epoch == 0
    assert flight.world.robot.guard.state is GuardState.HOLD
    for end in ends:
        flight.rings[end].keys = only
    flight.fly(2.0)
    assert flight.key() == NEW.current
    assert flight.world.robot.guard.state is GuardState.TRACK


@pytest.mark.parametrize("first", ["world", "cloud"])
def test_a_key_dropped_before_the_change_costs_one_hold(first: str) -> None:
    """One end has both keys, and their session still has the old one."""
    flight, only = Flight(), KeySet(NEW.current)
    other = "cloud" if first == "world" else "world"
    flight.fly(5.0)
    flight.rings[other].keys = KeySet(OLD.current, NEW.current)
    flight.fly(1.0)
    flight.rings[first].keys = only
    flight.fly(3.0)
    assert flight.key() == NEW.current
    (held,) = flight.held()
    assert held < HOLD_MAX + 1.0
