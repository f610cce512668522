"""A relay whose delays are long looks at its sockets in time, and is not woken by what comes."""

from __future__ import annotations

import heapq
from types import SimpleNamespace

import numpy as np
import pytest

from cloudrc.link import relay
from cloudrc.link.draws import reach
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import Blackout, Change, DirectionProfile, Trace
from cloudrc.link.relay import Lanes

MS, SECOND = 1_000_000, 1_000_000_000


class Clock:
    """Time passes by itself, 1 us a look, and when somebody sleeps; wakes are 20 us late."""

    now_ns = SECOND

    def monotonic_ns(self) -> int:
        self.now_ns += 1_000
        return self.now_ns

    def sleep(self, duration: float) -> None:
        self.now_ns += round(duration * 1e9) + 20_000


class Lane:
    """Takes datagrams in that come at given instants [ns], 100 us for each, and releases them."""

    def __init__(self, clock: Clock, arrivals: list[int], delays: list[int], least: int) -> None:
        self.clock, self.patience_ns = clock, least
        self.waiting = list(zip(arrivals, delays, strict=True))[::-1]
        self.held: list[int] = []
        self.errors: list[int] = []
        self.takes: list[int] = []
        self.origin_ns = 0
        self.source = SimpleNamespace(socket=SimpleNamespace(fileno=lambda: 7))

    def due_ns(self) -> int | None:
        return self.held[0] if self.held else None

    def take_in(self) -> int:
        count = 0
        while self.waiting and self.waiting[-1][0] <= self.clock.now_ns:
            arrived, delay = self.waiting.pop()
            heapq.heappush(self.held, arrived + delay)
            self.clock.now_ns += 100_000
            count += 1
        self.takes.append(self.clock.now_ns)
        return count

    def release(self) -> None:
        while self.held and self.held[0] <= self.clock.now_ns:
            self.errors.append(self.clock.now_ns - heapq.heappop(self.held))
            self.clock.now_ns += 40_000


class Wait:
    """Sleeps until an instant, or until the lane's next datagram comes."""

    def __init__(self, clock: Clock, lane: Lane) -> None:
        self.clock, self.lane, self.calls = clock, lane, 0

    def until(self, due_ns: int | None, timeout: float) -> list[int]:
        self.calls += 1
        limit = self.clock.now_ns + round(timeout * 1e9)
        wake = limit if due_ns is None else min(limit, due_ns)
        comes = self.lane.waiting[-1][0] if self.lane.waiting else limit
        self.clock.now_ns = max(self.clock.now_ns, min(wake, comes)) + 20_000
        return [7] if comes <= self.clock.now_ns else []


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(relay, "monotonic_ns", made.monotonic_ns)
    monkeypatch.setattr(relay, "sleep", made.sleep)
    return made


def forward(
    clock: Clock, monkeypatch: pytest.MonkeyPatch, period: int, least: int, most: int, count: int
) -> tuple[Lane, Wait]:
    """Forward datagrams of this period and these delays [ns]; the lane and its wait afterwards."""
    rng = np.random.default_rng(3)
    arrivals = (clock.now_ns + period * np.arange(1, count + 1)).tolist()
    delays = rng.integers(least, most + 1, count).tolist()
    lane = Lane(clock, arrivals, delays, least)
    wait = Wait(clock, lane)
    monkeypatch.setattr(relay, "best_wait", lambda sockets: wait)
    lanes = Lanes((lane,), origin_ns=0)  # type: ignore[arg-type]
    while len(lane.errors) < count:
        lanes.step(0.1)
    return lane, wait


def test_100_datagrams_a_second_wake_it_only_for_releases(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    lane, wait = forward(clock, monkeypatch, 10 * MS, 20 * MS, 70 * MS, 3000)
    assert min(lane.errors) >= 0
    assert np.quantile(lane.errors, 0.5) < 5_000
    assert np.quantile(lane.errors, 0.99) < 60_000, "taking in comes before no release"
    assert max(lane.errors) < 200_000
    assert wait.calls < 30, "only where nothing is on its way"
    assert np.diff(lane.takes).max() < 20 * MS, "each is taken in before it is due"
    assert len(lane.takes) < 2400


def test_where_delays_are_short_it_is_woken_by_each(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    lane, wait = forward(clock, monkeypatch, 10 * MS, 1 * MS, 70 * MS, 500)
    assert wait.calls >= 500
    assert min(lane.errors) >= 0
    assert np.quantile(lane.errors, 0.5) < 5_000


def test_where_much_comes_it_is_woken_by_each(
    clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    lane, wait = forward(clock, monkeypatch, 1 * MS, 20 * MS, 21 * MS, 3000)
    assert wait.calls > 2500
    assert min(lane.errors) >= 0


@pytest.mark.parametrize(
    ("profile", "least_ms"),
    [
        (DirectionProfile(0.045, 0.025), 20.0),
        (DirectionProfile(0.3, 0.01, distribution="normal"), 217.0),
        (DirectionProfile(0.02, 0.01, distribution="table", table=(-1.5, 0.0, 1.5)), 5.0),
        (DirectionProfile(0.01, 0.02), 0.0),
        (DirectionProfile(0.045, reorder=0.1), 0.0),
        (DirectionProfile(0.05, changes=(Change(5.0, delay=0.02), Change(9.0, delay=0.2))), 20.0),
        (DirectionProfile(trace=Trace((0.0, 1.0), (0.04, 0.03))), 30.0),
        (DirectionProfile(0.05, blackouts=(Blackout(1.0, 2.0),), rate=1e5), 50.0),
        (DirectionProfile(), 0.0),
    ],
)
def test_the_least_delay_is_known(profile: DirectionProfile, least_ms: float) -> None:
    link = LinkDirection(profile, 1, True)
    assert link.least_delay_ns == pytest.approx(least_ms * MS, abs=1.0)
    link.replace_profile(DirectionProfile(0.009))
    assert link.least_delay_ns == 9 * MS


@pytest.mark.parametrize("distribution", ["uniform", "normal", "pareto"])
@pytest.mark.parametrize("correlation", [0.0, 0.9])
def test_no_packet_is_faster_than_the_least(distribution: str, correlation: float) -> None:
    profile = DirectionProfile(0.2, 0.02, distribution=distribution, correlation=correlation)  # type: ignore[arg-type]
    link = LinkDirection(profile, 7, True)
    delays = [link.send(1, 3, n, 172, 0)[0] for n in range(60_000)]
    assert min(delays) >= link.least_delay_ns
    if distribution != "normal":
        assert min(delays) - link.least_delay_ns < 0.001 * 20 * MS, "and not by far"
    assert reach(profile) > 0.0
