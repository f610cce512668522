"""How rotors may stop: by a word, by a hit that there was, or where the robot stands."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.faults.fuzz import fly
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.messages import ZERO, Cause, GuardState
from cloudrc.world.guard.hold import Descent, TakeOff
from cloudrc.world.guard.state import HitDetector
from cloudrc.world.readings import Readings
from tests.faults.conftest import World

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
ZEROS = tuple(0.0 for _ in range(4))


@pytest.mark.parametrize("state", [GROUND, LAND])
@pytest.mark.parametrize(
    ("velocity", "kinds"),
    [
        ((0.19, -0.2, 0.2), set()),
        ((0.21, 0.0, 0.0), {"rest"}),
        ((0.0, -0.21, 0.0), {"rest"}),
        ((0.0, 0.0, -0.21), {"rest"}),
        ((float("nan"), 0.0, 0.0), {"rest"}),
    ],
)
def test_rotors_stop_where_the_robot_stands(
    state: GuardState, velocity: Any, kinds: set[str]
) -> None:
    world = World()
    world.tick(ZERO, state=HOLD)
    world.readings.velocity = velocity
    assert world.tick(ZERO, state=state, turns=False) == kinds


def test_an_operator_or_a_hit_may_stop_rotors_not_hard_braking() -> None:
    for word in ("stop", "put_on_ground"):
        world = World()
        world.tick(ZERO, state=HOLD)
        world.readings.velocity = (0.0, 0.0, -3.0)
        getattr(world.guard, word)(*((0, "from spawn") if word == "put_on_ground" else (0,)))
        assert world.tick(ZERO, ZERO, state=GROUND) == set()
    world = World()
    world.readings.velocity = (0.0, 0.0, -3.0)
    world.tick(ZERO)
    world.simulator.step(ZEROS)
    assert world.tick(ZERO, ZERO, state=ESTOP, ruled=False) - {"tick"} == set()


def test_stopped_rotors_in_the_air_or_after_touch_may_fall() -> None:
    for steps, kinds in ((0, set()), (-496, set()), (-497, {"rest"})):
        world = World()
        world.tick(ZERO, ZERO, state=LAND)
        world.simulator._last_touch["pipe_1", False] = steps
        assert world.tick(ZERO, state=GROUND) == set()
        world.readings.velocity = (0.0, 0.0, -0.9)
        assert world.tick(ZERO, state=GROUND) == set()
        world.readings.velocity = (0.0, 0.0, -1.1)
        assert world.tick(ZERO, state=GROUND) == kinds


@pytest.mark.parametrize("honest", [True, False])
def test_under_an_honest_cloud_no_hit_is_felt_without_a_touch(honest: bool) -> None:
    for touched, asked in ((None, False), (-499, False), (-498, False), (None, True)):
        world = World(honest=honest)
        world.tick(ZERO, ZERO)
        if touched is not None:
            world.simulator._last_touch["floor", False] = touched
        if asked:
            world.guard.stop(0)
        wrong = honest and not asked and touched != -498
        assert world.tick(ZERO, state=ESTOP) == ({"collision"} if wrong else set())


def _feels(monkeypatch: pytest.MonkeyPatch) -> None:
    felt = HitDetector.felt

    def imagines(hits: HitDetector, now_ns: int, readings: Readings) -> Cause | None:
        hit = felt(hits, now_ns, readings)
        return Cause.JOLTED if 6.0e9 < now_ns < 6.05e9 else hit

    monkeypatch.setattr(HitDetector, "felt", imagines)


@pytest.mark.parametrize(
    ("events", "kinds"),
    [((Event("blackout", 3.0, 0.1),), {"collision"}), ((), {"collision", "alarm"})],
)
def test_a_guard_that_feels_what_is_not_there_is_found(
    events: tuple[Event, ...], kinds: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _feels(monkeypatch)
    assert fly(Schedule(3, "paper-p1", events, duration=8.0)).kinds == kinds


def test_a_landing_in_a_clean_flight_is_an_alarm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.world.guard.state.Limits.alone_max_ns", lambda *_: -1)
    finding = fly(Schedule(3, "paper-p1", duration=4.0))
    assert "LAND in a clean flight" in " ".join(breach.text for breach in finding.breaches)


@pytest.mark.parametrize(
    ("of", "name", "event"),
    [
        (TakeOff, "may_end", Event("blackout", 6.0, 2.0)),
        (Descent, "is_over", Event("values_invalid", 6.0, 1.5, 12.0)),
    ],
)
def test_a_guard_that_takes_the_air_for_ground_is_found(
    of: type, name: str, event: Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(of, name, lambda *_: True)
    assert "rest" in fly(Schedule(3, "paper-p1", (event,), duration=10.0)).kinds


def test_a_guard_that_drops_the_robot_out_of_its_hover_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def hovers(take_off: TakeOff, readings: Readings) -> bool:
        return readings.position[2] > 0.5 and max(map(abs, readings.velocity)) < 0.1

    monkeypatch.setattr(TakeOff, "may_end", hovers)
    finding = fly(Schedule(3, "paper-p1", (Event("blackout", 6.0, 4.0),), duration=11.0))
    assert [breach.text for breach in finding.breaches][:1] == [
        "falls in GROUND, its rotors stopped in the air"
    ]
