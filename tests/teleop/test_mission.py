"""The mission machine: each transition by example."""

from itertools import pairwise

import pytest

from cloudrc.errors import BadInputError
from cloudrc.messages import GuardState, Request, Setpoint, Start
from cloudrc.teleop.wire import Cancel, GoTo, Hold, Leg, Plan, Resume, StartMission
from tests.teleop.conftest import AWAY, PLAN, A, B, C, Flight, flying


def last_event(flight):
    return flight.events[-1].event


def test_without_a_mission_the_setpoint_is_the_first_position():
    flight = Flight()
    flight.step(position=A)
    flight.step(position=B)
    assert flight.said == [Setpoint(A, 0.0, -1)]
    assert flight.state == "IDLE"
    assert flight.teleop.outcome is None


def test_without_a_mission_the_setpoint_follows_a_world_restart():
    flight = Flight()
    flight.step(position=A)
    flight.restart()
    flight.step(position=B)
    assert flight.said == [Setpoint(A), Setpoint(B)]


def test_a_mission_starts_once_the_new_world_confirms_it():
    flight = Flight()
    flight.step()
    flight.operate(StartMission(PLAN))
    assert flight.state == "STARTING"
    assert flight.setpoints[-1] == Setpoint(A, 0.3, 0)
    flight.step()
    assert flight.requests[0].request is Request.START
    assert flight.requests[0].start is Start.SPAWN
    assert (flight.state, flight.events) == ("STARTING", [])
    flight.step()
    assert flight.state == "FLYING"
    assert flight.events[0].text == "mission started from the spawn, waypoints: 3"


def test_the_old_world_does_not_confirm_a_start_from_spawn():
    flight = Flight()
    flight.step()
    flight.operate(StartMission(PLAN))
    flight.downlink = False
    flight.step()
    flight.mission = flight.requests[0].number  # a predecessor's word, by chance of this number
    flight.step(seconds=0.15)
    assert flight.state == "STARTING"
    assert flight.requests[-1].number == flight.requests[0].number + 1
    flight.downlink = True
    flight.step(seconds=0.15)
    assert (flight.state, flight.epoch) == ("FLYING", 2)


def test_a_start_from_here_needs_no_new_world():
    flight = flying(Plan((Leg(A),), start=Start.HERE))
    assert flight.epoch == 1
    assert flight.events[0].text == "mission started from here, waypoints: 1"


def test_a_mission_flies_its_legs_in_order_and_ends_in_a_hold():
    flight = flying()
    flight.step(position=A, seconds=0.6)
    assert flight.setpoints[-1] == Setpoint(B, 0.0, 1)
    flight.step(position=B, seconds=0.02)
    assert flight.setpoints[-1] == Setpoint(C, 0.0, 2)
    there = (3.05, 0.0, 1.0)
    flight.step(position=there, seconds=0.7)
    assert flight.state == "DONE"
    assert flight.setpoints[-1] == Setpoint(there, 0.0, -1)
    assert [event.event for event in flight.events] == ["started", *["reached"] * 3, "done"]
    assert [event.waypoint for event in flight.events] == [0, 0, 1, 2, 2]
    assert flight.guard is GuardState.HOLD
    outcome = flight.teleop.outcome
    assert outcome.success
    assert (outcome.code, outcome.waypoint) == ("done", 2)


def test_events_say_what_happened_and_when():
    flight = flying()
    flight.step(position=A, seconds=0.6)
    # Seen to have started at 0.03 s and to be there from 0.05 to 0.55 s.
    assert flight.events[-1].text == "waypoint 1 of 3 reached at 0.52 s"


def test_dwell_starts_again_when_the_robot_leaves_the_tolerance():
    flight = flying()
    flight.step(position=A, seconds=0.45)
    flight.step(position=(1.11, 0.0, 1.0))
    flight.step(position=A, seconds=0.45)
    assert last_event(flight) == "started"
    flight.step(position=A, seconds=0.06)
    assert last_event(flight) == "reached"


def test_the_tolerance_is_a_distance_in_space():
    flight = flying()
    flight.step(position=(1.07, 0.07, 1.07), seconds=1.0)
    assert last_event(flight) == "started"


def test_legs_of_infinite_tolerance_last_their_dwell_time():
    legs = tuple(Leg(place, tolerance=float("inf"), dwell=0.4) for place in (A, B, C))
    flight = flying(Plan(legs))
    flight.step(position=AWAY, seconds=1.3)
    stamps = [event.stamp_ns for event in flight.events if event.event == "reached"]
    assert [later - earlier for earlier, later in pairwise(stamps)] == [
        400_000_000,
        400_000_000,
    ]
    assert flight.state == "DONE"


def test_hold_freezes_the_setpoint_and_resume_continues():
    flight = flying()
    flight.step(position=A, seconds=0.6)
    flight.step(position=AWAY)
    flight.operate(Hold())
    assert flight.state == "HELD"
    assert flight.setpoints[-1] == Setpoint(AWAY, 0.0, -1)
    flight.step(position=B, seconds=1.0)
    assert last_event(flight) == "held"
    flight.operate(Resume())
    assert flight.setpoints[-1] == Setpoint(B, 0.0, 1)
    flight.step()
    assert [event.event for event in flight.events[-2:]] == ["resumed", "reached"]
    assert all(request.request is Request.START for request in flight.requests)


def test_goto_while_held_moves_the_held_point_only():
    flight = flying()
    flight.operate(Hold())
    flight.operate(GoTo(AWAY, yaw=0.5))
    assert flight.state == "HELD"
    assert flight.setpoints[-1] == Setpoint(AWAY, 0.5, -1)
    flight.operate(Resume())
    assert flight.setpoints[-1] == Setpoint(A, 0.3, 0)


