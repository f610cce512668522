"""Scenarios can fail: where what they promise is broken, a check of theirs says so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from cloudrc.drivers.keyfile import KeyFile
from cloudrc.drivers.recording import WallClock
from cloudrc.drivers.teleop import LastWord
from cloudrc.exposition.live import LiveMetrics
from cloudrc.faults import asks
from cloudrc.faults.invariants import Watch
from cloudrc.faults.models import Mortal
from cloudrc.faults.scenario import find
from cloudrc.link.follow import PeerName
from cloudrc.messages import ZERO, Cause, GuardState
from cloudrc.record.recorder import Recorder
from cloudrc.records import Contact, Counted, Fault
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import Mission, MissionStore, Order
from cloudrc.tunnel.handshake import HandshakeLog
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import STEP_NS, Robot
from cloudrc.world.rotors import STOPPED


def forgets_the_peer(monkeypatch: pytest.MonkeyPatch) -> None:
    poll = PeerName.poll

    def forgetful(peer: PeerName) -> Any:
        address, before = poll(peer), peer.failures
        poll(peer)
        return None if peer.failures > before else address

    monkeypatch.setattr(PeerName, "poll", forgetful)


def offers_a_point_that_is_not_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.config.mission_check.nearest_legal", lambda *_: (0.0, 0.0, 1.0))


def loses_an_event_of_a_reader(monkeypatch: pytest.MonkeyPatch) -> None:
    after = MissionStore.events_after

    def lossy(book: MissionStore, number: int) -> list[dict[str, Any]]:
        return [event for event in after(book, number) if event["id"] % 777]

    monkeypatch.setattr(MissionStore, "events_after", lossy)


def takes_a_missing_file_for_a_new_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KeyFile, "follow", lambda file, now_ns: [Fault(now_ns, "key", "gone")])


def stops_its_rotors_above_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    look = Guard._look_after_itself

    def hasty(guard: Guard, now_ns: int, readings: Any) -> None:
        look(guard, now_ns, readings)
        if guard.state is GuardState.LAND and guard._flies and readings.position[2] < 0.6:
            guard._enter(GuardState.LAND, now_ns, Cause.DOWN)
            guard._flies, guard.reference = False, ZERO

    monkeypatch.setattr(Guard, "_look_after_itself", hasty)


def touches_something(monkeypatch: pytest.MonkeyPatch) -> None:
    see = Watch.see

    def touched(watch: Watch, contact: Contact, guard: GuardState, honest: bool) -> None:
        see(watch, contact._replace(body="pipe_1"), GuardState.TRACK, honest)

    monkeypatch.setattr(Watch, "see", touched)


def tells_no_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    enter = Guard._enter

    def silent(guard: Guard, state: GuardState, now_ns: int, cause: Cause, told: str = "") -> None:
        enter(guard, state, now_ns, cause, told if cause is Cause.ENDED else "-")

    monkeypatch.setattr(Guard, "_enter", silent)


def never_complains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(HandshakeLog, "say", lambda complaints, code, text, now_ns: [])


def catches_up_without_the_guard(monkeypatch: pytest.MonkeyPatch) -> None:
    """What there is to catch up is flown by nobody."""
    run = Robot.run

    def hasty(robot: Robot, tick_ns: int, until_ns: int) -> int:
        while until_ns - tick_ns > 2 * STEP_NS:
            robot.simulator.step(STOPPED)
            tick_ns += STEP_NS
        return run(robot, tick_ns, until_ns)

    monkeypatch.setattr(Robot, "run", hasty)


def forgets_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MissionStore, "with_key", lambda book, key: None)


def makes_another_mission_of_what_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Under the same key, and with nobody told: it is flown after the first one."""
    create = MissionService.create

    def twice(service: MissionService, order: Order, now_ns: int) -> tuple[Mission, bool]:
        mission, new = create(service, order, now_ns)
        return (mission, new) if new else (service.book.add(order), False)

    monkeypatch.setattr(MissionService, "create", twice)


def ends_without_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MissionService, "pause", lambda service, now_ns: None)


def ends_before_the_last_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LastWord, "__call__", lambda word: word._asked())


def never_freezes(name: str) -> Callable[[pytest.MonkeyPatch], None]:
    freeze = Mortal.freeze

    def unfrozen(mortal: Mortal, now_ns: int, duration: float) -> None:
        freeze(mortal, now_ns, 0.0 if mortal._name == name else duration)

    return lambda monkeypatch: monkeypatch.setattr(Mortal, "freeze", unfrozen)


def keeps_up_by_its_own_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.world.endpoint.REAL_TIME_FACTOR_MIN", 0.0)


def never_says_that_cloud_lives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.drivers.teleop.ALIVE_NS", 1 << 60)


