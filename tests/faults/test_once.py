"""Commands are flown and waypoints reached once and in order, or the search says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from cloudrc.faults.fuzz import Once, fly, judged
from cloudrc.faults.invariants import Watch
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.messages import ZERO
from cloudrc.records import CommandApplied, SessionOpened
from cloudrc.tunnel.channel import LATE, USED, Channel


def _flight(*entries: tuple[str, str, int]) -> Any:
    kept = [{"mission": m, "event": e, "waypoint": w} for m, e, w in entries]
    return SimpleNamespace(
        listeners=[],
        watch=Watch(6.0, 12.0, 1.0, 250_000_000),
        desk=SimpleNamespace(entries=[{"kind": "mission", "mission": "m1"}, *kept]),
        run=SimpleNamespace(now_ns=0),
    )


@pytest.mark.parametrize(
    ("commands", "kinds"),
    [
        ([(2, 0), (2, 1), (2, 5), (3, 0)], set()),
        ([(2, 1), (2, 1)], {"order"}),
        ([(2, 1), (2, 0)], {"order"}),
        ([(3, 0), (2, 7)], {"order"}),
    ],
)
def test_no_command_is_flown_twice_nor_after_a_later_one(
    commands: list[tuple[int, int]], kinds: set[str]
) -> None:
    flight = _flight()
    once = Once(flight)
    for epoch, counter in commands:
        once.hear([CommandApplied(0, epoch, counter, 0, ZERO)], 0)
    assert set(flight.watch.counts) == kinds


def test_no_command_is_flown_of_an_epoch_that_is_over() -> None:
    flight = _flight()
    opened, late = (
        SessionOpened(0, "world", 3, "cloud said hello"),
        CommandApplied(0, 2, 9, 0, ZERO),
    )
    Once(flight).hear([opened, CommandApplied(0, 3, 0, 0, ZERO)], 0)
    assert not flight.watch.counts
    Once(flight).hear([opened, late], 0)
    assert set(flight.watch.counts) == {"order"}


@pytest.mark.parametrize(
    ("waypoints", "kinds"),
    [([0, 1, 2], set()), ([0, 1, 1], {"waypoint"}), ([0, 2], {"waypoint"}), ([1], {"waypoint"})],
)
def test_a_waypoint_is_reached_once_and_in_order(waypoints: list[int], kinds: set[str]) -> None:
    entries = [("m1", "reached", waypoint) for waypoint in waypoints]
    flight = _flight(("m1", "started", 0), *entries, ("m2", "reached", 0))
    Once(flight).judge()
    assert set(flight.watch.counts) == kinds


def test_what_a_damaged_journal_has_lost_may_be_written_again() -> None:
    torn = Schedule(1, events=(Event("journal_torn", 3.0, 1.0, 9.0),))
    assert "waypoint" not in judged(torn)
    assert "waypoint" in judged(Schedule(1))
    assert "waypoint" not in judged(Schedule(1, policy="greedy"))


def test_the_search_finds_a_command_that_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    take = Channel.take
    monkeypatch.setattr(
        Channel, "take", lambda *given: USED if (said := take(*given)) == LATE else said
    )
    assert fly(Schedule(1, reorder=0.5, duration=6.0)).kinds == {"order"}
