# SPDX-License-Identifier: Apache-2.0

"""Each rule of the verdict: what breaks it, its time and place, and the order of outcomes."""

from dataclasses import replace

import pytest

from cloudrc.config.schema import MissionConfig
from cloudrc.results.metrics.measure import Number, measure_all
from cloudrc.results.metrics.verdict import (
    SLIP_MAX,
    Ending,
    Evidence,
    FlightFailure,
    Observations,
    exit_code,
    flight_evidence,
    judge,
    operator_verdict,
)
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import (
    CONTROLLER_LOST,
    REAL_TIME_FACTOR_MIN,
    Control,
    Counted,
    Fault,
    GuardChange,
    MissionEvent,
    SessionOpened,
)
from tests.results.metrics.conftest import (
    ONE_PIPE,
    at,
    flown,
    good,
    judged,
    measured,
    to_point,
    touch,
)


def to_board(log, **more):
    """Return the flight of a log whose mission is to touch the board, past a pipe."""
    return log.flight(ONE_PIPE, **{"touch": "board", **more})


def codes(verdict):
    return [failure.code for failure in verdict.failures]


def world(*records, log=good):
    logged = log()
    logged.world += records
    return logged


def ended(event):
    log = good()
    log.change(MissionEvent, lambda n, e: e._replace(event=event, text="why") if n == 2 else e)
    return log


def without_end(log):
    log.change(MissionEvent, lambda n, event: None if n else event)
    return log


def met(speed):
    touched = touch(8)._replace(touch_velocity=(speed, 0.0, 0.0))
    return world(touched, log=flown)


@pytest.mark.parametrize(
    ("log", "limits", "outcome", "found"),
    [
        (good, {}, "success", []),
        (good, {"waypoints": 3}, "failure", ["waypoint_not_reached"]),
        (good, {"time_limit": 9.9}, "failure", ["time_limit_exceeded"]),
        (flown, {}, "failure", ["not_touched"]),
        (lambda: met(0.25 + 1e-15), {}, "success", []),
        (lambda: met(0.2500001), {}, "failure", ["contact_too_fast"]),
        (lambda: world(GuardChange(at(5), GuardState.HOLD, "")), {}, "success", []),
        *((lambda e=e: ended(e), {}, "failure", [e]) for e in ("timed_out", "guard_stopped")),
        # Of a cancelled mission only what must never happen is a failure.
        (lambda: ended("cancelled"), {"waypoints": 7}, "interrupted", ["cancelled"]),
        (lambda: without_end(good()), {}, "failure", ["mission_not_ended", "waypoint_not_reached"]),
        # The earliest failure comes first.
        (
            lambda: world(touch(7, "pipe_1"), GuardChange(at(2), GuardState.LAND, ""), log=flown),
            {"waypoints": 2},
            "failure",
            ["guard_intervened", "obstacle_touched", "waypoint_not_reached", "not_touched"],
        ),
    ],
)
def test_rules(log, limits, outcome, found):
    verdict = judged(to_board(log(), **limits))
    assert (verdict.outcome, codes(verdict)) == (outcome, found)


@pytest.mark.parametrize(
    ("log", "code", "text", "time"),
    [
        (
            world(touch(4, "pipe_1"), touch(3, "pipe_1")),
            "obstacle_touched",
            "pipe_1 (2 times)",
            3.0,
        ),
        (  # A touch-down repeats LAND.
            world(*(GuardChange(at(n), GuardState.LAND, f"why {n}") for n in (5, 6))),
            "guard_intervened",
            "LAND: why 5",
            5.0,
        ),
        (world(SessionOpened(at(6), "world", 3, "why")), "world_restarted", "why", 6.0),
        (ended("timed_out"), "timed_out", "why", 10.0),
    ],
)
def test_a_failure_says_what_when_and_where(log, code, text, time):
    (failure,) = judged(to_board(log)).failures
    assert failure.code == code
    assert text in failure.text
    assert failure.time == pytest.approx(time)
    assert failure.place == pytest.approx((time, 0.0, 1.0))


def along_setpoints(last, log, **criteria):
    """A flight that ends at x = 10 m; its file of setpoints ends at x = `last` [m]."""
    log.change(Control, lambda n, c: c._replace(setpoint=(last, 0.0, 1.0), waypoint=0))
    return log.flight(mission=MissionConfig(setpoints="track.csv"), touch="board", **criteria)


