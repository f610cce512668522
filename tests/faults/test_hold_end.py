"""How a HOLD ends, as the watch keeps it in mind: with care, or in LAND, and neither too early."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.faults.fuzz import fly
from cloudrc.faults.hold_end import GROUND_NS, RAMP
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.messages import ZERO, Command, GuardState, Vector
from cloudrc.world import guard as guard_module
from cloudrc.world.guard import Guard
from cloudrc.world.guard_limits import Limits
from cloudrc.world.rotors import STOPPED
from tests.faults.watched import World

MS = 1_000_000
TICK_MS = 2
GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
HOLD_MAX_MS = 60_000


def offer(world: World, at_ms: int) -> None:
    world.guard.offer(Command(0, 0, 0, ZERO, 0.0), at_ms * MS)


def fresh(world: World, count: int = 10) -> None:
    """Let so many fresh commands come now."""
    now_ns = world.steps * TICK_MS * MS
    for _ in range(count):
        world.guard.offer(Command(0, now_ns, 0, ZERO, 0.0), now_ns)


def step(world: World, state: GuardState, ms: int = TICK_MS) -> set[str]:
    """Let a robot be in a state for so long, without a word from anybody."""
    world.guard.state = state
    for _ in range(ms // TICK_MS):
        now_ns = world.steps * TICK_MS * MS
        world.guard.tick(now_ns)
        if state is TRACK:  # whether its commands are fresh is judged elsewhere
            fresh(world, 1)
        world.simulator.step((900.0,) * 4 if state in (TRACK, HOLD, LAND) else STOPPED)
    return set(world.watch.counts)


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
    world.guard.forget_commands() if word == "forget_commands" else world.guard.end_mission(0)
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


@pytest.mark.parametrize(("apart_ms", "kinds"), [(998, {"hold"}), (1000, set())])
def test_track_begins_a_second_after_the_last_one_at_the_earliest(
    apart_ms: int, kinds: set[str]
) -> None:
    world = World()
    step(world, GROUND)
    step(world, TRACK, 100)
    step(world, HOLD, apart_ms - 100)
    fresh(world)
    assert step(world, TRACK) == kinds


def test_a_robot_that_was_put_on_the_ground_starts_at_once() -> None:
    world = World()
    step(world, GROUND)
    step(world, TRACK)
    world.guard.put_on_ground(0, "from spawn")
    step(world, GROUND)
    world.guard.start_mission(0)
    assert step(world, TRACK) == set()


@pytest.mark.parametrize(
    ("state", "wait_ms"), [(HOLD, HOLD_MAX_MS), (GROUND, max(HOLD_MAX_MS, GROUND_NS // MS))]
)
def test_nobody_waits_for_a_cloud_longer_than_is_set(state: GuardState, wait_ms: int) -> None:
    world = World()
    assert step(world, state, wait_ms) == set()
    assert step(world, state, 3 * TICK_MS) == {"hold"}


@pytest.mark.parametrize("word", ["end_mission", "stop"])
def test_without_a_mission_there_is_nobody_to_wait_for(word: str) -> None:
    world = World()
    getattr(world.guard, word)(0)
    assert step(world, HOLD, HOLD_MAX_MS + 100) == set()


def test_the_wait_on_the_ground_begins_anew_with_each_command() -> None:
    world = World()
    assert step(world, GROUND, HOLD_MAX_MS - 100) == set()
    offer(world, HOLD_MAX_MS - 100)
    assert step(world, GROUND, HOLD_MAX_MS) == set()
    assert step(world, GROUND, 3 * TICK_MS) == {"hold"}


@pytest.mark.parametrize("state", [GROUND, HOLD])
def test_nobody_lands_before_that_time(state: GuardState) -> None:
    for waited_ms, kinds in ((HOLD_MAX_MS, {"hold"}), (HOLD_MAX_MS + TICK_MS, set())):
        world = World()
        step(world, state, waited_ms)
        assert step(world, LAND) == kinds


def test_nobody_lands_out_of_track_unless_commands_were_impossible() -> None:
    world = World()
    step(world, TRACK, 100)
    assert step(world, LAND) == {"hold"}
    world = World()
    step(world, TRACK, 100)
    world.say_what_is_impossible()
    assert step(world, LAND) == set()


def test_what_was_impossible_is_no_reason_to_land_later_nor_what_was_seldom_so() -> None:
    world = World()
    world.say_what_is_impossible()
    step(world, HOLD, 100)
    assert step(world, LAND) == {"hold"}
    world = World()
    world.refusal = "range"
    for at_ms in (0, 1, 2, 3, 1001):
        offer(world, at_ms)
    assert step(world, LAND) == {"hold"}


@pytest.mark.parametrize(("growth", "kinds"), [(RAMP, set()), (1.01 * RAMP, {"cap"})])
def test_out_of_hold_the_reference_grows_slowly(growth: float, kinds: set[str]) -> None:
    for way in ((0.6, 0.0, 0.8), (0.0, -1.0, 0.0)):
        world = World()
        step(world, HOLD, 1000)
        fresh(world)
        for n in range(5):
            world.guard.reference = scaled(way, n * growth * TICK_MS / 1000)
            step(world, TRACK)
        assert set(world.watch.counts) == kinds


def test_in_the_end_it_grows_as_elsewhere_and_slows_down_as_hard_as_it_must() -> None:
    world = World()
    step(world, HOLD, 1000)
    world.guard.reference = (1.0, 0.0, 0.0)
    step(world, HOLD)
    fresh(world)
    step(world, TRACK)
    world.guard.reference = ZERO
    assert step(world, TRACK, 2000 - TICK_MS) == set()  # 6 m/s at 3 m/s^2
    world.guard.reference = (0.024, 0.0, 0.0)
    assert step(world, TRACK) == set()


def scaled(way: Vector, speed: float) -> Vector:
    return (speed * way[0], speed * way[1], speed * way[2])


def _resumes_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    init = Guard.__init__

    def hasty(guard: Guard, limits: Any) -> None:
        init(guard, limits)
        guard._fresh_ns = guard_module.deque(maxlen=1)

    monkeypatch.setattr(guard_module, "RESUME_COMMANDS", 1)
    monkeypatch.setattr(Guard, "__init__", hasty)


def _speeds_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Limits, "ramp_ns", 0)


def _chatters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard_module, "SETTLE_NS", 0)


def _waits_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Limits, "alone_max_ns", lambda limits, flies: 3_600_000_000_000)


def _lands_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Limits, "alone_max_ns", lambda limits, flies: 100_000_000)


HELD = Schedule(
    3,
    "paper-p2",
    (
        Event("blackout", 6.0, 0.4),
        Event("blackout", 6.8, 0.3),
        Event("blackout", 9.5, 1.5),
        Event("blackout", 14.0, 3.0),
    ),
    duration=20.0,
    hold_max=2.0,
)


@pytest.mark.parametrize(
    ("breaks", "kind"),
    [
        (_resumes_at_once, "stale"),
        (_speeds_up, "cap"),
        (_chatters, "hold"),
        (_waits_for_ever, "hold"),
        (_lands_at_once, "hold"),
    ],
    ids=lambda value: value if isinstance(value, str) else value.__name__.strip("_"),
)
def test_a_guard_that_ends_a_hold_otherwise_is_found(
    breaks: Any, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    breaks(monkeypatch)
    assert kind in fly(HELD).kinds


def test_the_same_flight_is_nobodys_breach_with_the_guard_as_it_is() -> None:
    assert fly(HELD).breaches == ()
