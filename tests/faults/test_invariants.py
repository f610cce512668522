"""The invariants of motion and rotors: what is a breach, and what is not."""

from __future__ import annotations

import pytest

from cloudrc.messages import ZERO, GuardState, Request, Start, Vector
from tests.faults.conftest import (
    ESTOP,
    GROUND,
    HOLD,
    INSIDE,
    LAND,
    MS,
    OUTSIDE,
    TRACK,
    FakeRobot,
)

FAR = (9.2 + 1.51, 1.0, 1.0)
NAN = float("nan")


@pytest.mark.parametrize("state", [GROUND, TRACK, HOLD, LAND])
def test_a_base_outside_the_fence_is_a_breach(state: GuardState) -> None:
    robot = FakeRobot()
    robot.offer(5, "range")  # so that it may land
    assert robot.step(state) == set()
    robot.position = OUTSIDE
    assert "fence" in robot.step(state)


@pytest.mark.parametrize("hit", [False, True])
def test_after_a_stop_or_a_hit_it_may_fall_out_a_little(hit: bool) -> None:
    for place, kinds in ((OUTSIDE, set()), (FAR, {"fence"})):
        robot = FakeRobot()
        robot.step(TRACK)
        if not hit:
            robot.request(Request.ESTOP)
        robot.position = place
        assert robot.step(ESTOP) == kinds
    robot = FakeRobot()
    robot.guard.state = ESTOP
    robot.step(ESTOP)
    robot.request(Request.ESTOP)  # it was stopped before: this request causes no fall
    robot.position = OUTSIDE
    assert robot.step(ESTOP) == set() if hit else {"fence"}


def test_a_hit_may_throw_it_out_a_little_and_for_some_seconds() -> None:
    robot = FakeRobot()
    robot.touch("pipe_1")
    robot.step(TRACK)
    robot.position = OUTSIDE
    assert robot.step(TRACK, ms=4000) == set(), "it comes back slowly"
    robot.position = INSIDE
    robot.step(TRACK)
    robot.position = OUTSIDE
    assert robot.step(TRACK) == {"fence"}


@pytest.mark.parametrize(
    ("position", "speed", "kinds"),
    [(INSIDE, 0.11, set()), (INSIDE, 0.13, {"fence"}), (OUTSIDE, 0.0, {"fence"})],
)
def test_after_a_stop_it_takes_off_where_it_lies_inside(
    position: Vector, speed: float, kinds: set[str]
) -> None:
    robot = FakeRobot()
    robot.step(TRACK)
    robot.request(Request.ESTOP)
    robot.position, robot.velocity = position, (0.0, 0.0, -speed)
    assert robot.step(ESTOP, ms=2000) == set()
    robot.release()
    assert robot.step(TRACK) == kinds


@pytest.mark.parametrize(
    ("references", "kinds"),
    [
        ([(0.02, 0.013, 0.0)], set()),
        ([(0.02, 0.014, 0.0)], {"cap"}),
        ([(6.001, 0.0, 0.0)], {"cap"}),
        ([(0.02, 0.0, 0.0), ZERO, (0.0, -0.02, 0.0)], set()),
        ([(0.02, 0.0, 0.0), (-0.025, 0.0, 0.0)], {"cap"}),
    ],
)
def test_the_reference_grows_slowly_and_may_drop_at_once(
    references: list[Vector], kinds: set[str]
) -> None:
    robot = FakeRobot()
    for reference in references:
        robot.step(TRACK, reference=reference)
    assert robot.kinds == kinds


@pytest.mark.parametrize("yaw_rate", [-1.0, 1.001, -1.001, NAN])
def test_the_reference_turns_no_faster_than_the_cap(yaw_rate: float) -> None:
    robot = FakeRobot(yaw_rate=yaw_rate)
    assert robot.step(TRACK) == (set() if yaw_rate == -1.0 else {"cap"})


@pytest.mark.parametrize(
    ("position", "reference", "state", "kinds"),
    [
        ((8.9, 1.0, 1.0), (0.64, 0.0, 0.0), HOLD, set()),  # 0.2 v + v^2/6 <= 0.2: 0.647 m/s
        ((8.9, 1.0, 1.0), (0.66, 0.0, 0.0), HOLD, {"stop"}),
        ((8.9, 1.0, 1.0), (0.66, 0.0, 0.0), ESTOP, set()),
        ((1.0, 1.0, 0.5), (0.0, 0.0, -1.06), HOLD, set()),  # <= 0.4: 1.061 m/s
        ((1.0, 1.0, 0.5), (0.0, 0.0, -1.07), HOLD, {"stop"}),
        ((1.0, 1.0, 0.5), (0.0, 0.0, -1.07), LAND, set()),
        ((1.0, 1.0, -0.01), ZERO, LAND, {"fence"}),
    ],
)
def test_what_is_flown_can_stop_before_the_fence(
    position: Vector, reference: Vector, state: GuardState, kinds: set[str]
) -> None:
    robot = FakeRobot()
    robot.position = position
    robot.offer(5, "range")
    assert robot.step(state, reference=reference) == kinds


def test_track_is_for_fresh_commands() -> None:
    robot = FakeRobot()
    robot.offer()
    assert robot.step(TRACK, ms=252, fresh=False) == set()
    assert robot.step(TRACK, fresh=False) == {"stale"}
    for basis_ms, kinds in ((0, set()), (-251, {"stale"}), (1, {"stale"})):
        robot = FakeRobot()
        robot.offer(basis_ms=basis_ms)
        assert robot.kinds == kinds


