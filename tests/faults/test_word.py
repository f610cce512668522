"""The operator's word, as the watch keeps it in mind: what is latched, and what was started."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.faults.fuzz import fly
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.messages import ZERO, Cause, Command, GuardState
from cloudrc.world.guard.state import Guard
from tests.faults.conftest import World

MS = 1_000_000
GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


@pytest.mark.parametrize("latched", [LAND, ESTOP])
@pytest.mark.parametrize("after", [GROUND, TRACK, HOLD])
def test_what_is_latched_stays_so_until_the_operator_has_said_so(latched, after):
    for released, kinds in ((True, set()), (False, {"latch"})):
        world = World()
        assert world.tick(ZERO, state=latched) == set()
        assert world.tick(ZERO, state=after, released=released) == kinds
    world = World()
    world.guard.acknowledge(0)  # of nothing: it counts for no landing that comes later
    assert world.tick(ZERO, state=latched, released=False) == set()
    assert world.tick(ZERO, state=after, released=False) == {"latch"}


def test_an_acknowledgement_counts_only_in_its_own_state():
    world = World()
    world.tick(ZERO, released=False)
    world.guard.state = LAND  # it lands and is acknowledged between two ticks
    world.guard.acknowledge(0)
    assert world.tick(ZERO, state=LAND, released=False) == set()
    assert world.tick(ZERO, state=HOLD, released=False) == set()
    world.tick(ZERO, state=LAND, released=False)
    assert world.tick(ZERO, state=HOLD, released=False) == {"latch"}


@pytest.mark.parametrize("before", [LAND, ESTOP])
def test_a_second_acknowledgement_in_a_tick_has_no_effect(before):
    world = World()
    world.tick(ZERO, state=before)
    for world.guard.state in (ESTOP, GROUND):  # one that landed was stopped just then
        world.guard.acknowledge(0)
    assert world.tick(ZERO, state=GROUND, released=False) == set()
    world.tick(ZERO, state=before, released=False)
    assert world.tick(ZERO, state=GROUND, released=False) == {"latch"}


def say(world: World, word: str) -> None:
    asked = getattr(world.guard, word)
    asked(0, "from spawn") if word == "put_on_ground" else asked(0)


@pytest.mark.parametrize("word", ["end_mission", "stop", "put_on_ground"])
def test_track_needs_a_mission_that_the_operator_started(word: str) -> None:
    world = World()
    assert world.tick(ZERO) == set()
    say(world, word)
    assert world.tick(ZERO, released=False) == {"latch"}
    world = World()
    say(world, word)
    world.guard.start_mission(0)
    assert world.tick(ZERO, released=False) == set()


@pytest.mark.parametrize("latched", [LAND, ESTOP])
def test_a_latched_state_ends_the_mission_and_ignores_starts(latched: GuardState) -> None:
    world = World()
    world.tick(ZERO, state=latched, released=False)
    world.guard.start_mission(0)
    world.guard.acknowledge(0)
    assert world.tick(ZERO, state=GROUND, released=False) == set()
    world.guard.start_mission(0)
    assert world.tick(ZERO, state=TRACK, released=False) == set()
    world = World()
    world.tick(ZERO, state=latched, released=False)
    world.guard.start_mission(0)
    world.guard.acknowledge(0)
    assert world.tick(ZERO, state=GROUND, released=False) == set()
    assert world.tick(ZERO, state=TRACK, released=False) == {"latch"}


STOPPED_AND_HELD = Schedule(
    3, "paper-p1", (Event("stopped", 5.0), Event("blackout", 12.0, 1.5)), duration=20.0
)


def _rearms(monkeypatch: pytest.MonkeyPatch) -> None:
    enter = Guard._enter

    def armed(guard: Guard, state: GuardState, now: int, cause: Cause, told: str = "") -> None:
        enter(guard, state, now, cause, told)
        guard.armed = guard.armed or cause in (Cause.ACKNOWLEDGED, Cause.STILL_FIRST)

    monkeypatch.setattr(Guard, "_enter", armed)


def _needs_no_start(monkeypatch: pytest.MonkeyPatch) -> None:
    offered = Guard.offer

    def arms(guard: Guard, command: Command, now_ns: int) -> str | None:
        guard.armed = guard.armed or guard.state is GROUND
        return offered(guard, command, now_ns)

    monkeypatch.setattr(Guard, "offer", arms)


def _hears_no_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Guard, "end_mission", lambda guard, now_ns: None)


@pytest.mark.parametrize(
    "breaks", [_rearms, _needs_no_start], ids=lambda breaks: breaks.__name__.strip("_")
)
def test_a_guard_that_needs_no_word_is_found(breaks: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    breaks(monkeypatch)
    assert "latch" in fly(STOPPED_AND_HELD).kinds


def test_a_guard_that_does_not_hear_a_missions_end_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    schedule = Schedule(27, policy="operators-voice", duration=20.0)
    assert fly(schedule).kinds == set()
    _hears_no_end(monkeypatch)
    assert "latch" in fly(schedule).kinds
