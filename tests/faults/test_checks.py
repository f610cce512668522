"""Scenarios can fail: where what they promise is broken, a check of theirs says so."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from cloudrc.cloud.teleop.service_book import MissionBook
from cloudrc.drivers.keyfile import KeyFile
from cloudrc.faults.catalogue import find
from cloudrc.link.sidecar_follow import PeerName
from cloudrc.messages import ZERO, GuardState
from cloudrc.records import Fault
from cloudrc.world.guard import Guard


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
    after = MissionBook.events_after

    def lossy(book: MissionBook, number: int) -> list[dict[str, Any]]:
        return [event for event in after(book, number) if event["id"] % 777]

    monkeypatch.setattr(MissionBook, "events_after", lossy)


def takes_a_missing_file_for_a_new_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KeyFile, "follow", lambda file, now_ns: [Fault(now_ns, "key", "gone")])


def stops_its_rotors_above_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    look = Guard._look_after_itself

    def hasty(guard: Guard, now_ns: int, readings: Any) -> None:
        look(guard, now_ns, readings)
        if guard.state is GuardState.LAND and guard._flies and readings.position[2] < 0.6:
            guard._enter(GuardState.LAND, now_ns, "touched down, rotors stopped")
            guard._flies, guard.reference = False, ZERO

    monkeypatch.setattr(Guard, "_look_after_itself", hasty)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "broken", "said"),
    [
        ("F3", stops_its_rotors_above_the_ground, "descent"),
        ("F19", forgets_the_peer, "no name is resolved for 30 s of flight: the same path"),
        ("F27", offers_a_point_that_is_not_the_nearest, "legal points nearer than it"),
        ("F32", loses_an_event_of_a_reader, "its events have no gap"),
        ("F38", takes_a_missing_file_for_a_new_key, "gone in flight: the keys stay"),
    ],
)
def test_a_broken_promise_is_noticed(
    name: str,
    broken: Callable[[pytest.MonkeyPatch], None],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken(monkeypatch)
    outcome = find(name, "virtual").run(1)
    assert [check for check in outcome.checks if not check.passed and said in check.text]