def shows_the_past_as_present(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.teleop.service.SILENCE", 1e9)


def says_nothing_of_the_wall_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(WallClock, "step", lambda clock: 0.0)


def shows_it_10_s_later(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = asks.seen_by
    late: Any = lambda flight, role, until: seen(flight, role, until - 10.0)  # noqa: E731
    monkeypatch.setattr(asks, "seen_by", late)


def counts_the_tenth_failure_first(monkeypatch: pytest.MonkeyPatch) -> None:
    init = PeerName.__init__

    def late(peer: PeerName, *given: Any) -> None:
        init(peer, *given)
        peer.failures = -9

    monkeypatch.setattr(PeerName, "__init__", late)
    see = LiveMetrics.see

    def seen(live: LiveMetrics, records: Any) -> None:
        see(live, [r._replace(total=max(0, r.total)) if type(r) is Counted else r for r in records])

    monkeypatch.setattr(LiveMetrics, "see", seen)


def counts_no_more_than_1000_lost_records(monkeypatch: pytest.MonkeyPatch) -> None:
    count: Any = Recorder.dropped.fget  # type: ignore[attr-defined]
    monkeypatch.setattr(Recorder, "dropped", property(lambda self: min(count(self), 1000)))


Broken = Callable[[pytest.MonkeyPatch], None]
BROKEN: list[tuple[str, Broken, str]] = [
    ("F2", tells_no_cause, "each HOLD tells the age of its command"),
    ("F2", never_says_that_cloud_lives, "3 s of silence: it says that cloud was heard before"),
    ("F3", never_says_that_cloud_lives, "its next step is to look after the robot, not cloud"),
    ("F3", stops_its_rotors_above_the_ground, "descent"),
    ("F3", tells_no_cause, "LAND tells why"),
    ("F3", touches_something, "collisions"),
    ("F4", shows_it_10_s_later, "metric datagrams_lost_total uplink moves"),
    ("F5", shows_it_10_s_later, "metric guard_transitions_total hold moves"),
    ("F6", shows_it_10_s_later, "metric datagrams_reordered_total downlink moves"),
    ("F7", shows_it_10_s_later, "metric datagrams_total downlink repeated moves"),
    ("F9", says_nothing_of_the_wall_clock, "faults told: wall_clock"),
    ("F14", tells_no_cause, "LAND tells why"),
    ("F14", touches_something, "collisions"),
    ("F15", tells_no_cause, "each HOLD tells the age of its command"),
    ("F15", tells_no_cause, "each TRACK after it tells of fresh commands"),
    ("F15", shows_the_past_as_present, "it shows the guard's state as past"),
    ("F15", shows_the_past_as_present, "its next step is to look after cloud"),
    ("F18", catches_up_without_the_guard, "steps without the guard's tick"),
    ("F18", keeps_up_by_its_own_word, "faults told: late"),
    ("F19", counts_the_tenth_failure_first, "metric dns_errors_total moves"),
    ("F19", forgets_the_peer, "no name is resolved for 30 s of flight: the same path"),
    ("F24", never_complains, "it is told once: peer speaks v"),
    ("F25", never_complains, "the second says why it waits"),
    ("F23", touches_something, "collisions"),
    ("F27", offers_a_point_that_is_not_the_nearest, "legal points nearer than it"),
    (
        "F29",
        counts_no_more_than_1000_lost_records,
        "full disk: records counted too many or too few",
    ),
    ("F32", loses_an_event_of_a_reader, "its events have no gap"),
    ("F33", ends_without_a_word, "HOLD after"),
    ("F33", ends_without_a_word, "they say: paused by shutdown"),
    ("F33", ends_before_the_last_word, "by a word, not for want of it"),
    ("F35", forgets_keys, "missions made by 4 orders"),
    ("F35", forgets_keys, "orders that end with done"),
    ("F35", makes_another_mission_of_what_is_known, "missions in the journal"),
    ("F35", makes_another_mission_of_what_is_known, "missions that they were answered with"),
    ("F38", never_complains, "wrong key: cloud tells once"),
    ("F38", takes_a_missing_file_for_a_new_key, "gone in flight: the keys stay"),
    ("F39", catches_up_without_the_guard, "steps without the guard's tick"),
    ("F39", keeps_up_by_its_own_word, "the real-time factor that it tells"),
    ("F40", tells_no_cause, "each HOLD tells the age of its command"),
    ("F40", never_freezes("cloud"), "metric loop_missed_periods_total moves"),
    ("F40", never_freezes("world"), "metric world_slip_seconds_total moves"),
    ("F40", keeps_up_by_its_own_word, "times that world tells: late"),
]
QUICK = ("F15", "F25", "F33", "F40")


@pytest.mark.parametrize(
    ("name", "broken", "said"),
    [pytest.param(*each, marks=[] if each[0] in QUICK else pytest.mark.full) for each in BROKEN],
)
def test_a_broken_promise_is_noticed(
    name: str,
    broken: Broken,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken(monkeypatch)
    outcome = find(name, "virtual").run(1)
    assert [check for check in outcome.checks if not check.passed and said in check.text]
