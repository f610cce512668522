"""The models of processes, clocks and teleop."""

from __future__ import annotations

from functools import partial

from hypothesis import given
from hypothesis import strategies as st

from cloudrc.faults.flight import Flight
from cloudrc.faults.models import FAR_NS, SOCKET_MAX, Clock, RestartableEndpoint
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.faults.trial import inject
from cloudrc.messages import GuardState
from cloudrc.records import Record
from cloudrc.teleop.service import MissionService

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


def run(process: RestartableEndpoint, until_ms: float) -> Ticker | None:
    while process.next_deadline_ns() <= until_ms * MS:
        process.handle_deadline(process.next_deadline_ns())
    return process.inner  # type: ignore[return-value]


def test_a_killed_endpoint_is_silent_until_its_successor_runs() -> None:
    process = RestartableEndpoint(Ticker, Clock())
    process.at(0.025, process.kill)
    process.at(0.050, process.start)
    assert run(process, 30) is None
    process.receive_datagram(b"lost", 30 * MS)
    assert process.take_datagrams() == []
    new = run(process, 60)
    assert new is not None
    assert (new.handled, new.heard) == ([50 * MS, 60 * MS], [])
    process.kill(0)
    assert process.next_deadline_ns() == FAR_NS


def test_datagrams_wait_during_a_freeze_and_arrive_together() -> None:
    process = RestartableEndpoint(Ticker, Clock())
    process.at(0.005, lambda now_ns: process.freeze(now_ns, 0.100))
    run(process, 6)
    for n in range(SOCKET_MAX + 5):
        process.receive_datagram(b"%d" % n, (10 + n) * MS // 4)
    end = run(process, 106)
    assert end is not None
    assert [now_ns for _, now_ns in end.heard] == [105 * MS] * SOCKET_MAX
    assert end.handled == [0, 105 * MS]


@given(st.integers(-(2**50), 2**50), st.integers(-500, 500), st.integers(0, 2**45))
def test_a_clock_reaches_a_time_exactly_when_it_says(
    offset_ns: int, drift_ppm: int, now_ns: int
) -> None:
    clock = Clock(offset_ns, drift_ppm)
    when_ns = clock.when(clock.at(now_ns))
    assert when_ns <= now_ns
    assert clock.at(when_ns - 1) < clock.at(now_ns) <= clock.at(when_ns)


def separate(*events: Event, start: bool = True) -> Flight:
    flight = Flight("link.profile=ideal", seed=3, separate=True, start=start)
    inject(flight, Schedule(3, events=events))
    return flight


def test_a_separate_teleop_pauses_and_its_successor_resumes() -> None:
    flight = separate(Event("pod_shut_down", 8.0, 4.0, 0.25)).fly(8.5)
    assert flight.events("paused")
    assert flight.guard_now()[0] is GuardState.HOLD
    flight.fly(9.5)
    assert (flight.teleop.service, flight.cloud.inner) == (None, None)
    assert flight.fly_mission().mission.state == "done"


def test_a_frozen_cloud_forwards_no_old_start() -> None:
    flight = separate(Event("cloud_paused", 8.0, 3.03), start=False)

    def cancel(service: MissionService, now_ns: int) -> None:
        service.cancel(flight.mission.id, now_ns)

    flight.cloud.at(8.2, flight.order_if_possible)
    flight.cloud.at(10.0, partial(flight.teleop.ask, cancel))
    flight.fly(13.0)
    assert flight.mission.state == "cancelled"
    assert flight.changes == []
