"""An end that is killed forgets, one that stands still catches up, and its clock may drift."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cloudrc.faults.models import FAR_NS, SOCKET_MAX, Clock, Mortal
from cloudrc.records import Record

MS = 1_000_000


class Ticker:
    """An endpoint with a deadline every 10 ms that notes what it is told."""

    sealed = True

    def __init__(self, start_ns: int) -> None:
        self.due_ns = start_ns
        self.heard: list[tuple[bytes, int]] = []
        self.handled: list[int] = []

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        self.heard.append((data, now_ns))

    def next_deadline_ns(self) -> int:
        return self.due_ns

    def handle_deadline(self, now_ns: int) -> None:
        self.handled.append(now_ns)
        self.due_ns = now_ns + 10 * MS

    def take_datagrams(self) -> list[bytes]:
        return [b"sent"]

    def take_records(self) -> list[Record]:
        return []


def run(mortal: Mortal, until_ms: float) -> None:
    while mortal.next_deadline_ns() <= until_ms * MS:
        mortal.handle_deadline(mortal.next_deadline_ns())


def inside(mortal: Mortal) -> Ticker:
    assert isinstance(mortal.inner, Ticker)
    return mortal.inner


def test_a_killed_endpoint_is_silent_until_its_successor_runs() -> None:
    mortal = Mortal(Ticker, Clock())
    old = inside(mortal)
    mortal.at(0.025, mortal.kill)
    mortal.at(0.050, mortal.start)
    run(mortal, 30)
    mortal.receive_datagram(b"lost", 30 * MS)
    assert mortal.take_datagrams() == []
    assert mortal.lost == 1
    run(mortal, 60)
    assert inside(mortal) is not old
    assert inside(mortal).handled == [50 * MS, 60 * MS]
    assert inside(mortal).heard == []


def test_datagrams_wait_during_a_freeze_and_arrive_together() -> None:
    mortal = Mortal(Ticker, Clock())
    mortal.at(0.005, lambda now_ns: mortal.freeze(now_ns, 0.100))
    run(mortal, 6)
    for n in range(SOCKET_MAX + 5):
        mortal.receive_datagram(b"%d" % n, (10 + n) * MS // 4)
    run(mortal, 104)
    assert inside(mortal).handled == [0]
    run(mortal, 106)
    assert {now_ns for _, now_ns in inside(mortal).heard} == {105 * MS}
    assert len(inside(mortal).heard) == SOCKET_MAX
    assert mortal.lost == 5
    assert inside(mortal).handled == [0, 105 * MS]


def test_an_end_that_died_has_no_deadline() -> None:
    mortal = Mortal(Ticker, Clock())
    mortal.kill(0)
    assert mortal.next_deadline_ns() == FAR_NS


def test_what_is_tampered_with_gets_in_instead() -> None:
    mortal = Mortal(Ticker, Clock())
    mortal.tamper = lambda data, now_ns: [b"a", b"b"]
    mortal.receive_datagram(b"c", 5)
    assert inside(mortal).heard == [(b"a", 5), (b"b", 5)]


@given(st.integers(-(2**50), 2**50), st.integers(-500, 500), st.integers(0, 2**45))
def test_a_clock_shows_a_deadline_exactly_when_it_is_due(
    offset_ns: int, drift_ppm: int, now_ns: int
) -> None:
    clock = Clock(offset_ns, drift_ppm)
    when_ns = clock.when(clock.at(now_ns))
    assert when_ns <= now_ns
    assert clock.at(when_ns) >= clock.at(now_ns)
    assert clock.at(when_ns - 1) < clock.at(now_ns)


@pytest.mark.parametrize("drift_ppm", [-500, 0, 500])
def test_an_end_lives_on_its_own_clock(drift_ppm: int) -> None:
    mortal = Mortal(Ticker, Clock(7_000 * MS, drift_ppm))
    run(mortal, 2_000)
    count = 201 if not drift_ppm else round(2_000 * (1 + drift_ppm * 1e-6) / 10)
    assert abs(len(inside(mortal).handled) - count) <= 1
    assert inside(mortal).handled[0] == 7_000 * MS
