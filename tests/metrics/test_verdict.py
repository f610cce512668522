"""Each rule of the verdict: what breaks it, its time and place, and the order of outcomes."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from cloudrc.messages import GuardState
from cloudrc.metrics import SHIPPED, Flight, Number
from cloudrc.metrics.verdict import (
    EXIT_CODES,
    SLIP_MAX,
    Ending,
    Observations,
    Verdict,
    flight_evidence,
    judge,
    operator_verdict,
)
from cloudrc.records import (
    REAL_TIME_FACTOR_MIN,
    Arrival,
    Contact,
    Control,
    GuardChange,
    Lateness,
    MissionEvent,
    Record,
    SessionOpened,
)
from tests.metrics.conftest import ONE_PIPE, SECOND, Log, at, flown, good, touch


def measured(flight: Flight) -> dict[str, Number]:
    return {
        name: Number(value, "", "")
        for name in ("waypoints_reached", "real_time_factor", "world_slip")
        if (value := SHIPPED[name].measure(flight)) is not None
    }


def judged(flight: Flight, *, real_time: bool = False, interrupted: bool = False) -> Verdict:
    how = {"real_time": real_time, "interrupted": interrupted}
    return judge(flight_evidence(flight, measured(flight), **how))


def judged_by_operator(flight: Flight) -> Verdict:
    numbers = measured(flight)
    evidence = flight_evidence(flight, numbers, real_time=True, interrupted=False)
    return operator_verdict(flight, evidence, numbers)


def codes(verdict: Verdict) -> list[str]:
    return [failure.code for failure in verdict.failures]


def test_success() -> None:
    assert judged(good().flight(ONE_PIPE, contact=True)) == Verdict("success", ())


def test_a_waypoint_was_not_reached() -> None:
    verdict = judged(good().flight(ONE_PIPE, contact=True, waypoints=3))
    assert verdict.outcome == "failure"
    assert codes(verdict) == ["waypoint_not_reached"]
    assert verdict.failures[0].text == "1 of 3 waypoints reached"


def test_the_board_was_not_touched() -> None:
    assert codes(judged(flown().flight(ONE_PIPE, contact=True))) == ["board_not_touched"]
    assert judged(flown().flight(ONE_PIPE, contact=False)).outcome == "success"


@pytest.mark.parametrize(("speed", "ok"), [(0.249, True), (0.25, False), (0.4, False)])
def test_the_board_must_be_touched_slowly(speed: float, ok: bool) -> None:
    log = flown()
    still = (0.0, 0.0, 0.0)
    log.world.append(Contact(at(8), "board", still, still, (speed, 0.0, 0.0), True))
    verdict = judged(log.flight(ONE_PIPE, contact=True))
    assert codes(verdict) == ([] if ok else ["contact_too_fast"])


def test_a_pipe_was_touched() -> None:
    log = good()
    log.world += [touch(4, "pipe_1", tip=False), touch(3, "pipe_1", tip=False)]
    (failure,) = judged(log.flight(ONE_PIPE, contact=True)).failures
    assert failure.code == "pipe_touched"
    assert failure.text == "the robot touched pipe_1 (2 times)"
    assert failure.time == pytest.approx(3.0)
    assert failure.place == pytest.approx((3.0, 0.0, 1.0))


@pytest.mark.parametrize("state", [GuardState.LAND, GuardState.ESTOP, GuardState.GROUND])
def test_the_guard_went_beyond_hold(state: GuardState) -> None:
    log = good()
    log.world.append(GuardChange(at(5), state, "held for 60 s"))
    (failure,) = judged(log.flight(ONE_PIPE, contact=True)).failures
    assert failure.code == "guard_intervened"
    assert state.name in failure.text
    assert "held for 60 s" in failure.text
    assert failure.time == pytest.approx(5.0)


def test_hold_is_no_failure() -> None:
    log = good()
    log.world.append(GuardChange(at(5), GuardState.HOLD, "command age"))
    assert judged(log.flight(ONE_PIPE, contact=True)).outcome == "success"


def test_the_time_limit() -> None:
    assert judged(good().flight(ONE_PIPE, contact=True, time_limit=10.0)).outcome == "success"
    verdict = judged(good().flight(ONE_PIPE, contact=True, time_limit=9.9))
    assert codes(verdict) == ["time_limit_exceeded"]


def test_world_restarted() -> None:
    log = good()
    log.world.append(SessionOpened(at(6), "world", 3, "world restarted"))
    log.cloud.append(SessionOpened(at(6.1), "cloud", 3, "world accepted"))
    (failure,) = judged(log.flight(ONE_PIPE, contact=True)).failures
    assert failure.code == "world_restarted"
    assert failure.time == pytest.approx(6.0)


def ended(event: str) -> Log:
    log = good()
    log.change(MissionEvent, lambda n, e: e._replace(event=event, text="why") if n == 2 else e)
    return log


@pytest.mark.parametrize("event", ["timed_out", "leg_timed_out", "guard_stopped"])
def test_the_mission_failed(event: str) -> None:
    verdict = judged(ended(event).flight(ONE_PIPE, contact=True))
    (failure,) = verdict.failures
    assert (verdict.outcome, failure.code, failure.text) == ("failure", event, "why")


def test_a_cancelled_mission_is_interrupted_and_lists_what_went_wrong() -> None:
    log = ended("cancelled")
    log.world.append(touch(3, "pipe_1"))
    verdict = judged(log.flight(ONE_PIPE, contact=True, waypoints=7))
    assert verdict.outcome == "interrupted"
    assert codes(verdict) == ["cancelled", "pipe_touched"]


@pytest.mark.parametrize(
    ("late", "outcomes"),
    [
        ([touch(3, "pipe_1")], ("failure", "failure")),
        ([touch(9.99, "pipe_1")], ("failure", "success")),
        ([GuardChange(at(9.99), GuardState.LAND, "")], ("failure", "success")),
        ([], ("success", "success")),
    ],
)
def test_the_operator_knows_what_had_arrived(late: list[Record], outcomes: tuple[str, str]) -> None:
    log = good()
    log.world += late
    flight = log.flight(ONE_PIPE, contact=True)
    assert (judged(flight).outcome, judged_by_operator(flight).outcome) == outcomes


def test_the_operator_misses_a_touch_at_the_very_end() -> None:
    log = flown()
    log.world.append(touch(9.99))
    flight = log.flight(ONE_PIPE, contact=True)
    assert judged(flight).outcome == "success"
    assert codes(judged_by_operator(flight)) == ["board_not_touched"]


def without_end(log: Log) -> Log:
    log.change(MissionEvent, lambda n, event: None if n else event)
    return log


def test_a_mission_without_an_end() -> None:
    verdict = judged(without_end(good()).flight(ONE_PIPE, contact=True))
    assert verdict.outcome == "failure"
    assert set(codes(verdict)) == {"mission_not_ended", "waypoint_not_reached"}


def test_the_robot_never_flew() -> None:
    log = flown()
    log.change(GuardChange, lambda n, change: None)
    (failure,) = judged(log.flight(ONE_PIPE, contact=True)).failures
    assert failure.code == "not_started"
    assert failure.text.endswith("fresh commands arrived, but no request to start")


@pytest.mark.parametrize(
    ("arrived", "words"),
    [
        (lambda n, a: a._replace(used=False), "was 0.090 s old or older when the command arrived"),
        (lambda n, a: a._replace(used=False), "guard.command_age_max_ms"),
        # The start opens a new session: commands of older sessions do not count.
        (lambda n, a: a._replace(used=n < 9, epoch=1 if n < 9 else 2), "command_age_max_ms"),
        (lambda n, a: a if a.uplink else None, "no command arrived"),
    ],
)
def test_why_the_robot_never_flew(
    arrived: Callable[[int, Arrival], Arrival | None], words: str
) -> None:
    log = flown()
    log.change(GuardChange, lambda n, change: None)
    log.change(Arrival, arrived)
    (failure,) = judged(log.flight()).failures
    assert words in failure.text


def test_without_control_periods_the_robot_never_flew() -> None:
    log = flown()
    log.change(GuardChange, lambda n, change: None)
    log.change(Control, lambda n, control: None)
    (failure,) = judged(log.flight()).failures
    assert failure.text.endswith("cloud computed no command")


def test_an_interrupted_run_lists_only_certain_failures() -> None:
    log = without_end(flown())
    log.world.append(touch(3, "pipe_1"))
    verdict = judged(log.flight(ONE_PIPE, contact=True), interrupted=True)
    assert verdict.outcome == "interrupted"
    assert codes(verdict) == ["interrupted", "pipe_touched"]


def test_an_interruption_after_the_end_changes_nothing() -> None:
    assert judged(good().flight(ONE_PIPE, contact=True), interrupted=True).outcome == "success"


def test_the_earliest_failure_comes_first() -> None:
    log = flown()
    log.world += [touch(7, "pipe_1"), GuardChange(at(2), GuardState.LAND, "")]
    verdict = judged(log.flight(ONE_PIPE, contact=True, waypoints=2))
    assert codes(verdict) == [
        "guard_intervened",
        "pipe_touched",
        "waypoint_not_reached",
        "board_not_touched",
    ]


def in_time(slip: float, factor: float) -> dict[str, Number]:
    values = {"waypoints_reached": 1.0, "world_slip": slip, "real_time_factor": factor}
    return {name: Number(value, "", "") for name, value in values.items()}


@pytest.mark.parametrize(
    ("slip", "factor", "outcome"),
    [
        (0.0, 1.0, "success"),
        (SLIP_MAX, REAL_TIME_FACTOR_MIN, "success"),
        (SLIP_MAX + 1e-6, 0.99, "invalid"),
        (0.1, REAL_TIME_FACTOR_MIN - 1e-6, "invalid"),
    ],
)
def test_real_time_is_kept_or_the_run_is_invalid(slip: float, factor: float, outcome: str) -> None:
    flight = good().flight(ONE_PIPE, contact=True)
    numbers = in_time(slip, factor)
    verdict = judge(flight_evidence(flight, numbers, real_time=True, interrupted=False))
    assert verdict.outcome == outcome
    assert codes(verdict) == ([] if outcome == "success" else ["not_real_time"])
    # Virtual time does not depend on the machine.
    verdict = judge(flight_evidence(flight, numbers, real_time=False, interrupted=False))
    assert verdict.outcome == "success"


def test_a_slow_run_is_invalid_from_its_records() -> None:
    log = good()
    log.world += [Lateness(at(n), "world", 0.0, 0.0, n * SECOND // 10) for n in range(11)]
    verdict = judged(log.flight(ONE_PIPE, contact=True), real_time=True)
    assert codes(verdict) == ["not_real_time"]
    assert "0.909" in verdict.failures[0].text  # 10 s took 11


def test_without_proof_of_real_time_a_run_is_invalid() -> None:
    verdict = judged(good().flight(ONE_PIPE, contact=True), real_time=True)
    assert verdict.outcome == "invalid"


NAN = float("nan")
DONE = Ending("done", "mission done")
LATE = Ending("timed_out", "mission not done within 60 s")


def by_telemetry(
    seen: Observations, *, ending: Ending = DONE, contact: bool = True, reached: int = 3
) -> Verdict:
    known = {"waypoints": 3, "contact_speed_max": 0.25, "contact": contact, "reached": reached}
    return judge(seen.evidence(ending, 30.0, **known))


@pytest.mark.parametrize(
    ("seen", "contact", "outcome", "found"),
    [
        (Observations(touch_speed=0.12), True, "success", []),
        (Observations(), False, "success", []),
        (Observations(touch_speed=9.0), False, "success", []),
        (Observations(), True, "failure", ["board_not_touched"]),
        (Observations(touch_speed=0.25), True, "failure", ["contact_too_fast"]),
        (Observations(pipe_touches=2), False, "failure", ["pipe_touched"]),
        # 5 % of 30 s are 1.5 s.
        (Observations(slip_began_ns=7, slip_ns=1_490_000_007), False, "success", []),
        (Observations(slip_began_ns=7, slip_ns=1_510_000_007), False, "invalid", ["not_real_time"]),
    ],
)
def test_the_same_rules_judge_what_telemetry_shows(
    seen: Observations, contact: bool, outcome: str, found: list[str]
) -> None:
    verdict = by_telemetry(seen, contact=contact)
    assert (verdict.outcome, codes(verdict)) == (outcome, found)
    assert verdict.as_json()["exit_code"] == EXIT_CODES[outcome]


def test_an_early_end_comes_first() -> None:
    verdict = by_telemetry(Observations(pipe_touches=1), ending=LATE, reached=1)
    assert codes(verdict) == [
        "timed_out",
        "waypoint_not_reached",
        "pipe_touched",
        "board_not_touched",
    ]
    assert verdict.failures[2].text == "the robot touched a pipe"


def test_only_what_telemetry_shows_during_the_mission_counts() -> None:
    seen = Observations.begin(3, 0.9, 5)
    assert seen.see(3, 0.9, 5) is seen
    after = seen.see(5, 0.1, 9).see(5, 0.4, 9)
    assert (after.pipe_touches, after.touch_speed) == (2, 0.1), "the first touch stays"
    assert after.slip_ns - after.slip_began_ns == 4
    assert Observations.begin(4, NAN, 0).see(1, NAN, 0).pipe_touches == 1, "it begins again at 0"
    assert [event for event, _ in after.news(seen, 1.0)] == ["pipe_touched", "board_touched"]


def test_slip_while_teleop_is_down_does_not_count() -> None:
    seen = Observations.begin(0, NAN, 5).see(0, NAN, 9)
    for shown in (1_000, 5_000):
        seen = seen.after_restart().see(0, NAN, shown)
        assert seen.slip_ns - seen.slip_began_ns == 4
    seen = seen.see(0, NAN, 5_003)
    assert seen.slip_ns - seen.slip_began_ns == 7
