"""The relay over real sockets on 127.0.0.1."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cloudrc.exposition.table import LINK_OUTCOMES
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay import (
    AGE_MAX_NS,
    BATCH,
    Lane,
    Relay,
    Stamps,
    ask_for_fifo,
    instant_ns,
    tighten_slack,
)
from tests.drivers.conftest import FAST
from tests.link.conftest import bind_loopback
from tools.bench_link.flow import Way, flood, run_flow
from tools.bench_link.relays import ours
from tools.bench_link.stages import LINK, overload

linux = pytest.mark.skipif(sys.platform != "linux", reason="Linux alone has it")
PATIENCE = 5.0
MS, SECOND = 1_000_000, 1_000_000_000
TRIES = 3
"""Flights, and floods: other programs may delay one of them."""


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
    """A world, a cloud and a relay between them, each with a socket."""

    def __init__(self, up: DirectionProfile, down: DirectionProfile, **options: int) -> None:
        self.world, self.cloud, self.world_side, self.cloud_side = (
            bind_loopback() for _ in range(4)
        )
        for end in (self.world, self.cloud):
            end.settimeout(PATIENCE)
        self.relay = Relay(
            LinkDirection(up, 1, True),
            LinkDirection(down, 1, False),
            peek,
            world_side=self.world_side,
            cloud_side=self.cloud_side,
            world_peer=self.world.getsockname(),
            cloud_peer=self.cloud.getsockname(),
            **options,
        )
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self.relay.run, args=(self._stop.is_set,))
        self._thread.start()

    def up(self, data: bytes) -> None:
        self.world.sendto(data, self.world_side.getsockname())

    def down(self, data: bytes) -> None:
        self.cloud.sendto(data, self.cloud_side.getsockname())

    def close(self) -> None:
        self._stop.set()
        self._thread.join(PATIENCE)
        for one in (self.world, self.cloud, self.world_side, self.cloud_side):
            one.close()


@pytest.fixture
def bench() -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def make(up: DirectionProfile, down: DirectionProfile | None = None, **more: int) -> Bench:
        made.append(Bench(up, down or DirectionProfile(), **more))
        return made[-1]

    yield make
    for one in made:
        one.close()


def test_a_packet_leaves_when_the_model_says_never_earlier(bench: Callable[..., Bench]) -> None:
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
    assert sorted(errors)[10] < 50_000_000
    assert 0 <= pair.relay.counts()["release_error_p99"] < 0.1
    until(lambda: pair.relay.released("uplink")["released"] == 20)
    assert pair.relay.released("downlink") == {}


def test_packets_overtake_as_the_model_says(bench: Callable[..., Bench]) -> None:
    profile = DirectionProfile(0.2, reorder=0.5)
    pair, model = bench(profile), LinkDirection(profile, 1, True)
    for n in range(10):
        pair.up(packet(n))
    arrived = [int.from_bytes(pair.cloud.recv(100), "little") for _ in range(10)]
    expected = sorted(range(10), key=lambda n: model.send(1, 3, n, 4, 0))
    assert arrived == expected != list(range(10))


def test_every_datagram_is_counted_once(bench: Callable[..., Bench]) -> None:
    pair = bench(DirectionProfile(0.1), DirectionProfile(loss=1.0), in_flight_max=3)
    for data in (b"", b"xyz", bytes(1400), bytes(5000)):
        pair.up(data)
    for n in range(5):
        pair.up(packet(n))
    pair.down(packet(1))
    assert [pair.cloud.recv(100) for _ in range(3)] == [packet(n) for n in range(3)]
    counts = {"received": 10, "malformed": 4, "overflow": 2, "lost": 1, "forwarded": 3}
    until(lambda: pair.relay.outcomes() == {**dict.fromkeys(LINK_OUTCOMES, 0), **counts})


def test_strangers_reach_neither_end(bench: Callable[..., Bench]) -> None:
    pair = bench(DirectionProfile(), DirectionProfile(duplicate=1.0))
    with bind_loopback() as stranger:
        for side in (pair.world_side, pair.cloud_side):
            stranger.sendto(packet(7), side.getsockname())
    pair.up(packet(1))
    pair.down(packet(2))
    assert pair.cloud.recv(100) == packet(1)
    assert [pair.world.recv(100) for _ in range(2)] == [packet(2)] * 2
    until(lambda: pair.relay.counts()["forwarded"] == 3)
    assert pair.relay.counts()["received"] == 2


def test_an_end_that_restarts_is_served_again(bench: Callable[..., Bench]) -> None:
    pair = bench(DirectionProfile())
    address = pair.cloud.getsockname()
    pair.cloud.close()
    for n in range(3):
        pair.up(packet(n))
    pair.cloud = bind_loopback(address[1])
    pair.cloud.settimeout(PATIENCE)
    pair.down(packet(9))
    assert pair.world.recv(100) == packet(9)
    pair.up(packet(3))
    assert packet(3) in (pair.cloud.recv(100) for _ in range(4))


def test_a_refused_datagram_is_unsent(bench: Callable[..., Bench]) -> None:
    with bind_loopback() as source, bind_loopback() as sender:

        def send(data: bytes) -> None:
            raise PermissionError

        lane = Lane(source, send, LinkDirection(DirectionProfile(), 1, True), peek)
        for n in range(BATCH + 5):
            sender.sendto(packet(n), source.getsockname())
        lane.take_in()
        assert lane.counts()["received"] == BATCH, "the other lane has its turn"
        lane.release()
        assert (lane.counts()["unsent"], lane.due_ns()) == (BATCH, None)


def test_a_signal_ends_it_in_a_fifth_of_a_second(bench: Callable[..., Bench]) -> None:
    with bind_loopback() as one, bind_loopback() as other:
        direction = LinkDirection(DirectionProfile(), 1, True)
        relay = Relay(
            direction,
            direction,
            peek,
            world_side=one,
            cloud_side=other,
            world_peer=("127.0.0.1", 9),
            cloud_peer=("127.0.0.1", 9),
        )
        rung: list[float] = []
        before = signal.signal(signal.SIGALRM, lambda *_: rung.append(time.monotonic()))
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        relay.run(lambda: bool(rung))
        ended = time.monotonic()
        signal.signal(signal.SIGALRM, before)
    assert ended - rung[0] < 0.2


@pytest.mark.process
@pytest.mark.full
def test_a_flood_is_bounded_counted_and_over_in_a_second(tmp_path: Path) -> None:
    for _ in range(TRIES):
        memory, counted, recovered = overload(tmp_path, 60_000, 1.0)
        assert memory.held, memory
        assert counted.held, counted
        if recovered.held:
            return
    pytest.fail(str(recovered))


@pytest.mark.process
def test_a_flood_of_strangers_is_not_even_received(tmp_path: Path) -> None:
    relay = ours(tmp_path, LINK)
    up, down = relay.ways
    strangers = threading.Thread(target=flood, args=(Way(True, up.target, up.sink), 5_000, 2.0))
    strangers.start()
    flows = run_flow([up, down], 100.0, 2.0, 0.5)
    strangers.join()
    relay.stop()
    assert [len(flow.arrived) for flow in flows] == [200, 200]
    assert relay.counts()["received"] == 400


@pytest.mark.process
def test_5000_strangers_a_second_cost_no_hold(tmp_path: Path) -> None:
    """A local flight of a few seconds, in which strangers flood both sides of its relay."""
    holds = []
    for attempt in range(TRIES):
        folder = tmp_path / str(attempt)
        words = [*FAST, "run", "hover", "--mode", "local"]
        words += ["--set", "mission.waypoints.0.dwell_s=4", "--out", str(folder)]
        run = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        assert run.stdout is not None
        for line in run.stdout:
            if "mission started" in line:
                break
        ways = [Way(True, at, ("127.0.0.1", 9)) for at in relay_addresses(run.pid)]
        floods = [threading.Thread(target=flood, args=(way, 2_500, 3.0)) for way in ways]
        for one in floods:
            one.start()
        for one in floods:
            one.join()
        run.communicate(timeout=90)
        report = json.loads((folder / "report.json").read_text())
        holds.append(report["numbers"]["hold_count"]["value"])
        if holds[-1] == 0:
            return
    pytest.fail(f"HOLDs in {TRIES} flights: {holds}")


def relay_addresses(parent: int) -> list[tuple[str, int]]:
    """Find the addresses of a local run's relay, world's side and cloud's, in its command line."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_text().split("\0")
            stat = (path.parent / "stat").read_text()
        except OSError:
            continue
        if "relay" in words and int(stat.rpartition(")")[2].split()[1]) == parent:
            sides = [word for word in words if "-side=" in word]
            return [("127.0.0.1", int(side.rpartition(":")[2])) for side in sides]
    raise AssertionError("no relay")


