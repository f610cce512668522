"""What ends a mission early, what a lossy link does to it, and plans that cannot be flown."""

from itertools import pairwise

import pytest

from cloudrc.errors import BadInputError
from cloudrc.messages import Cause, GuardState, Request, Setpoint, Start
from cloudrc.teleop.requests import PREDECESSORS, RequestSender
from cloudrc.teleop.wire import Cancel, GoTo, Hold, Leg, Plan, Resume, RobotStatus, StartMission
from tests.teleop.conftest import AWAY, PLAN, A, B, Flight, flying

NAN, INF = float("nan"), float("inf")


def assert_failed(flight, code, text):
    outcome = flight.teleop.outcome
    assert (flight.state, outcome.code, outcome.success) == ("FAILED", code, False)
    assert outcome.text == text
    assert (flight.events[-1].event, flight.events[-1].text) == (code, text)
    assert flight.setpoints[-1].waypoint == -1
    flight.step(seconds=0.05)
    assert flight.requests[-1].request is Request.END


def test_a_leg_that_takes_too_long_fails_the_mission():
    flight = flying(Plan((Leg(A, dwell=0.0), Leg(B, time_limit=2.0)), time_limit=60.0))
    flight.step(position=A)
    flight.step(position=AWAY, seconds=1.98)
    assert flight.state == "FLYING"
    flight.step(seconds=0.02)
    assert_failed(flight, "leg_timed_out", "waypoint 2 of 2 not reached in 2 s")
    assert flight.teleop.outcome.waypoint == 1
    assert flight.setpoints[-1] == Setpoint(AWAY, 0.0, -1)


def test_held_time_does_not_count_for_the_leg():
    flight = flying(Plan((Leg(A, time_limit=2.0),), time_limit=60.0))
    flight.step(seconds=1.5)
    flight.operate(Hold())
    flight.step(seconds=10.0)
    flight.operate(Resume())
    flight.step(seconds=0.4)
    assert flight.state == "FLYING"
    flight.step(seconds=0.1)
    assert flight.state == "FAILED"


@pytest.mark.parametrize("held", [False, True])
def test_a_mission_that_takes_too_long_fails_held_or_not(held):
    flight = flying(Plan((Leg(A),), time_limit=3.0))
    if held:
        flight.operate(Hold())
    flight.step(seconds=2.95)
    assert flight.teleop.outcome is None
    flight.step(seconds=0.05)
    text = "mission not done within 3 s: on the way to waypoint 1 of 1"
    assert_failed(flight, "timed_out", text)


def test_time_runs_out_while_nothing_is_seen_too():
    flight = flying(Plan((Leg(A),), time_limit=3.0))
    flight.uplink = False
    flight.step(seconds=3.0)
    assert flight.state == "FAILED"


def test_a_robot_that_never_starts_fails_the_mission():
    flight = Flight()
    flight.downlink = False
    flight.step()
    flight.operate(StartMission(Plan((Leg(A),), time_limit=3.0)))
    flight.step(seconds=3.0)
    assert_failed(flight, "timed_out", "the robot has not started within 3 s; is the link up?")


def test_no_robot_is_held_where_it_would_scrape_along_the_floor():
    flight = flying()
    flight.step(position=(0.2, 0.1, 0.12))
    flight.operate(Hold())
    assert flight.setpoints[-1].position == (0.2, 0.1, 0.35)
    flight.operate(Cancel())
    assert flight.setpoints[-1].position == (0.2, 0.1, 0.35)


@pytest.mark.parametrize("held", [False, True])
def test_a_world_that_restarts_fails_the_mission(held):
    flight = flying()
    if held:
        flight.operate(Hold())
    flight.restart()
    flight.step()
    text = "world restarted on the way to waypoint 1 of 3"
    assert_failed(flight, "world_restarted", text)
    assert flight.setpoints[-1].position == (*flight.position[:2], 0.35)


def test_a_world_that_restarts_before_a_start_from_here_fails_it():
    flight = Flight()
    flight.step(position=A)
    flight.operate(StartMission(Plan((Leg(B),), start=Start.HERE)))
    flight.restart()
    flight.step()
    assert flight.teleop.outcome.code == "world_restarted"


@pytest.mark.parametrize("guard", [GuardState.LAND, GuardState.ESTOP])
def test_a_guard_that_lands_or_stops_fails_the_mission(guard):
    flight = flying()
    flight.guard, flight.cause = guard, Cause.IMPOSSIBLE
    flight.step()
    text = f"guard went to {guard.name} (impossible commands) on the way to waypoint 1 of 3"
    assert_failed(flight, "guard_stopped", text)