@pytest.mark.parametrize("before", ["idle", "done", "cancelled"])
def test_goto_without_a_mission_is_one_that_starts_from_here(before):
    flight = flying() if before == "cancelled" else Flight()
    if before == "done":
        flight = flying(Plan((Leg(A, dwell=0.0),)))
        flight.step(position=A)
    if before == "cancelled":
        flight.operate(Cancel())
    flight.step(seconds=0.05)
    epoch = flight.epoch
    flight.operate(GoTo(AWAY))
    assert flight.teleop.outcome is None
    flight.step(seconds=0.05)
    assert flight.state == "FLYING"
    assert flight.setpoints[-1].position == AWAY
    flight.step(position=AWAY, seconds=0.6)
    assert flight.state == "DONE"
    assert flight.epoch == epoch
    assert [event.event for event in flight.events[-4:]] == ["goto", "started", "reached", "done"]


@pytest.mark.parametrize("moment", ["starting", "flying", "held"])
def test_cancel_ends_the_mission_in_a_hold(moment):
    flight = Flight()
    flight.step(position=A)
    flight.operate(StartMission(PLAN))
    if moment != "starting":
        flight.step(seconds=0.05)
    if moment == "held":
        flight.operate(Hold())
    flight.operate(Cancel())
    assert flight.state == "CANCELLED"
    assert flight.setpoints[-1].waypoint == -1
    assert flight.teleop.outcome.code == "cancelled"
    assert not flight.teleop.outcome.success
    flight.step(seconds=0.05)
    assert flight.requests[-1].request is Request.END
    assert flight.mission == flight.requests[-1].number


def test_another_mission_can_follow():
    flight = flying(Plan((Leg(A, dwell=0.0),)))
    flight.step(position=A)
    flight.step(seconds=0.05)
    flight.operate(StartMission(PLAN))
    flight.step(seconds=0.05)
    assert flight.state == "FLYING"
    assert flight.teleop.outcome is None
    assert flight.setpoints[-1] == Setpoint(A, 0.3, 0)


@pytest.fixture
def ended():
    """A mission is done, but its end has not reached the robot, which tracks on."""
    flight = flying(Plan((Leg(A, dwell=0.0),)))
    flight.downlink = False
    flight.step(position=A)
    assert (flight.state, flight.guard) == ("DONE", GuardState.TRACK)
    return flight


def test_a_flying_robot_gets_no_new_setpoint_before_a_new_start(ended):
    """It would fly past the spawn, through whatever stands between."""
    ended.operate(StartMission(PLAN))
    ended.step(seconds=0.5)
    assert ended.setpoints[-1] == Setpoint(A, 0.0, -1)
    ended.downlink = True
    ended.step(seconds=0.15)
    assert ended.state == "FLYING"
    assert ended.setpoints[-1] == Setpoint(A, 0.3, 0)


def test_a_robot_in_hold_gets_the_first_waypoint_at_once(ended):
    ended.downlink = True
    ended.step(seconds=0.15)
    assert ended.guard is GuardState.HOLD
    ended.downlink = False
    ended.operate(StartMission(PLAN))
    assert ended.setpoints[-1] == Setpoint(A, 0.3, 0)


@pytest.mark.parametrize("acted_on", [False, True])
def test_a_request_between_end_and_start_may_have_taken_effect(ended, acted_on):
    ended.downlink = True
    ended.step(seconds=0.15)
    ended.operate(StartMission(Plan((Leg(B),), Start.HERE)))
    ended.uplink = False
    ended.downlink = acted_on
    ended.step(seconds=0.15)
    ended.downlink = False
    ended.operate(Cancel())
    ended.uplink = True
    ended.step(seconds=0.15)
    before = len(ended.setpoints)
    ended.operate(StartMission(PLAN))
    ended.step(seconds=0.15)
    assert ended.setpoints[before:] == []


VERBS = {
    "start": StartMission(PLAN),
    "hold": Hold(),
    "resume": Resume(),
    "goto": GoTo(B),
    "cancel": Cancel(),
}
REFUSED = {
    "IDLE": ["hold", "resume", "cancel"],
    "STARTING": ["start", "hold", "resume", "goto"],
    "FLYING": ["start", "resume", "goto"],
    "HELD": ["start", "hold"],
    "DONE": ["hold", "resume", "cancel"],
}


@pytest.mark.parametrize(
    ("state", "verb"), [(state, verb) for state, verbs in REFUSED.items() for verb in verbs]
)
def test_a_verb_that_does_not_fit_is_refused_and_changes_nothing(state, verb):
    flight = Flight()
    flight.step()
    if state != "IDLE":
        flight.operate(StartMission(Plan((Leg(A, dwell=0.0),))))
    if state not in ("IDLE", "STARTING"):
        flight.step(seconds=0.05)
    if state == "HELD":
        flight.operate(Hold())
    if state == "DONE":
        flight.step(position=A)
    assert flight.state == state
    before = list(flight.said)
    with pytest.raises(BadInputError, match=rf"^{verb}: the mission is {state}; "):
        flight.operate(VERBS[verb])
    assert (flight.state, flight.said) == (state, before)


def test_time_in_hold_is_no_dwell():
    flight = flying()
    flight.guard = GuardState.HOLD
    flight.step(position=A, seconds=2.0)
    assert [event.event for event in flight.events] == ["started"]
    flight.guard = GuardState.TRACK
    flight.step(seconds=0.4)
    assert last_event(flight) == "started"
    flight.step(seconds=0.2)
    assert last_event(flight) == "reached"
