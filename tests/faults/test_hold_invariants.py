"""The invariants of the operator's requests and of the end of a HOLD."""

from __future__ import annotations

import pytest

from cloudrc.faults.invariants import GROUND_NS, RAMP
from cloudrc.messages import ZERO, Cause, GuardState, Request, Start
from tests.faults.conftest import ESTOP, GROUND, HOLD, LAND, MS, TRACK, FakeRobot

HOLD_MS = 60_000


@pytest.mark.parametrize("latched", [LAND, ESTOP])
@pytest.mark.parametrize("after", [GROUND, TRACK, HOLD])
@pytest.mark.parametrize("released", [True, False])
def test_a_latched_state_ends_by_an_acknowledgement_only(
    latched: GuardState, after: GuardState, released: bool
) -> None:
    robot = FakeRobot()
    robot.request(Request.ACKNOWLEDGE)  # of nothing: it counts for no later landing
    robot.offer(5, "range")
    robot.step(latched)
    if released:
        robot.release()
    found = robot.step(after) - {"stale"}
    assert found == (set() if released else {"latch"})


@pytest.mark.parametrize("request_", [Request.END, Request.ESTOP])
def test_track_needs_a_mission_that_the_operator_started(request_: Request) -> None:
    robot = FakeRobot()
    assert robot.step(TRACK) == set()
    robot.request(request_)
    assert robot.step(HOLD, ms=HOLD_MS + 100) == set(), "nobody has to wait for its end"
    robot = FakeRobot()
    robot.request(request_)
    assert robot.step(TRACK) == {"latch"}
    robot = FakeRobot()
    robot.request(request_)
    robot.request(Request.START)
    assert robot.step(TRACK) == set()


@pytest.mark.parametrize(
    ("count", "apart_ms", "kinds"),
    [(10, 55, set()), (10, 56, {"stale"}), (9, 10, {"stale"}), (0, 10, {"stale"}), (30, 55, set())],
)
def test_a_hold_ends_after_ten_fresh_commands_in_half_a_second(
    count: int, apart_ms: int, kinds: set[str]
) -> None:
    robot = FakeRobot()
    robot.step(HOLD)
    start_ns = robot.now_ns
    for n in range(count):
        robot.now_ns = start_ns + n * apart_ms * MS
        robot.offer()
    robot.now_ns = start_ns
    assert robot.step(TRACK, fresh=False) == kinds


@pytest.mark.parametrize("how", ["session", "mission", "refused", "before"])
def test_other_commands_do_not_end_a_hold(how: str) -> None:
    robot = FakeRobot()
    if how == "before":
        robot.offer(10)
        robot.step(TRACK, ms=1000)
    robot.step(HOLD, ms=1000)
    robot.offer(9, "stale" if how == "refused" else None)
    if how == "session":
        robot.observer.see_session(robot.now_ns)
    elif how == "mission":
        robot.request(Request.END)
        robot.request(Request.START)
    if how != "before":
        robot.offer()
    assert "stale" in robot.step(TRACK, fresh=False)
    robot = FakeRobot()
    robot.step(HOLD)
    robot.request(Request.START, Start.SPAWN)
    assert robot.step(TRACK) == set(), "from the spawn one command is enough"


@pytest.mark.parametrize(("apart_ms", "kinds"), [(998, {"hold"}), (1000, set())])
def test_track_begins_a_second_after_the_last_track(apart_ms: int, kinds: set[str]) -> None:
    robot = FakeRobot()
    robot.step(GROUND)
    robot.step(TRACK, ms=100)
    robot.step(HOLD, ms=apart_ms - 100)
    robot.offer(10)
    assert robot.step(TRACK) == kinds


@pytest.mark.parametrize(
    ("cause", "kinds"), [(Cause.SILENCE, {"hold"}), (Cause.SESSION, set()), (Cause.ENDED, set())]
)
def test_holds_for_silence_begin_a_second_apart(cause: Cause, kinds: set[str]) -> None:
    for apart_ms, found in ((998, kinds), (1000, set())):
        robot = FakeRobot()
        robot.step(TRACK, ms=1000)
        robot.step(HOLD, ms=apart_ms - 10)
        robot.offer(10)
        robot.step(TRACK, ms=10)
        robot.guard.cause = cause
        assert robot.step(HOLD) == found


def test_a_hold_after_commands_on_older_odometry_is_allowed() -> None:
    for bases_ms, kinds in (((9, 8), set()), ((8, 9), {"hold"}), ((9, 9), {"hold"})):
        robot = FakeRobot()
        robot.step(TRACK, ms=1000)
        robot.step(HOLD, ms=250)
        robot.offer(10)
        robot.step(TRACK, ms=10)
        robot.step(TRACK, ms=10, fresh=False)
        for basis_ms in bases_ms:
            robot.offer(basis_ms=1260 + basis_ms)
        robot.guard.cause = Cause.SILENCE
        assert robot.step(HOLD) == kinds


WAITS = [
    (HOLD, HOLD_MS, HOLD_MS),
    (GROUND, HOLD_MS, HOLD_MS),
    (HOLD, 2_000, 2_000),
    (GROUND, 2_000, GROUND_NS // MS),
]
"""State, configured hold time and actual wait [ms]."""


@pytest.mark.parametrize(("state", "hold_ms", "wait_ms"), WAITS)
def test_a_mission_waits_for_its_cloud_as_long_as_configured(
    state: GuardState, hold_ms: int, wait_ms: int
) -> None:
    robot = FakeRobot(hold_ms=hold_ms)
    assert robot.step(state, ms=wait_ms) == set()
    assert robot.step(state, ms=6) == {"hold"}
    for waited_ms, kinds in ((wait_ms, {"hold"}), (wait_ms + 2, set())):
        robot = FakeRobot(hold_ms=hold_ms)
        robot.step(state, ms=waited_ms)
        assert robot.step(LAND) == kinds


@pytest.mark.parametrize(
    ("count", "wait_ms", "kinds"), [(5, 0, set()), (4, 0, {"hold"}), (5, 100, {"hold"})]
)
def test_five_impossible_commands_just_now_justify_a_landing(
    count: int, wait_ms: int, kinds: set[str]
) -> None:
    robot = FakeRobot()
    robot.step(TRACK, ms=100)
    robot.step(HOLD, ms=100)
    robot.offer(count, "range")
    robot.step(HOLD, ms=wait_ms)
    assert robot.step(LAND) == kinds


@pytest.mark.parametrize(("growth", "kinds"), [(RAMP, set()), (1.01 * RAMP, {"cap"})])
def test_after_a_hold_the_reference_grows_slowly(growth: float, kinds: set[str]) -> None:
    robot = FakeRobot()
    robot.step(HOLD, ms=1000)
    robot.offer(10)
    for n in range(5):
        speed = n * growth * 0.002
        robot.step(TRACK, reference=(0.6 * speed, 0.0, 0.8 * speed))
    assert robot.kinds == kinds


def test_after_the_ramp_the_reference_may_grow_fast() -> None:
    robot = FakeRobot()
    robot.step(HOLD, ms=1000)
    robot.offer(10)
    assert robot.step(TRACK, ms=2000, reference=ZERO) == set()  # 6 m/s at 3 m/s^2
    assert robot.step(TRACK, reference=(0.024, 0.0, 0.0)) == set()