@pytest.mark.parametrize(
    ("last", "settle", "found", "reached"),
    [
        (10.15, 0.15, [], 1.0),
        (10.16, 0.15, ["not_settled"], 0.0),
        (14.0, None, [], 1.0),
    ],
)
def test_a_robot_far_from_the_last_setpoint_of_a_file_fails(last, settle, found, reached):
    flight = along_setpoints(last, good(), settle_m=settle)
    verdict = judged(flight)
    assert codes(verdict) == found
    assert measured(flight, "final_error") == pytest.approx(last - 10.0, abs=1e-6)
    assert measured(flight, "waypoints_reached") == reached
    if found:
        assert f"{last - 10.0:.4g} m from the last one" in verdict.failures[0].text


def driven():
    """A drive by hand; its mission names the file of its setpoints, for a repetition."""
    log = good()
    log.cloud.append(MissionEvent(at(1), "driving", -1, "driven by hand"))
    return log


@pytest.mark.parametrize(("log", "found"), [(driven(), []), (ended("timed_out"), ["timed_out"])])
def test_only_a_file_that_was_flown_to_its_end_has_a_last_setpoint(log, found):
    flight = along_setpoints(14.0, log)
    assert (codes(judged(flight)), measured(flight, "final_error")) == (found, None)


@pytest.mark.parametrize(
    ("body", "wanted", "is_obstacle"),
    [
        *((body, "board", True) for body in ("pillar", "board2")),
        *((body, "board", False) for body in ("board", "floor")),
        *(("board", wanted, True) for wanted in ("pillar", None)),
    ],
)
def test_every_body_is_an_obstacle_but_the_floor_and_what_to_touch(body, wanted, is_obstacle):
    flight = world(touch(3, body), log=flown).flight(touch=wanted)
    assert ("obstacle_touched" in codes(judged(flight))) == is_obstacle
    assert measured(flight, "obstacle_contacts") == is_obstacle


def test_an_interrupted_run_lists_only_certain_failures():
    log = without_end(world(touch(3, "pipe_1"), log=flown))
    verdict = judged(to_board(log), interrupted=True)
    assert verdict.outcome == "interrupted"
    assert codes(verdict) == ["interrupted", "obstacle_touched"]
    # After the mission's end an interruption changes nothing.
    assert judged(to_board(good()), interrupted=True).outcome == "success"


MISSED = to_point(30.0, 0.1)


@pytest.mark.parametrize(
    ("log", "mission", "report", "operator"),
    [
        (good(), None, [], []),
        (good(), MISSED, ["waypoint_not_reached"], []),  # the operator had reported it
        (world(touch(3, "pipe_1")), None, ["obstacle_touched"], ["obstacle_touched"]),
        # What telemetry had not shown when the mission ended
        (world(touch(9.99, "pipe_1")), None, ["obstacle_touched"], []),
        (world(touch(9.99), log=flown), None, [], ["not_touched"]),
        # What the last command was based on
        (world(touch(9.95, "pipe_1")), None, ["obstacle_touched"], ["obstacle_touched"]),
    ],
)
def test_the_operator_knows_what_had_arrived(log, mission, report, operator):
    flight = to_board(log, mission=mission)
    numbers = measure_all(flight).numbers
    evidence = flight_evidence(flight, numbers, real_time=True, interrupted=False)
    assert codes(judged(flight)) == report
    assert codes(operator_verdict(flight, evidence, numbers)) == operator


def test_a_failure_says_when_and_how_far_the_robot_left_a_waypoint_in_its_dwell_time():
    def path(seconds):
        return (0.16 if 7.3 < seconds < 7.5 else 0.02, 0.0, 1.0)

    def unseen(sent):
        return {"odometry": sent.telemetry.odometry._replace(position=(0.02, 0.0, 1.0))}

    log = flown(path)
    log.tell(unseen)
    (failure,) = judged(log.flight(mission=to_point(0.0, 0.1, 8.0))).failures
    assert failure.code == "waypoint_not_reached"
    assert "0.16 m from it at 7.32 s" in failure.text


@pytest.mark.parametrize(
    ("slip", "factor", "said"),
    [
        (SLIP_MAX * (1 + 1e-12), REAL_TIME_FACTOR_MIN * (1 - 1e-12), None),
        (SLIP_MAX + 1e-6, 0.99, "world's clock lost 0.25 s"),
        (0.1, REAL_TIME_FACTOR_MIN - 1e-6, "real-time factor 0.95 is below"),
        (None, 0.99, "does not prove"),  # no rows of lateness
    ],
)
def test_real_time_is_kept_or_the_run_is_invalid(slip, factor, said):
    values = {"waypoints_reached": 1.0, "world_slip": slip, "real_time_factor": factor}
    numbers = {k: Number(value, "", "") for k, value in values.items() if value is not None}
    flight = to_board(good())
    real, virtual = (judged(flight, numbers, real_time=how) for how in (True, False))
    assert real.outcome == ("invalid" if said else "success")
    assert codes(real) == ["not_real_time"] * bool(said)
    assert not said or said in real.failures[0].text
    assert virtual.outcome == "success", "it does not depend on the machine"


