"""Teleop apart: it looks now and then, passes the past over, and speaks after its disk."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import pytest

from cloudrc.drivers.teleop import PERIOD_NS, RemoteTeleop, UnixPeer
from cloudrc.faults.flight import Flight
from cloudrc.faults.fuzz import fly
from cloudrc.faults.inject import inject
from cloudrc.faults.models import UNIX_SOCKET_MAX, Apart
from cloudrc.faults.schedule import STALLS, Event, Schedule
from cloudrc.faults.walls import Wall
from cloudrc.messages import OperatorRequest, Setpoint
from cloudrc.records import Fault, MissionEvent
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.wire import Output, RobotStatus

Patch = pytest.MonkeyPatch


class Look(NamedTuple):
    """When teleop has looked [s], and the age of what it has seen [s]."""

    at: float
    age: float


class Story:
    """A flight with teleop apart; what teleop sees and what of its words reaches cloud."""

    def __init__(self, patch: Patch, *events: Event, until: float) -> None:
        self.looks: list[Look] = []
        self.heard: list[tuple[float, Output | Fault]] = []
        told: dict[str, float] = {}
        see, tell, take = MissionService.see, RemoteTeleop.see, RemoteTeleop.take_outputs

        def look(service: MissionService, seen: RobotStatus, now_ns: int) -> None:
            now = self.flight.now
            self.looks.append(Look(now, now - told[repr(seen)]))
            see(service, seen, now_ns)

        def say(remote: RemoteTeleop, seen: RobotStatus, now_ns: int) -> None:
            told[repr(seen)] = self.flight.now
            tell(remote, seen, now_ns)

        def hear(remote: RemoteTeleop) -> list[Output | Fault]:
            said: list[Output | Fault] = take(remote)
            self.heard += [(self.flight.now, each) for each in said]
            return said

        patch.setattr(MissionService, "see", look)
        patch.setattr(RemoteTeleop, "see", say)
        patch.setattr(RemoteTeleop, "take_outputs", hear)
        self.flight = Flight("link.profile=ideal", seed=3, apart=True)
        inject(self.flight, Schedule(3, events=events), Wall())
        self.flight.fly(until)

    @property
    def desk(self) -> Apart:
        assert isinstance(self.flight.desk, Apart)
        return self.flight.desk

    def of(self, kind: type, start: float, end: float) -> list[float]:
        """When cloud has heard something of a kind [s]."""
        return [at for at, said in self.heard if isinstance(said, kind) and start <= at < end]

    def events(self) -> list[str]:
        """What cloud has heard of missions."""
        return [said.event for _, said in self.heard if isinstance(said, MissionEvent)]


def test_teleop_sees_the_newest_state_every_20_ms(patch: Patch) -> None:
    story = Story(patch, until=10.0)
    looks = [look for look in story.looks if look.at > 5.0]
    steps = {round((b.at - a.at) * 1e9) for a, b in pairwise(looks)}
    assert steps == {PERIOD_NS}
    assert max(look.age for look in looks) <= 0.02 + 1e-9
    assert 0.0 < min(look.age for look in looks)
    setpoints = story.of(Setpoint, 5.0, 10.0)
    assert 49 <= len(setpoints) <= 55
    assert story.flight.events("started"), "it flies"


def test_the_phase_of_its_looks_is_one_of_the_seed() -> None:
    schedules = [Schedule(seed, apart=True, duration=3.0) for seed in (1, 2, 1)]
    first, other, again = (fly(schedule, keep=True).sha256 for schedule in schedules)
    assert first == again != other
    assert first != fly(Schedule(1, duration=3.0), keep=True).sha256


def test_after_a_stop_it_passes_over_what_its_socket_has_kept(patch: Patch) -> None:
    story = Story(patch, Event("teleop_paused", 8.0, 2.0), until=12.0)
    before = [look for look in story.looks if look.at < 8.0]
    first = next(look for look in story.looks if look.at > 8.0)
    assert before[-1].at > 7.97
    assert first.at == pytest.approx(10.01, abs=0.012), "its first turn sees nothing"
    assert first.age <= 0.02
    assert story.of(Setpoint, 8.02, 10.0) == []
    assert len(story.of(Fault, 8.0, 10.0)) == 1, "cloud misses it"
    assert story.of(Setpoint, 10.0, 10.2)


def test_messages_of_a_turn_are_sent_after_its_fsync(
    patch: Patch,
) -> None:
    story = Story(patch, Event("held", 8.0, 1.0), Event("journal_slow", 7.9, 1.0, 0.5), until=12.0)
    held = next(entry for entry in story.desk.events if entry.event == "held")
    assert held.stamp_ns * 1e-9 == pytest.approx(8.01, abs=0.012)
    heard = [at for at, said in story.heard if said == held]
    assert heard == [pytest.approx(held.stamp_ns * 1e-9 + 0.5, abs=0.011)]
    assert story.of(Setpoint, 8.1, 8.5) == []
    assert not [look for look in story.looks if 8.02 < look.at < 8.5]
    first = next(look for look in story.looks if look.at > 8.4)
    assert first.age <= 0.02


def test_a_kill_during_an_fsync_stores_but_sends_nothing(patch: Patch) -> None:
    slow, killed = Event("journal_slow", 7.9, 1.0, 0.5), Event("teleop_killed", 8.2, 1.0)
    story = Story(patch, slow, Event("held", 8.0, 0.1), killed, until=9.1)
    assert story.desk.events[-1].event == "held"
    assert story.desk.service is None
    assert "held" not in story.events(), "what waited for the disk was never said"
    story.flight.fly(11.0)
    assert story.flight.mission.state == "held", "what was asked meanwhile was not heard"
    assert "restarted" in [event["event"] for event in story.flight.mission.events]


def test_entries_of_one_turn_are_written_one_after_the_other(patch: Patch) -> None:
    story = Story(patch, Event("journal_slow", 5.0, 5.0, 0.4), until=5.5)
    desk, counts = story.desk, list[int]()
    two: Callable[[MissionService, int], None] = _hold_and_resume
    desk.ask(two, 0)
    before = len(desk.entries)
    for until in (5.55, 5.85, 5.95):
        story.flight.fly(until)
        counts.append(len(desk.entries) - before)
    assert counts == [1, 1, 2]
    desk.kill()
    assert len(desk.entries) == before + 2


def _hold_and_resume(service: MissionService, now_ns: int) -> None:
    service.hold(now_ns)
    service.resume(now_ns)


def test_while_cloud_is_down_only_teleops_events_survive(
    patch: Patch,
) -> None:
    story = Story(patch, Event("cloud_killed", 8.0, 2.0), Event("held", 8.5, 0.5), until=9.9)
    assert [event.event for event in story.desk.events][-2:] == ["held", "resumed"]
    assert "held" not in story.events()
    story.flight.fly(10.1)
    assert story.events()[-2:] == ["held", "resumed"]
    assert len(story.of(Setpoint, 10.0, 10.1)) <= 1, "those said meanwhile are lost"


def test_a_frozen_cloud_has_room_for_eleven_words(patch: Patch) -> None:
    held = Event("held", 7.5, 5.0)
    story = Story(patch, held, Event("cloud_paused", 8.0, 3.0), until=10.99)
    assert story.of(Setpoint, 8.0, 10.99) == []
    story.flight.fly(11.005)
    assert len(story.of(Setpoint, 10.99, 11.005)) == UNIX_SOCKET_MAX


def test_a_frozen_cloud_forwards_no_old_start() -> None:
    """There was no room for the end behind it: the rotors turned until that was said again."""
    flight = Flight("link.profile=ideal", seed=3, apart=True, start=False)
    inject(flight, Schedule(3, events=(Event("cloud_paused", 8.0, 3.03),)), Wall())
    flight.cloud.at(8.2, flight.ask_for_mission)
    flight.cloud.at(10.0, partial(flight.desk.ask, _cancel))
    flight.fly(13.0)
    assert flight.mission.state == "cancelled"
    assert flight.changes == []


def _cancel(service: MissionService, now_ns: int) -> None:
    service.cancel(service.book.open()[0].id, now_ns)


def test_calls_run_before_telemetry_and_die_with_teleop(
    patch: Patch,
) -> None:
    story, order = Story(patch, until=5.0), list[str]()
    see = MissionService.see

    def look(service: MissionService, seen: RobotStatus, now_ns: int) -> None:
        order.append("sees")
        see(service, seen, now_ns)

    patch.setattr(MissionService, "see", look)
    story.desk.ask(lambda service, now_ns: order.append("obeys"), 0)
    assert order == []
    story.flight.fly(5.02)
    assert order == ["obeys", "sees"]
    story.desk.ask(lambda service, now_ns: order.append("obeys"), 0)
    story.desk.kill()
    story.desk.ask(lambda service, now_ns: order.append("obeys"), 0)
    story.desk.start()
    story.flight.fly(5.04)
    assert order.count("obeys") == 1


def test_asked_to_end_it_pauses_in_its_next_turn(patch: Patch) -> None:
    stopped = Event("teleop_paused", 7.5, 1.0)
    story = Story(patch, stopped, Event("teleop_shut_down", 8.0, 4.0, 0.5), until=8.4)
    assert "paused" not in [event.event for event in story.desk.events]
    story.flight.fly(9.0)
    assert story.desk.events[-1].event == "paused"
    asked = [at for at, said in story.heard if isinstance(said, OperatorRequest) and at > 8.0]
    assert asked[0] == pytest.approx(8.51, abs=0.011)
    assert story.flight.fly_mission().mission.state == "done"


@pytest.mark.parametrize("kind", STALLS)
def test_a_fault_of_the_process_takes_teleop_apart(kind: str) -> None:
    schedule = Schedule(3, events=(Event(kind, 8.0, 2.0, 0.5),))
    assert (schedule.apart, schedule.has_teleop_apart) == (False, True)
    assert not Schedule(3, events=(Event("journal_full", 8.0, 2.0),)).has_teleop_apart


def test_a_real_socket_queues_as_many_as_the_model(tmp_path: Path) -> None:
    waiting = int(Path("/proc/sys/net/unix/max_dgram_qlen").read_text())
    ours, other = tmp_path / "ours", tmp_path / "other"
    writer, reader = UnixPeer(ours, other), UnixPeer(other, ours)
    taken = sum(writer.send(b"%d" % n) for n in range(waiting + 5))
    assert taken - waiting == UNIX_SOCKET_MAX - 10
    assert reader.receive() == [b"%d" % n for n in range(taken)], "the oldest stay"
    for peer in (writer, reader):
        peer.close()


@pytest.fixture
def patch(monkeypatch: Patch) -> Patch:
    return monkeypatch
