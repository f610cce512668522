"""Datagrams captured in one run are refused in the next, even if epochs begin again."""

from __future__ import annotations

import pytest

from cloudrc import assembly
from cloudrc.cloud.endpoint import CloudIdentity
from cloudrc.config.load import load_experiment
from cloudrc.drivers.virtual import VirtualRun
from cloudrc.records import Arrival, CommandApplied, SessionOpened
from cloudrc.tunnel.codec import Kind, peek
from cloudrc.tunnel.handshake import COOKIE_NS
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.world.endpoint import WorldIdentity
from tests.flights.conftest import SHARED_CLOCK

EXPERIMENT = load_experiment("hover", ["mission.waypoints.0.dwell_s=1"])
SECOND_NS = 1_000_000_000


class Captured(VirtualRun):
    """Fly with sealed ends and capture all datagrams on the link."""

    def __init__(self, world_nonce: bytes, cloud_nonce: bytes) -> None:
        ring = KeyRing(KeySet(Key(b"k" * 32)))
        identity = WorldIdentity(SHARED_CLOCK, world_nonce.ljust(16), ring)
        self.world = assembly.build_world(EXPERIMENT, identity)
        self.cloud = assembly.build_cloud(
            EXPERIMENT, CloudIdentity(SHARED_CLOCK, cloud_nonce.ljust(16), ring)
        )
        self.heard: dict[bool, list[bytes]] = {True: [], False: []}
        self.of_world, self.of_cloud = [], []
        super().__init__(self.world, self.cloud, *assembly.build_links(EXPERIMENT))

    def _send(self, datagrams, link, *, to_world):
        self.heard[to_world] += datagrams
        super()._send(datagrams, link, to_world=to_world)

    def go(self, until_ns: int) -> None:
        def sink(of_world, of_cloud):
            self.of_world += of_world
            self.of_cloud += of_cloud

        self.fly(lambda: self.now_ns >= until_ns, until_ns, sink)

    def replay(self, other: Captured) -> list[int]:
        """Give both ends all that was heard in another run; the kinds that it draws."""
        for data in other.heard[True]:
            self.world.receive_datagram(data, self.now_ns)
        for data in other.heard[False]:
            self.cloud.receive_datagram(data, self.now_ns)
        drawn = self.world.take_datagrams() + self.cloud.take_datagrams()
        return [peek(data)[0] for data in drawn]


FLOWING = (Kind.TELEMETRY, Kind.COMMAND)


@pytest.fixture(scope="module")
def first() -> Captured:
    run = Captured(b"world 1", b"cloud 1")
    run.go(6 * SECOND_NS)
    assert any(isinstance(record, CommandApplied) for record in run.of_world)
    return run


def accepted(run: Captured) -> dict[str, int]:
    """Return the counts of accepted datagrams of a replay."""
    counts = {f"world {n}": run.world._counts[n] for n in ("used", "late", "repeated", "busy")}
    counts |= {f"cloud {n}": run.cloud._counts[n] for n in ("used", "late", "repeated", "busy")}
    return counts | {"sessions": run.world._session.epoch + run.cloud._session.epoch}


@pytest.mark.promise("old-datagrams-do-nothing")
@pytest.mark.parametrize("seconds", [0, 0.05, 1, 3])
def test_a_run_replayed_after_both_restarts_is_not_accepted(first, seconds, figure):
    run = Captured(b"world 2", b"cloud 2")
    run.go(round(seconds * SECOND_NS))
    before = accepted(run)
    drawn = run.replay(first)
    assert accepted(run) == before
    count = sum(map(len, first.heard.values()))
    figure("a run replayed after both restarts: accepted", 0, "==", 0, count=count)
    # A challenge and a hello that answers an old one change nothing.
    assert set(drawn) <= {Kind.CHALLENGE, Kind.HELLO}
    assert len(drawn) <= 4, "a captured run of seconds makes nobody talk"
    run.go(run.now_ns + 6 * SECOND_NS)
    assert run.cloud.teleop.outcome is None or run.cloud.teleop.outcome.success


def test_a_run_replayed_during_the_run_is_all_repeated():
    run = Captured(b"world 1", b"cloud 1")
    run.go(4 * SECOND_NS)
    captured = {way: list(heard) for way, heard in run.heard.items()}
    arrivals = [r for r in run.of_world + run.of_cloud if isinstance(r, Arrival) and r.used]
    run.of_world, run.of_cloud = [], []
    epoch = run.world._session.epoch
    for _ in range(2):
        for data in captured[True]:
            if peek(data)[0] != Kind.HELLO:
                run.world.receive_datagram(data, run.now_ns)
        for data in captured[False]:
            run.cloud.receive_datagram(data, run.now_ns)
    used = [r for r in run.world.take_records() + run.cloud.take_records()
            if isinstance(r, Arrival) and r.used]  # fmt: skip
    # A datagram still on the link counts once, if its copy arrives first.
    assert len({(r.uplink, r.epoch, r.counter) for r in arrivals + used}) == len(arrivals + used)
    assert run.world._session.epoch == epoch


