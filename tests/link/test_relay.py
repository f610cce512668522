"""The relay over real sockets on 127.0.0.1."""

from __future__ import annotations

import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay import Relay, bind_loopback

pytestmark = pytest.mark.process
PATIENCE = 5.0


def peek(data: bytes) -> tuple[int, int, int]:
    if len(data) != 4:
        raise ValueError("not ours")
    return 3, 1, int.from_bytes(data, "little")


def packet(n: int) -> bytes:
    return n.to_bytes(4, "little")


def until(condition: Callable[[], bool]) -> None:
    limit = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < limit, "never came true"


class Bench:
    """A world, a cloud and a relay between them, each on a socket of its own."""

    def __init__(self, up: DirectionProfile, down: DirectionProfile, **options: int) -> None:
        self.world, self.cloud, self._world_side, self._cloud_side = (
            bind_loopback() for _ in range(4)
        )
        for end in (self.world, self.cloud):
            end.settimeout(PATIENCE)
        self.relay = Relay(
            LinkDirection(up, 1, True),
            LinkDirection(down, 1, False),
            peek,
            world_side=self._world_side,
            cloud_side=self._cloud_side,
            cloud_peer=self.cloud.getsockname(),
            **options,
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.relay.run, args=(self._stop.is_set,))
        self._thread.start()

    def up(self, data: bytes) -> None:
        self.world.sendto(data, self._world_side.getsockname())

    def down(self, data: bytes) -> None:
        self.cloud.sendto(data, self._cloud_side.getsockname())

    def close(self) -> float:
        began = time.monotonic()
        self._stop.set()
        self._thread.join(PATIENCE)
        took = time.monotonic() - began
        for one in (self.world, self.cloud, self._world_side, self._cloud_side):
            one.close()
        return took


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    benches: list[Bench] = []

    def make(up: DirectionProfile, down: DirectionProfile | None = None, **options: int) -> Bench:
        benches.append(Bench(up, down or DirectionProfile(), **options))
        return benches[-1]

    yield make
    assert max(one.close() for one in benches) < 0.2 + 0.1, "slow to stop"


def test_the_delays_are_the_models_and_nothing_is_early(bench: Callable[..., Bench]) -> None:
    profile = DirectionProfile(0.020, 0.010)
    pair, model = bench(profile), LinkDirection(profile, 1, True)
    errors = []
    for n in range(20):
        sent = time.monotonic_ns()
        pair.up(packet(n))
        assert pair.cloud.recv(100) == packet(n)
        (wanted,) = model.send(1, 3, n, 4, 0)
        errors.append(time.monotonic_ns() - sent - wanted)
    assert min(errors) >= 0
    assert sorted(errors)[10] < 10_000_000
    assert 0 <= pair.relay.counts()["release_error_p99"] < 0.1


def test_both_directions_pass_and_the_world_is_learned(bench: Callable[..., Bench]) -> None:
    pair = bench(DirectionProfile(), DirectionProfile(duplicate=1.0))
    pair.down(packet(9))  # World is not known yet.
    until(lambda: pair.relay.counts()["unsent"] == 2)
    pair.up(packet(1))
    assert pair.cloud.recv(100) == packet(1)
    pair.down(packet(2))
    assert [pair.world.recv(100) for _ in range(2)] == [packet(2)] * 2
    until(lambda: pair.relay.counts()["forwarded"] == 3)
    assert pair.relay.counts()["received"] == 3


def test_packets_overtake_as_the_model_says(bench: Callable[..., Bench]) -> None:
    profile = DirectionProfile(0.2, reorder=0.5)
    pair, model = bench(profile), LinkDirection(profile, 1, True)
    for n in range(10):
        pair.up(packet(n))
    arrived = [int.from_bytes(pair.cloud.recv(100), "little") for _ in range(10)]
    expected = sorted(range(10), key=lambda n: model.send(1, 3, n, 4, 0))
    assert arrived == expected != list(range(10))


def test_what_is_lost_malformed_or_too_much_is_counted(bench: Callable[..., Bench]) -> None:
    pair = bench(DirectionProfile(0.1), DirectionProfile(loss=1.0), in_flight_max=3)
    for data in (b"", b"xyz", bytes(1400)):
        pair.up(data)
    for n in range(5):
        pair.up(packet(n))
    pair.down(packet(1))
    assert [pair.cloud.recv(100) for _ in range(3)] == [packet(n) for n in range(3)]
    counts = pair.relay.counts()
    assert {name: counts[name] for name in ("received", "malformed", "overflow", "lost")} == {
        "received": 9,
        "malformed": 3,
        "overflow": 2,
        "lost": 1,
    }


def test_a_peer_that_is_gone_does_not_stop_the_relay(bench: Callable[..., Bench]) -> None:
    pair = bench(DirectionProfile())
    pair.cloud.close()
    pair.up(packet(1))
    pair.up(packet(2))
    pair.cloud = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    pair.cloud.settimeout(PATIENCE)
    pair.cloud.bind(pair.relay._cloud.peer)  # The same address as before.
    pair.up(packet(3))
    assert packet(3) in (pair.cloud.recv(100) for _ in range(3))


def test_a_signal_ends_it_in_a_fifth_of_a_second() -> None:
    sides = bind_loopback(), bind_loopback()
    direction = LinkDirection(DirectionProfile(), 1, True)
    relay = Relay(direction, direction, peek, world_side=sides[0], cloud_side=sides[1])
    rung: list[float] = []
    before = signal.signal(signal.SIGALRM, lambda *_: rung.append(time.monotonic()))
    signal.setitimer(signal.ITIMER_REAL, 0.05)
    relay.run(lambda: bool(rung))
    ended = time.monotonic()
    signal.signal(signal.SIGALRM, before)
    for side in sides:
        side.close()
    assert ended - rung[0] < 0.2
