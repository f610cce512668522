"""Shutdowns, lost names, keys, killed recorders and a controller's bugs in a random search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from cloudrc.cloud.operator import EmergencyStopRepeater
from cloudrc.faults import fuzz
from cloudrc.faults.adversary import choose
from cloudrc.faults.flight import Flight
from cloudrc.faults.fuzz import fly, judged
from cloudrc.faults.inject import inject
from cloudrc.faults.remains import KILLED
from cloudrc.faults.schedule import (
    KINDS,
    RANGES,
    STALLS,
    Event,
    Schedule,
    calm,
    compose,
    dump,
    load,
    shrink,
)
from cloudrc.faults.walls import Wall
from cloudrc.link.follow import PeerName
from cloudrc.messages import GuardState
from cloudrc.record.recover import Recovery, recover
from cloudrc.teleop.bridge import WAITING_MAX
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.wire import RobotStatus
from cloudrc.tunnel.keys import KeySet

Patch = pytest.MonkeyPatch
NEW = (
    *("teleop_shut_down", "pod_shut_down", "names_lost", "key_wrong"),
    *("values_invalid", "values_huge", "stopped", *KILLED, *STALLS),
)


def _flown(*events: Event, until: float = 25.0) -> set[str]:
    return fly(Schedule(3, events=events, duration=until)).kinds


@pytest.mark.parametrize("kind", NEW)
def test_it_is_drawn_kept_in_a_file_and_flown(kind: str, tmp_path: Path) -> None:
    assert any(event.kind == kind for seed in range(100) for event in compose(seed).events)
    longest, low, high = RANGES[kind]
    events = (Event(kind, 8.0, longest / 2, (low + high) / 2), Event(kind, 14.0, 0.02, high))
    schedule = Schedule(3, events=events, duration=26.0)
    path = tmp_path / "schedule.yaml"
    path.write_text(dump(schedule))
    assert load(path) == schedule
    assert "stuck" in judged(schedule)
    assert fly(schedule).breaches == ()


@pytest.mark.parametrize("draw", [compose, calm, choose])
def test_whatever_is_drawn_can_be_kept_and_flown_again(
    draw: Callable[[int], Schedule], tmp_path: Path
) -> None:
    path = tmp_path / "schedule.yaml"
    for seed in range(200):
        path.write_text(dump(draw(seed)))
        assert load(path) == draw(seed)


@pytest.mark.parametrize("kind", NEW)
def test_it_is_left_alone_when_the_rest_is_taken_out(kind: str) -> None:
    noise = tuple(Event(each, 1.0 + n, 1.0, 0.5) for n, each in enumerate(sorted(KINDS)))
    smallest = shrink(Schedule(5, events=noise), lambda schedule: bool(schedule.of(kind)))
    assert [(event.kind, event.value) for event in smallest.events] == [(kind, 0.5)]


@pytest.mark.parametrize("kind", ["teleop_shut_down", "pod_shut_down"])
def test_a_teleop_shutdown_pauses_and_its_successor_continues(kind: str) -> None:
    flight = Flight(seed=3)
    event = Event(kind, 8.0, 4.0, 0.25)
    inject(flight, Schedule(3, events=(event,)), Wall())
    flight.fly(8.5)
    assert [each.event for each in flight.desk.events][-1] == "paused"
    assert flight.state_at(flight.run.now_ns) is GuardState.HOLD
    flight.fly(9.5)
    assert flight.desk.service is None, "after a quarter of the duration"
    assert (flight.cloud.inner is None) == (kind == "pod_shut_down")
    flight.fly_mission()
    assert flight.mission.state == "done"


def test_no_more_requests_are_drawn_than_teleop_lets_wait() -> None:
    assert RANGES["api_flood"][2] == WAITING_MAX


def test_the_disk_is_full_in_most_flights_that_draw_it() -> None:
    drawn = [e for seed in range(400) for e in compose(seed).of("recorder_full")]
    # What is recorded in a while: the head at once, then chunk after chunk.
    full = sum(event.value < 14e3 + 33e3 * event.duration for event in drawn)
    assert 0.6 < full / len(drawn) < 0.9


@pytest.mark.parametrize("kind", ["teleop_shut_down", "pod_shut_down"])
def test_a_shutdown_that_fails_is_found(kind: str, monkeypatch: Patch) -> None:
    def fail(service: MissionService, now_ns: int) -> None:
        raise OSError("no way to end")

    monkeypatch.setattr(MissionService, "pause", fail)
    assert _flown(Event(kind, 8.0, 4.0, 0.25)) == {"error"}


def test_a_peer_that_is_not_followed_is_found(monkeypatch: Patch) -> None:
    lost = Event("names_lost", 8.0, 4.0, 0.5)
    assert _flown(lost) == set()
    poll = PeerName.poll

    def once(peer: PeerName) -> tuple[str, int] | None:
        return (peer._known[-1], 7400) if peer._known else poll(peer)

    monkeypatch.setattr(PeerName, "poll", once)
    assert _flown(lost) == {"stuck"}


@pytest.mark.parametrize("way", ["up", "down"])
def test_names_that_are_lost_while_nobody_moves_change_nothing(way: str) -> None:
    lost = Event("names_lost", 8.0, 4.0, 1.0, way)
    assert fly(Schedule(3, events=(lost,), duration=11.9)).holds == 0
    moved = Event("names_lost", 8.0, 4.0, 0.5, way)
    assert fly(Schedule(3, events=(moved,), duration=11.9)).holds == 1


def test_the_right_key_that_is_not_read_is_found(monkeypatch: Patch) -> None:
    wrong = Event("key_wrong", 8.0, 4.0, 0.5)
    assert _flown(wrong) == set()
    rotate, read = Flight.rotate, set[str]()

    def once(flight: Flight, end: str, keys: KeySet, now_ns: int) -> None:
        if end not in read:
            rotate(flight, end, keys, now_ns)
        read.add(end)

    monkeypatch.setattr(Flight, "rotate", once)
    assert _flown(wrong) == {"stuck"}


def test_a_rotation_amid_a_wrong_key_ends_with_the_key_of_world() -> None:
    rotated = Event("key_rotated", 9.0, 1.0)
    assert _flown(Event("key_wrong", 8.0, 4.0, 0.5), rotated, until=30.0) == set()


def test_only_many_invalid_values_land_the_robot(
    monkeypatch: Patch,
) -> None:
    few, many = (Event("values_invalid", 8.0, 4.0, value) for value in (3.0, 8.0))
    assert _flown(few) == _flown(many) == set()
    monkeypatch.setattr(MissionService, "acknowledge", lambda service, now_ns: None)
    assert _flown(few) == set()
    assert _flown(many) == {"stuck"}
    schedule = Schedule(3, "wifi", (Event("loss", 3.0, 1.0, 0.1), few, many), duration=25.0)
    smallest = shrink(schedule, lambda each: "stuck" in fly(each).kinds)
    assert [(event.kind, event.value) for event in smallest.events] == [("values_invalid", 8.0)]
    assert smallest.profile == "paper-p2"


def test_huge_numbers_that_pass_the_guard_are_found(monkeypatch: Patch) -> None:
    huge = Event("values_huge", 8.0, 4.0, 4.0)
    assert _flown(huge) == set()
    monkeypatch.setattr("cloudrc.world.guard.state.COMMAND_MAX", 1e308)
    monkeypatch.setattr(
        "cloudrc.world.guard.state.rules.step_towards", lambda start, end, step: end
    )
    assert "cap" in _flown(huge)


@pytest.mark.parametrize("apart", [False, True])
def test_a_stop_that_is_not_obeyed_is_found(apart: bool, monkeypatch: Patch) -> None:
    """Also where the robot is on its way down, and where nobody flies."""
    events = tuple(Event("stopped", at) for at in (0.05, 8.0, 11.5))
    schedule = Schedule(3, events=events, duration=25.0, apart=apart)
    assert fly(schedule).kinds == set()
    monkeypatch.setattr(MissionService, "stop_rotors", lambda service, now_ns: None)
    assert fly(schedule).kinds == (set() if apart else {"obeyed"}), "its alarm goes past teleop"
    monkeypatch.setattr(EmergencyStopRepeater, "sound", lambda alarm: None)
    assert fly(schedule).kinds == {"obeyed"}


def test_a_stop_that_is_released_before_anybody_looks_was_obeyed() -> None:
    """The operator, who sees the landing still, acknowledges while the stop is on its way."""
    invalid, silent = Event("values_invalid", 10.0, 1.0, 12.0), Event("blackout", 10.37, 1.6)
    events = (invalid, replace(silent, way="down"), Event("stopped", 10.7))
    assert fly(Schedule(3, "ideal", events, duration=24.0)).breaches == ()


@pytest.mark.parametrize("kind", STALLS)
def test_a_teleop_that_stands_still_does_not_see_the_robot(kind: str, monkeypatch: Patch) -> None:
    looks: list[int] = []
    see = MissionService.see

    def look(service: MissionService, seen: RobotStatus, now_ns: int) -> None:
        looks.append(now_ns)
        see(service, seen, now_ns)

    monkeypatch.setattr(MissionService, "see", look)
    written, gaps = Event("held", 7.5, 0.1), list[int]()
    for duration in (0.02, 2.5):
        looks.clear()
        assert _flown(Event(kind, 7.0, duration, 2.0), written, until=12.0) == set()
        gaps.append(max(after - before for before, after in pairwise(looks)))
    assert gaps[0] < 0.1e9
    assert gaps[1] >= 2.0e9


def test_shrinking_removes_only_an_unneeded_teleop_process() -> None:
    schedule = Schedule(5, events=(Event("blackout", 1.0, 1.0),), apart=True)
    assert not shrink(schedule, lambda each: bool(each.events)).apart
    assert shrink(schedule, lambda each: each.apart).apart


def test_teleop_is_apart_in_half_of_the_schedules() -> None:
    chosen = [compose(seed).apart for seed in range(400)]
    assert 150 < sum(chosen) < 250


def _says_the_same(source: Path, target: Path) -> Recovery:
    """Has a copy of the recording that was made before the newest flight began."""
    recovery = recover(source, target)
    target.write_bytes(OTHER[0])
    return recovery


OTHER = [b""]


@pytest.mark.parametrize("kind", KILLED)
def test_a_recording_that_has_not_happened_so_is_found(kind: str, monkeypatch: Patch) -> None:
    kept: list[Callable[[Path, Path], Recovery]] = [_keeps]
    monkeypatch.setattr("cloudrc.faults.remains.recover", lambda *paths: kept[0](*paths))
    assert _flown(Event(kind, 1.0, 2.0), until=3.5) == set()
    assert OTHER[0]
    kept[0] = _says_the_same
    assert _flown(Event(kind, 4.0, 2.0), until=6.5) == {"recording"}


def _keeps(source: Path, target: Path) -> Recovery:
    recovery = recover(source, target)
    OTHER[0] = target.read_bytes()
    return recovery


@pytest.mark.parametrize("kind", KILLED)
def test_a_recorder_that_writes_too_seldom_is_found(kind: str, monkeypatch: Patch) -> None:
    monkeypatch.setattr("cloudrc.faults.scribe.FLUSH", 5.0)
    monkeypatch.setattr("cloudrc.record.writer.CHUNK_NS", 5_000_000_000)
    finding = fly(Schedule(3, events=(Event(kind, 2.0, 3.0),), duration=6.0))
    assert finding.kinds == {"recording"}
    assert "are lost" in finding.breaches[0].text


def test_an_adversary_may_have_a_bug_as_well() -> None:
    bug = Event("values_invalid", 3.0, 4.0, 3.0)
    schedule = Schedule(4, policy="random", events=(bug,), duration=10.0)
    assert fuzz.fly(schedule).breaches == ()


def test_in_some_schedules_a_hold_is_shorter_than_a_silence() -> None:
    drawn = [compose(seed).hold_max for seed in range(300)]
    assert 70 < sum(hold_max <= 8.0 for hold_max in drawn) < 130
    assert {hold_max for hold_max in drawn if hold_max > 8.0} == {60.0}


def test_a_robot_that_lands_since_its_hold_was_short_flies_again() -> None:
    silence = Schedule(8, "ideal", (Event("blackout", 20.0, 6.0),))
    flown = [fly(replace(silence, hold_max=limit), keep=True) for limit in (2.5, 60.0)]
    assert [finding.breaches for finding in flown] == [(), ()]
    assert flown[0].sha256 != flown[1].sha256