def test_hold_during_silence_does_not_end_the_mission():
    flight = flying()
    flight.guard = GuardState.HOLD
    flight.step(seconds=20.0)
    assert flight.state == "FLYING"


def test_a_request_repeats_at_10_hz_until_acknowledged():
    flight = Flight()
    flight.downlink = False
    flight.step()
    flight.operate(StartMission(PLAN))
    flight.step(seconds=1.0)
    times = [
        when
        for when, said in zip(flight.said_at, flight.said, strict=True)
        if said in flight.requests
    ]
    assert len(times) == 10
    assert all(later - earlier == 100_000_000 for earlier, later in pairwise(times))
    assert {request.number for request in flight.requests} == {PREDECESSORS}
    flight.downlink = True
    flight.step(seconds=0.15)
    assert flight.state == "FLYING"
    count = len(flight.requests)
    flight.step(seconds=2.0)
    assert len(flight.requests) == count


def test_a_lost_acknowledgement_lets_the_request_go_on():
    flight = Flight()
    flight.step()
    flight.operate(StartMission(PLAN))
    flight.uplink = False
    flight.step(seconds=0.5)
    assert (flight.state, len(flight.requests)) == ("STARTING", 5)
    assert flight.mission == PREDECESSORS
    flight.uplink = True
    flight.step()
    assert flight.state == "FLYING"


def test_a_mission_may_be_asked_for_before_the_robot_is_in_sight():
    flight = Flight()
    flight.uplink = False
    flight.operate(StartMission(PLAN))
    flight.step(seconds=1.0)
    assert flight.requests == []
    flight.uplink = True
    flight.step(seconds=0.03)
    assert flight.state == "FLYING"


def test_the_end_is_asked_for_although_nothing_is_seen():
    flight = flying()
    flight.uplink = False
    flight.operate(Cancel())
    flight.step()
    last = flight.requests[-1]
    assert (last.number, last.request) == (PREDECESSORS + 1, Request.END)


def test_numbers_go_on_well_above_what_the_robot_shows():
    flight = Flight()
    flight.mission = 41  # a cloud that has been restarted since has asked for these
    flight.step()
    flight.operate(GoTo(B))
    flight.step(seconds=0.05)
    assert flight.requests[0].number == 41 + PREDECESSORS
    assert flight.state == "FLYING"


def test_a_predecessors_request_does_not_acknowledge_our_start():
    """It asked for the mission's end, was gone at once, and the robot shows that only now."""
    repeater, seen = RequestSender(), RobotStatus(1, A, GuardState.TRACK, 41)
    repeater.see(seen, 0)
    repeater.ask(Request.START, Start.HERE)
    own = repeater.due(0).number
    assert repeater.see(seen._replace(mission=42), 0) is None
    assert repeater.see(seen._replace(mission=own), 0) is Request.START


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"position": (NAN, 0.0, 1.0)}, "finite"),
        ({"position": (0.0, INF, 1.0)}, "finite"),
        ({"position": A, "yaw": NAN}, "finite"),
        ({"position": A, "tolerance": 0.0}, "tolerance 0.0 m"),
        ({"position": A, "tolerance": NAN}, "tolerance nan m"),
        ({"position": A, "dwell": -1.0}, "dwell -1.0 s"),
        ({"position": A, "dwell": NAN}, "dwell nan s"),
        ({"position": A, "time_limit": 0.0}, "limit 0.0 s"),
    ],
)
def test_a_leg_that_cannot_be_flown_is_refused(values, message):
    with pytest.raises(BadInputError, match=message):
        Leg(**values)


def test_a_plan_needs_a_waypoint_and_a_limit():
    with pytest.raises(BadInputError, match="at least one waypoint"):
        Plan(())
    with pytest.raises(BadInputError, match="limit inf s"):
        Plan((Leg(A),), time_limit=INF)


def test_a_point_that_is_none_is_refused_and_changes_nothing():
    flight = flying()
    flight.operate(Hold())
    before = list(flight.said)
    with pytest.raises(BadInputError, match="finite"):
        flight.operate(GoTo((0.0, 0.0, NAN)))
    assert (flight.state, flight.said) == ("HELD", before)


def test_a_wait_for_take_off_does_not_use_up_the_first_leg():
    """Once released the robot takes off only when it has been still."""
    flight = flying(Plan((Leg(A, time_limit=1.0),), Start.HERE))
    flight.guard = GuardState.GROUND
    flight.step(seconds=2.5)
    assert flight.state == "FLYING"
    flight.guard = GuardState.TRACK
    flight.step(seconds=0.9)
    assert flight.state == "FLYING"
    flight.step(seconds=0.2)
    assert flight.teleop.outcome.code == "leg_timed_out"