def stamp(wall_ns: int) -> tuple[int, int, bytes]:
    seconds, rest = divmod(wall_ns, SECOND)
    return 1, 35, seconds.to_bytes(8, "little") + rest.to_bytes(8, "little")


def dropped(count: int) -> tuple[int, int, bytes]:
    return 1, 40, count.to_bytes(4, "little")


def test_a_stamp_becomes_an_age() -> None:
    stamps, now_ns = Stamps(), 5 * SECOND
    wall_ns = 1_700_000_000 * SECOND
    offset_ns = now_ns - wall_ns
    for age_ns, counted_ns in ((7_000, 7_000), (0, 0), (-3_000, 0), (80 * MS, AGE_MAX_NS)):
        came_ns = stamps.wall_ns([stamp(wall_ns - age_ns)])
        assert now_ns - instant_ns(came_ns, offset_ns, now_ns) == counted_ns
    assert stamps.wall_ns([]) is None
    assert instant_ns(None, 0, now_ns) == instant_ns(now_ns - MS, None, now_ns) == now_ns


def test_a_set_wall_clock_is_noticed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    stamps, shift = Stamps(), 0
    monkeypatch.setattr("time.monotonic_ns", lambda: 5 * SECOND)
    monkeypatch.setattr("time.time_ns", lambda: 1_700_000_000 * SECOND + shift)
    usual = stamps.look_at_clocks()
    assert usual == stamps.look_at_clocks() == 5 * SECOND - 1_700_000_000 * SECOND
    shift = -3 * SECOND
    assert stamps.look_at_clocks() is None
    assert stamps.look_at_clocks() == 5 * SECOND - 1_700_000_000 * SECOND + 3 * SECOND


def test_what_the_kernel_dropped_is_counted_beyond_32_bits() -> None:
    stamps = Stamps()
    for total in (5, 5, 9, 2**32 - 1, 3):
        stamps.wall_ns([dropped(total), stamp(0)])
    assert stamps.dropped == 2**32 + 3


def in_a_thread(act: Callable[[], object]) -> object:
    """Return what `act` returns in a thread, with which its priority and slack end."""
    found: list[object] = []
    thread = threading.Thread(target=lambda: found.append(act()))
    thread.start()
    thread.join()
    return found[0]


@linux
def test_a_thread_gets_priority_if_permitted_and_exact_sleeps() -> None:
    def first() -> bool:
        return os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO

    def ask() -> object:
        tighten_slack()
        slack_ns = ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)  # PR_GET_TIMERSLACK
        return (not ask_for_fifo()) is first(), in_a_thread(first), slack_ns <= 1

    assert in_a_thread(ask) == (True, False, True), "a child thread is ordinary again"


def test_a_refused_priority_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert ask_for_fifo() == "Operation not permitted; it takes CAP_SYS_NICE or a limit on rtprio"
    monkeypatch.delattr(os, "SCHED_FIFO")
    assert ask_for_fifo() == "this system has no SCHED_FIFO"
