"""How a HOLD ends, as the watch keeps it in mind: with care, or in LAND, and neither too early."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cloudrc.faults.hold_end import GROUND_NS, RAMP
from cloudrc.faults.invariants import Watch
from cloudrc.messages import ZERO, Cause, Command, GuardState, Vector
from cloudrc.world.guard.state import Guard
from cloudrc.world.rotors import STOPPED
from tests.faults.conftest import World
from tests.world.guard.conftest import LIMITS, SECOND, command, sensed

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
def test_a_hold_ends_after_ten_fresh_commands_in_half_a_second(
    count: int, apart_ms: int, kinds: set[str]
) -> None:
    world = World()
    world.tick(ZERO, state=HOLD, released=False)
    world.guard.state = HOLD
    for n in range(count):
        offer(world, n * apart_ms)
    assert world.tick(ZERO, state=TRACK, released=False) == kinds


@pytest.mark.parametrize("word", ["forget_commands", "end_mission"])
def test_commands_of_an_older_session_or_mission_are_stale(word: str) -> None:
    world = World()
    world.tick(ZERO, state=HOLD, released=False)
    for n in range(9):
        offer(world, n)
    world.guard.forget_commands() if word == "forget_commands" else world.guard.end_mission(0)
    world.guard.start_mission(0)
    offer(world, 9)
    assert world.tick(ZERO, state=TRACK, released=False) == {"stale"}


def test_refused_and_older_commands_do_not_end_a_hold() -> None:
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


def test_a_robot_put_on_the_ground_starts_on_one_command() -> None:
    world = World()
    world.tick(ZERO, state=HOLD, released=False)
    world.guard.put_on_ground(0, "from spawn")
    world.guard.start_mission(0)
    assert world.tick(ZERO, state=TRACK, released=False) == set()


@pytest.mark.parametrize(("apart_ms", "kinds"), [(998, {"hold"}), (1000, set())])
def test_track_begins_at_least_a_second_after_the_last_track(
    apart_ms: int, kinds: set[str]
) -> None:
    world = World()
    step(world, GROUND)
    step(world, TRACK, 100)
    step(world, HOLD, apart_ms - 100)
    fresh(world)
    assert step(world, TRACK) == kinds


@pytest.mark.parametrize(
    ("cause", "kinds"), [(Cause.SILENCE, {"hold"}), (Cause.SESSION, set()), (Cause.ENDED, set())]
)
def test_holds_for_silence_begin_at_least_a_second_apart(cause: Cause, kinds: set[str]) -> None:
    for apart_ms, found in ((998, kinds), (1000, set())):
        world = World()
        step(world, TRACK, 1000)
        step(world, HOLD, apart_ms - 10)
        fresh(world)
        step(world, TRACK, 10)
        world.guard.cause = cause
        assert step(world, HOLD) == found


def test_a_hold_after_commands_on_older_odometry_is_allowed() -> None:
    for bases_ms, kinds in (((9, 8), set()), ((8, 9), {"hold"}), ((9, 9), {"hold"})):
        world = World()
        step(world, TRACK, 1000)
        step(world, HOLD, 250)
        fresh(world)
        step(world, TRACK, 10)
        for basis_ms in bases_ms:
            world.guard.offer(Command(0, (1260 + basis_ms) * MS, 0, ZERO, 0.0), 1270 * MS)
        world.guard.cause = Cause.SILENCE
        assert step(world, HOLD) == kinds


def test_who_was_put_on_the_ground_has_no_last_hold() -> None:
    for put, kinds in ((True, set()), (False, {"hold"})):
        world = World()
        step(world, TRACK, 1000)
        step(world, HOLD, 100)
        fresh(world)
        step(world, TRACK, 850)
        if put:
            world.guard.put_on_ground(0, "from spawn")
        step(world, GROUND)
        world.guard.start_mission(0)
        step(world, TRACK, 100)
        world.guard.cause = Cause.SILENCE
        assert step(world, HOLD) == kinds


def test_a_hold_on_the_ground_ends_in_its_first_tick() -> None:
    """The guard waits for ten seconds from then on, not from the last command before TRACK."""
    world, readings = World(), sensed()
    world.guard = world.robot.guard = Guard(replace(LIMITS, hold_max_ns=2 * SECOND))
    watch = Watch(6.0, 12.0, 1.0, 250 * MS, 2 * SECOND)
    watch.attach(world, 0)
    world.guard.start_mission(0)
    for now_ns in range(0, 22 * SECOND, TICK_MS * MS):
        if 2 * SECOND <= now_ns < 5 * SECOND:
            world.guard.offer(command(ZERO, now_ns), now_ns)
        world.guard.tick(now_ns, readings, 0.002)
        world.simulator.step(STOPPED if world.guard.state in (GROUND, LAND) else (900.0,) * 4)
    assert [change.state for change in world.guard.take_changes()] == [TRACK, HOLD, GROUND, LAND]
    assert set(watch.counts) == set()


def test_a_robot_that_was_put_on_the_ground_starts_at_once() -> None:
    world = World()
    step(world, GROUND)
    step(world, TRACK)
    world.guard.put_on_ground(0, "from spawn")
    step(world, GROUND)
    world.guard.start_mission(0)
    assert step(world, TRACK) == set()


WAITS = [
    (HOLD, HOLD_MAX_MS, HOLD_MAX_MS),
    (GROUND, HOLD_MAX_MS, HOLD_MAX_MS),
    (HOLD, 2_000, 2_000),
    (GROUND, 2_000, GROUND_NS // MS),
]
"""In which state, for how long as it is set, and for how long in fact [ms]."""


@pytest.mark.parametrize(("state", "hold_max_ms", "wait_ms"), WAITS)
def test_nobody_waits_for_a_cloud_longer_than_is_set(
    state: GuardState, hold_max_ms: int, wait_ms: int
) -> None:
    world = World(hold_max_ms=hold_max_ms)
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


@pytest.mark.parametrize(("state", "hold_max_ms", "wait_ms"), WAITS)
def test_nobody_lands_before_that_time(state: GuardState, hold_max_ms: int, wait_ms: int) -> None:
    for waited_ms, kinds in ((wait_ms, {"hold"}), (wait_ms + TICK_MS, set())):
        world = World(hold_max_ms=hold_max_ms)
        step(world, state, waited_ms)
        assert step(world, LAND) == kinds


def test_landing_from_track_needs_impossible_commands() -> None:
    world = World()
    step(world, TRACK, 100)
    assert step(world, LAND) == {"hold"}
    world = World()
    step(world, TRACK, 100)
    world.say_what_is_impossible()
    assert step(world, LAND) == set()


def test_old_or_rare_impossible_commands_justify_no_landing() -> None:
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


def test_at_a_holds_end_speed_grows_slowly_but_may_drop_fast() -> None:
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