@pytest.mark.parametrize(("failures", "found"), [(2, []), (3, ["plugin_failed"])])
def test_a_plug_in_may_fail_in_one_percent_of_the_periods(failures, found):
    """The flight has 251 periods."""
    log = good()
    text = "the predictor failed (KeyError: 'oops', my.py:12 in predict)"
    log.cloud.append(Fault(at(1), "predictor_failed", text))
    log.cloud.append(Counted(at(2), "cloud", "predictor_failed", failures))
    verdict = judged(to_board(log))
    assert codes(verdict) == found
    for said in ("failed in 1.195% of its periods, above 1%:", "my.py:12 in predict"):
        assert all(said in each.text for each in verdict.failures)


@pytest.mark.parametrize("when", [(-2.5, -0.5, 0.5, 8.0), (-0.5, 12.0)])
def test_failures_of_an_earlier_mission_do_not_count(when):
    log = good()
    log.cloud += [Counted(at(time), "cloud", "predictor_failed", 400) for time in when]
    flight = to_board(log)
    assert judged(flight).outcome == "success"
    assert measure_all(flight).numbers["fault_count"].value == 0.0


def test_a_robot_that_never_flew_is_a_failure_and_only_what_explains_it_is_told():
    log = good()
    log.change(GuardChange, lambda n, change: change._replace(state=GuardState.GROUND))
    log.cloud.append(Counted(at(2), "cloud", "controller_failed", 400))
    verdict = judged(to_board(log))
    assert sorted(codes(verdict)) == ["not_started", "plugin_failed"]


def test_a_recording_cut_off_by_a_full_disk_is_no_failed_mission():
    flight = without_end(good()).flight(ONE_PIPE)
    flight.recording.told = "world: recording stopped: disk quota used up"
    assert codes(judged(flight, interrupted=True))[0] == "interrupted"
    flight.recording.metadata = {"stopped": "disk_full"}
    verdict = judged(flight, interrupted=True)
    assert codes(verdict)[0] == "disk_full"
    report = {"verdict": verdict.outcome, "failures": [{"code": code} for code in codes(verdict)]}
    assert exit_code(report) == 3


@pytest.mark.parametrize("code", [*CONTROLLER_LOST, "late"])
def test_a_mission_ends_with_the_program_that_controls_it(code):
    log = without_end(good())
    log.cloud.append(Fault(at(9), code, "why"))
    found = codes(judged(log.flight(ONE_PIPE)))
    assert (code in found, "mission_not_ended" in found) == (code != "late", code == "late")


DONE = Ending("done", "")
REACHED = Evidence(1, 1, None, DONE)


@pytest.mark.parametrize(
    ("more", "outcome", "said"),
    [
        ({"lost": "a second"}, "invalid", "success as far as the recording goes: a second"),
        ({"lost": "a second", "reached": 0}, "invalid", "it is not known whether"),
        ({"lost": "a second", "violations": (FlightFailure("x", "it hit"),)}, "failure", "it hit"),
        ({"ending": Ending("timed_out", "late"), "reached": 0}, "failure", "late"),
    ],
)
def test_what_is_known_fails_a_mission_also_if_the_recording_lost_something(more, outcome, said):
    verdict = judge(replace(REACHED, **more))
    assert verdict.outcome == outcome
    assert said in verdict.failures[0].text
    known = {"verdict": outcome, "failures": [{"code": "late"}]}
    assert exit_code(known) == {"invalid": 6, "failure": 1}[outcome]


def test_telemetry_tells_contacts_and_slip_as_they_rise():
    first = Observations(1, "at 3 s", 0.1, slip_ns=1_000_000_000)
    more = replace(first, obstacle_contacts=2)
    told = [text for seen, before in ((first, Observations()), (more, first), (more, more))
            for _, text in seen.news(before, 5.0, "board")]  # fmt: skip
    assert told[0] == "the robot touched an obstacle at 3 s"
    assert told[1] == "board touched at 5.00 s with 0.10 m/s"
    assert told[2] == "the robot touched an obstacle again, at 5.00 s"
    found = first.evidence(DONE, 10.0, waypoints=1, reached=1, wanted=None)
    assert found.violations[0].text == "the robot touched an obstacle at 3 s"
    assert found.slow.startswith("real-time factor 0.9 is below")
    assert first.evidence(DONE, 0.0, waypoints=0, reached=0, wanted=None).slow == ""