def test_a_step_without_a_tick_of_the_guard_is_a_breach() -> None:
    robot = FakeRobot()
    robot.step(TRACK)
    robot.simulator.steps += 1  # one that no tick has ruled
    assert robot.step(TRACK) == {"tick"}
    robot = FakeRobot()
    robot.step(TRACK)
    robot.now_ns += 2 * MS
    assert robot.step(TRACK) == {"tick"}
    robot = FakeRobot()
    robot.step(GROUND)
    robot.request(Request.START, Start.SPAWN)
    assert robot.step(GROUND) == set(), "a reset begins to count anew"


@pytest.mark.parametrize("state", [GROUND, ESTOP])
def test_rotors_stand_still_on_the_ground_and_after_a_stop(state: GuardState) -> None:
    assert FakeRobot().step(state) == set()
    assert FakeRobot().step(state, turns=True) == {"latch"}


@pytest.mark.parametrize(
    ("speed", "way", "kinds"),
    [(0.0, 0.49, set()), (0.0, 0.51, {"rest"}), (2.0, 1.56, set()), (2.0, 1.58, {"rest"})],
)
def test_without_commands_the_robot_stops_where_it_can(
    speed: float, way: float, kinds: set[str]
) -> None:
    robot = FakeRobot()
    robot.velocity = (0.0, speed, 0.0)
    robot.step(TRACK)
    robot.step(HOLD)
    robot.position = (1.0, 1.0 + way, 1.0)
    assert robot.step(HOLD) == kinds


@pytest.mark.parametrize(
    ("body", "tip", "state", "kinds"),
    [
        ("board", True, TRACK, set()),
        ("board", False, TRACK, {"collision"}),
        ("pipe_1", True, TRACK, {"collision"}),
        ("floor", False, HOLD, {"collision"}),
        ("floor", False, LAND, set()),
        ("pipe_1", False, LAND, set()),
        ("pipe_1", False, GROUND, {"collision"}),
    ],
)
def test_with_an_honest_cloud_only_the_tip_touches_the_board(
    body: str, tip: bool, state: GuardState, kinds: set[str]
) -> None:
    for honest, found in ((True, kinds), (False, set())):
        robot = FakeRobot(honest=honest)
        robot.offer(5, "range")
        robot.touch(body, tip=tip)
        assert robot.step(state) == found
        robot.simulator.touches = []  # as after the telemetry
        assert robot.step(state) == found


@pytest.mark.parametrize("stopped", [False, True])
def test_a_robot_that_comes_down_may_touch_what_is_below(stopped: bool) -> None:
    robot = FakeRobot(honest=True)
    robot.step(TRACK)
    if stopped:
        robot.request(Request.ESTOP)
    robot.offer(5, "range")
    robot.touch("pipe_3")
    robot.step(ESTOP if stopped else LAND)
    robot.touch("pipe_2")  # it slides off
    assert robot.step(GROUND) - {"latch"} == set()
    assert robot.watch.landed_on == {"pipe_2", "pipe_3"}
    robot.release()
    robot.step(TRACK)
    robot.touch("pipe_3")
    assert "collision" in robot.step(TRACK), "it has flown since"


@pytest.mark.parametrize(("ms", "kinds"), [(198, set()), (204, {"collision"})])
def test_an_acknowledged_landing_ends_within_a_brake(ms: int, kinds: set[str]) -> None:
    robot = FakeRobot(honest=True)
    robot.offer(5, "range")
    robot.step(LAND)
    robot.release()
    robot.step(HOLD, ms=ms)
    robot.touch("pipe_3")
    assert robot.step(HOLD) == kinds


@pytest.mark.parametrize(
    ("velocity", "kinds"),
    [((0.19, -0.2, 0.2), set()), ((0.0, -0.21, 0.0), {"rest"}), ((NAN, 0.0, 0.0), {"rest"})],
)
def test_rotors_stop_where_the_robot_stands(velocity: Vector, kinds: set[str]) -> None:
    robot = FakeRobot()
    robot.step(HOLD)
    robot.velocity = velocity
    assert robot.step(GROUND) == kinds


def test_a_request_or_a_hit_may_stop_rotors_in_the_air() -> None:
    for request, start in ((Request.ESTOP, Start.HERE), (Request.START, Start.SPAWN)):
        robot = FakeRobot()
        robot.step(HOLD)
        robot.velocity = (0.0, 0.0, -3.0)
        robot.request(request, start)
        assert robot.step(GROUND, ms=4) == set()
    robot = FakeRobot()
    robot.step(TRACK)
    robot.velocity = (0.0, 0.0, -3.0)
    assert robot.step(ESTOP, ms=4) == set()


@pytest.mark.parametrize(
    ("touch_age", "speed", "kinds"), [(9.0, 0.9, set()), (9.0, 1.1, {"rest"}), (0.9, 1.1, set())]
)
def test_a_robot_dropped_in_the_air_is_found(
    touch_age: float, speed: float, kinds: set[str]
) -> None:
    robot = FakeRobot()
    robot.step(HOLD)
    robot.step(GROUND)
    robot.simulator.touch_age, robot.velocity = touch_age, (0.0, 0.0, -speed)
    assert robot.step(GROUND) == kinds


@pytest.mark.parametrize("honest", [True, False])
@pytest.mark.parametrize(("touch_age", "asked"), [(9.0, False), (0.5, False), (9.0, True)])
def test_with_an_honest_cloud_no_hit_is_felt_without_a_touch(
    honest: bool, touch_age: float, asked: bool
) -> None:
    robot = FakeRobot(honest=honest)
    robot.step(TRACK)
    robot.simulator.touch_age = touch_age
    if asked:
        robot.request(Request.ESTOP)
    wrong = honest and not asked and touch_age > 1.0
    assert robot.step(ESTOP) == ({"collision"} if wrong else set())
