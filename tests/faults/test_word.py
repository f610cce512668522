"""The operator's word, as the watch keeps it in mind: what is latched, and what was started."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.faults.fuzz import fly
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.messages import ZERO, Cause, Command, GuardState
from cloudrc.world import guard as guard_module
from cloudrc.world.guard import Guard
from tests.faults.watched import World

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


def test_an_acknowledgement_counts_in_the_state_that_it_is_for_and_no_longer():
    world = World()
    world.tick(ZERO, released=False)
    world.guard.state = LAND  # it lands and is acknowledged between two ticks
    world.guard.acknowledge(0)
    assert world.tick(ZERO, state=LAND, released=False) == set()
    assert world.tick(ZERO, state=HOLD, released=False) == set()
    world.tick(ZERO, state=LAND, released=False)
    assert world.tick(ZERO, state=HOLD, released=False) == {"latch"}


@pytest.mark.parametrize("before", [LAND, ESTOP])
def test_what_is_acknowledged_twice_between_two_ticks_was_released_the_first_time(before):
    world = World()
    world.tick(ZERO, state=before)
    for world.guard.state in (ESTOP, GROUND):  # one that landed was stopped just then
        world.guard.acknowledge(0)
    assert world.tick(ZERO, state=GROUND, released=False) == set()
    world.tick(ZERO, state=before, released=False)
    assert world.tick(ZERO, state=GROUND, released=False) == {"latch"}


def offer(world: World, at_ms: int) -> None:
    world.guard.offer(Command(0, 0, 0, ZERO, 0.0), at_ms * MS)


def say(world: World, word: str) -> None:
    asked = getattr(world.guard, word)
    asked(0, "from spawn") if word == "put_on_ground" else asked(0)


@pytest.mark.parametrize("word", ["end_mission", "stop", "put_on_ground"])
def test_track_is_for_what_the_operator_has_started_and_not_ended(word: str) -> None:
    world = World()
    assert world.tick(ZERO) == set()
    say(world, word)
    assert world.tick(ZERO, released=False) == {"latch"}
    world = World()
    say(world, word)
    world.guard.start_mission(0)
    assert world.tick(ZERO, released=False) == set()


@pytest.mark.parametrize("latched", [LAND, ESTOP])
def test_what_is_latched_has_ended_the_mission_and_hears_no_start(latched: GuardState) -> None:
    world = World()
    world.tick(ZERO, state=latched, released=False)
    world.guard.start_mission(0)
    world.guard.acknowledge(0)
    assert world.tick(ZERO, state=GROUND, released=False) == set()
    assert world.tick(ZERO, state=TRACK, released=False) == {"latch"}
    world.tick(ZERO, state=GROUND, released=False)
    world.watch.counts.clear()
    world.guard.start_mission(0)
    assert world.tick(ZERO, state=TRACK, released=False) == set()


@pytest.mark.parametrize(
    ("count", "apart_ms", "kinds"),
    [(10, 55, set()), (10, 56, {"stale"}), (9, 10, {"stale"}), (0, 10, {"stale"}), (30, 55, set())],
)
def test_a_hold_is_left_on_ten_fresh_commands_within_half_a_second(
    count: int, apart_ms: int, kinds: set[str]
) -> None:
    world = World()
    world.tick(ZERO, state=HOLD, released=False)
    world.guard.state = HOLD
    for n in range(count):
        offer(world, n * apart_ms)
    assert world.tick(ZERO, state=TRACK, released=False) == kinds


@pytest.mark.parametrize("word", ["forget_commands", "end_mission"])
def test_what_came_before_another_session_or_mission_is_not_fresh(word: str) -> None:
    world = World()
    world.tick(ZERO, state=HOLD, released=False)
    for n in range(9):
        offer(world, n)
    world.guard.forget_commands() if word == "forget_commands" else say(world, word)
    world.guard.start_mission(0)
    offer(world, 9)
    assert world.tick(ZERO, state=TRACK, released=False) == {"stale"}


def test_what_is_refused_does_not_count_nor_what_was_flown_before_the_hold() -> None:
    world = World()
    for n in range(10):
        offer(world, n)
    world.tick(ZERO, ZERO, released=False)
    world.tick(ZERO, state=HOLD, released=False)
    assert world.tick(ZERO, state=TRACK, released=False) == {"stale"}
    world = World(refusal="stale")
    world.tick(ZERO, state=HOLD, released=False)
    for n in range(10):
        offer(world, n)
    assert world.tick(ZERO, state=TRACK, released=False) >= {"stale"}
    assert any("on 0 fresh" in breach.text for breach in world.watch.breaches)


def test_a_robot_that_was_put_on_the_ground_starts_on_one_command() -> None:
    world = World()
    world.tick(ZERO, state=HOLD, released=False)
    world.guard.put_on_ground(0, "from spawn")
    world.guard.start_mission(0)
    assert world.tick(ZERO, state=TRACK, released=False) == set()


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


def _resumes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    init = Guard.__init__

    def hasty(guard: Guard, limits: Any) -> None:
        init(guard, limits)
        guard._fresh_ns = guard_module.deque(maxlen=1)

    monkeypatch.setattr(guard_module, "RESUME_COMMANDS", 1)
    monkeypatch.setattr(Guard, "__init__", hasty)


@pytest.mark.parametrize(
    ("breaks", "kind"),
    [(_rearms, "latch"), (_needs_no_start, "latch"), (_resumes_at_once, "stale")],
)
def test_a_guard_that_needs_no_word_or_no_proof_is_found(
    breaks: Any, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    breaks(monkeypatch)
    assert kind in fly(STOPPED_AND_HELD).kinds


def test_a_guard_that_does_not_hear_a_missions_end_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    schedule = Schedule(27, policy="operators-voice", duration=20.0)
    assert fly(schedule).kinds == set()
    _hears_no_end(monkeypatch)
    assert "latch" in fly(schedule).kinds