def test_a_flood_of_repeats_is_counted_but_not_recorded():
    run = Captured(b"world 1", b"cloud 1")
    run.go(2 * SECOND_NS)
    heard = {way: [d for d in data if peek(d)[0] in FLOWING] for way, data in run.heard.items()}
    run.world.take_records(), run.cloud.take_records()
    for _ in range(10):
        for way, end in ((True, run.world), (False, run.cloud)):
            for data in heard[way]:
                end.receive_datagram(data, run.now_ns)
    for way, end in ((True, run.world), (False, run.cloud)):
        assert end._counts["repeated"] > 9 * len(heard[way])
        told = [record for record in end.take_records() if isinstance(record, Arrival)]
        assert 0 < len(told) <= len(heard[way]) + end._channel._newest + 2


def test_sealed_and_unsealed_flights_are_the_same_flight():
    """Flights in virtual time are unsealed; nothing else may differ."""
    from cloudrc.record.hash import RecordHash

    digests = []
    for ring in (None, KeyRing(KeySet(Key(b"k" * 32)))):
        world = assembly.build_world(EXPERIMENT, WorldIdentity(SHARED_CLOCK, b"w" * 16, ring=ring))
        cloud = assembly.build_cloud(EXPERIMENT, CloudIdentity(SHARED_CLOCK, b"c" * 16, ring))
        digest = RecordHash()
        run = VirtualRun(world, cloud, *assembly.build_links(EXPERIMENT))

        def sink(of_world, of_cloud, digest=digest):
            digest.update(of_world)
            digest.update(of_cloud)

        run.fly(lambda: cloud.mission_over, 30 * SECOND_NS, sink)  # noqa: B023
        digests.append(digest.hexdigest())
    assert digests[0] == digests[1]


def restart_cloud(run: Captured, name: bytes) -> None:
    run.cloud = run._cloud = assembly.build_cloud(
        load_experiment("hover", ["mission.start=here", "mission.waypoints.0.dwell_s=1"]),
        CloudIdentity(SHARED_CLOCK, name.ljust(16), run.world._session.ring),
        lambda: run.now_ns,
    )


def is_back(run: Captured, restarted_ns: int, within_ns: int = SECOND_NS) -> None:
    opened = [r for r in run.of_world if isinstance(r, SessionOpened)][-1]
    used = [r for r in run.of_world if isinstance(r, Arrival) and r.used and r.epoch == 3]
    assert opened.epoch == 3
    assert opened.stamp_ns - restarted_ns <= within_ns
    assert used[0].stamp_ns - restarted_ns <= within_ns + 0.2 * SECOND_NS


def test_a_restarted_cloud_commands_within_a_second():
    run = Captured(b"world 1", b"cloud 1")
    run.go(4 * SECOND_NS)
    restart_cloud(run, b"cloud 2")
    run.go(6 * SECOND_NS)
    is_back(run, 4 * SECOND_NS)


def greetings(run: Captured, kind: Kind, *, to_world: bool) -> list[bytes]:
    return [data for data in run.heard[to_world] if peek(data)[0] == kind]


@pytest.mark.parametrize("rate_hz", [18, 25, 100, 500])
@pytest.mark.parametrize("which", ["old hello", "fresh hello", "hellos", "challenges", "all"])
def test_repeated_greetings_do_not_delay_a_restarted_cloud(first, which, rate_hz):
    """Captured greetings keep valid tags; they must not keep out an honest cloud."""
    run = Captured(b"world 2", b"cloud 2")
    run.go(4 * SECOND_NS)
    hellos = greetings(first, Kind.HELLO, to_world=True)
    challenges = greetings(first, Kind.CHALLENGE, to_world=False)
    fresh = greetings(run, Kind.HELLO, to_world=True)[-1:]
    assert min(len(hellos), 2 * len(challenges), 2 * len(fresh)) == 2, "with a cookie and without"
    to_world = {"old hello": hellos[:1], "fresh hello": fresh, "challenges": []}.get(
        which, hellos + fresh
    )
    to_cloud = challenges if which in ("challenges", "all") else []
    restarted_ns = run.now_ns
    restart_cloud(run, b"cloud 3")
    for _ in range((4 if to_cloud else 2) * rate_hz):
        for data in to_world:
            run.world.receive_datagram(data, run.now_ns)
        for data in to_cloud:
            run.cloud.receive_datagram(data, run.now_ns)
        run.go(run.now_ns + SECOND_NS // rate_hz)
    # An old challenge may replace a new one until the next time slot.
    is_back(run, restarted_ns, SECOND_NS + (COOKIE_NS if to_cloud else 0))
