"""What the robot knows of missions, whose it is and what is over: nobody flies on against it."""

import pytest
from teleop_harness import AWAY, A, B, C, Flight

from cloudrc.cloud.teleop.messages import (
    Acknowledge,
    Cancel,
    Continue,
    EmergencyStop,
    GoTo,
    Hold,
    Pause,
    StartMission,
)
from cloudrc.cloud.teleop.mission import Teleop
from cloudrc.cloud.teleop.mission_rules import HELD_LOWEST
from cloudrc.cloud.teleop.plan import Leg, Plan
from cloudrc.messages import MISSION_OVER, GuardState, Request, Start

ID = 7
THREE = Plan((Leg(A, dwell=0.0), Leg(B, dwell=0.0), Leg(C, dwell=0.0)), Start.HERE)
FROM_SPAWN = Plan(THREE.legs)


@pytest.mark.promise("P-MISSION-8")
@pytest.mark.parametrize("onboard", [(0, 3), (ID + 1, 0), (ID + 1, 3)])
def test_who_finds_another_mission_on_board_does_not_fly_on(onboard):
    """Another cloud has had the robot, and has moved it: the way to the next waypoint is not free.

    What the robot knows of that mission does not count for this one.
    """
    flight = Flight()
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.05)
    flight.onboard = onboard
    flight.step(seconds=0.3)
    assert (flight.state, flight.teleop.leg) == ("FAILED", 0)
    assert flight.teleop.outcome.code == "taken_over"
    assert flight.setpoints[-1].position == AWAY
    asked = [r.request for r in flight.requests if r.request is not Request.PROGRESS]
    assert asked == [Request.START], "what is not its own it does not end"


def test_a_robot_that_stands_ready_for_somebody_else_does_not_take_off():
    flight = Flight()
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.05)
    flight.onboard, flight.guard = (ID + 1, 0), GuardState.GROUND
    flight.step(seconds=0.05)
    assert flight.teleop.outcome.code == "taken_over"
    assert flight.requests[-1].request is Request.END


@pytest.mark.parametrize("first_sight", [True, False])
def test_a_robot_that_stands_ready_for_a_mission_lost_here_does_not_take_off(first_sight):
    """Its order was in a journal that rotted; or it arrives when nobody knows of it any more."""
    flight = Flight()
    if not first_sight:
        flight.step()
        flight.epoch += 1
    flight.onboard = (ID, 0)
    flight.step(seconds=0.05)
    assert [request.request for request in flight.requests] == [Request.END]
    assert flight.setpoints[-1].position == (0.0, 0.0, HELD_LOWEST)
    assert flight.teleop.settled


@pytest.mark.parametrize(
    ("onboard", "guard"),
    [((0, 0), GuardState.GROUND), ((ID, 0), GuardState.HOLD), ((ID, 0), GuardState.TRACK)],
)
def test_a_robot_that_flies_or_stands_for_nobody_is_told_nothing(onboard, guard):
    flight = Flight()
    flight.onboard, flight.guard = onboard, guard
    flight.step(seconds=0.05)
    assert flight.requests == []


@pytest.mark.parametrize(
    ("verb", "word"), [(EmergencyStop(), Request.ESTOP), (Acknowledge(), Request.ACKNOWLEDGE)]
)
def test_the_operators_word_comes_before_the_end_of_what_was_lost(verb, word):
    flight = Flight()
    flight.operate(verb)
    flight.onboard = (ID, 0)
    flight.step(seconds=0.3)
    assert [request.request for request in flight.requests] == [word, Request.END]


def started():
    flight = Flight()
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.05)
    assert flight.state == "FLYING"
    return flight


def test_a_predecessors_end_that_comes_late_does_not_keep_the_robot_from_its_mission():
    flight = started()
    flight.mission += 1
    flight.guard = GuardState.HOLD
    flight.step(seconds=0.2)
    assert flight.guard is GuardState.TRACK
    assert (flight.requests[-1].request, flight.requests[-1].start) == (Request.START, Start.HERE)
    assert flight.setpoints[-1].waypoint == 0
    assert [event.event for event in flight.events] == ["started"]


@pytest.mark.parametrize("verb", [Cancel(), EmergencyStop(), Pause()])
def test_who_has_ended_its_mission_does_not_start_again(verb):
    flight = started()
    flight.operate(verb)
    flight.step(seconds=0.2)
    asked = len(flight.requests)
    flight.mission += 1
    flight.guard = GuardState.HOLD
    flight.step(seconds=0.3)
    assert flight.requests[asked:] == []


def test_an_emergency_stop_by_somebody_else_is_not_undone():
    flight = started()
    flight.mission += 1
    flight.guard = GuardState.ESTOP
    flight.step(seconds=0.3)
    assert flight.teleop.outcome.code == "guard_stopped"
    assert [r.request for r in flight.requests if r.request is not Request.PROGRESS] == [
        Request.START,
        Request.END,
    ]
    assert flight.guard is GuardState.ESTOP


def test_cloud_is_told_the_setpoint_again_in_every_session():
    flight = started()
    told = flight.setpoints[-1]
    flight.restart_cloud()
    flight.step()
    assert flight.setpoints[-2:] == [told, told]
    flight.step()
    assert flight.setpoints.count(told) == 2


def test_the_point_where_the_robot_is_held_is_told_again_too():
    flight = started()
    flight.operate(Hold())
    flight.operate(GoTo(C))
    flight.restart_cloud()
    flight.step(position=A)
    assert [setpoint.position for setpoint in flight.setpoints[-2:]] == [C, C]


def test_in_another_session_a_start_has_the_robot_stay_until_it_is_seen_to_wait():
    """Somebody else has had it in between, and has left it armed elsewhere."""
    flight = Flight()
    flight.step()
    flight.downlink = False
    flight.operate(StartMission(FROM_SPAWN, ID))
    flight.step(seconds=0.05)
    assert flight.setpoints[-1].position == A
    flight.restart_cloud()
    flight.onboard, flight.guard = (ID + 1, 3), GuardState.TRACK
    flight.step(position=AWAY, seconds=0.3)
    assert (flight.state, flight.setpoints[-1].position) == ("STARTING", AWAY)
    flight.downlink = True
    flight.step(seconds=0.3)
    assert (flight.state, flight.setpoints[-1].position) == ("FLYING", A)


def test_an_acknowledgement_does_not_tell_that_the_robot_waits():
    """One that flies on, for a mission that is lost here, would leave for the next one's point."""
    flight = Flight()
    flight.onboard, flight.guard = (ID + 1, 2), GuardState.TRACK
    flight.step(position=AWAY)
    flight.operate(Acknowledge())
    flight.step(seconds=0.2)
    flight.downlink = False
    flight.operate(StartMission(FROM_SPAWN, ID))
    flight.step(seconds=0.2)
    assert flight.setpoints[-1].position == AWAY


@pytest.mark.parametrize("ended", [True, False])
def test_who_finds_a_mission_flown_that_is_known_to_be_over_ends_it(ended):
    flight = Flight()
    flight.teleop = Teleop(lambda number: ended and number == ID)
    flight.onboard, flight.guard = (ID, 1), GuardState.TRACK
    flight.step(position=AWAY, seconds=0.2)
    assert {request.request for request in flight.requests} == ({Request.END} if ended else set())
    assert flight.setpoints[-1].position == AWAY


def test_a_robot_on_the_ground_may_have_been_told_to_start():
    """Until it is seen to have heard of the end, too, nothing leads it away."""
    flight = Flight()
    flight.step()
    flight.operate(StartMission(FROM_SPAWN, ID))
    flight.downlink = False
    flight.operate(Cancel())
    flight.step(seconds=0.2)
    flight.operate(StartMission(FROM_SPAWN, ID + 1))
    flight.step(seconds=0.2)
    assert (flight.guard, flight.setpoints[-1].waypoint) == (GuardState.GROUND, -1)
    flight.downlink = True
    flight.step(seconds=0.2)
    assert (flight.state, flight.setpoints[-1].waypoint) == ("FLYING", 0)


def test_a_mission_goes_on_with_its_robot_only():
    flight = Flight()
    flight.onboard, flight.guard = (ID + 1, 0), GuardState.HOLD
    flight.step(position=AWAY)
    flight.operate(Continue(THREE, 1, 5.0, flight.world, False, ID))
    flight.step(seconds=0.3)
    assert flight.teleop.outcome.code == "taken_over"
    assert flight.requests == []


def test_before_its_start_is_seen_the_mission_before_it_is_on_board():
    flight = Flight()
    flight.onboard = (ID + 1, 3)
    flight.downlink = False
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.3)
    assert (flight.state, flight.events) == ("STARTING", [])


@pytest.mark.parametrize("verb", [Cancel(), EmergencyStop()])
def test_the_robot_is_told_that_a_mission_is_over_before_all_is_reached(verb):
    flight = Flight()
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.05)
    flight.downlink = False
    flight.operate(verb)
    flight.step(seconds=0.5)
    flight.downlink = True
    flight.step(seconds=0.2)
    assert flight.onboard == (ID, MISSION_OVER)


def test_a_mission_that_the_robot_knows_to_be_over_is_not_taken_up_again():
    """Its end was on a disk that took nothing, and with teleop it was lost."""
    flight = Flight()
    flight.onboard = (ID, MISSION_OVER)
    flight.operate(Continue(THREE, 1, 5.0, flight.world, False, ID))
    flight.step(position=AWAY, seconds=0.5)
    assert (flight.state, flight.teleop.outcome.code) == ("FAILED", "end_lost")
    assert flight.teleop.outcome.reached == 1
    assert {request.request for request in flight.requests} == {Request.END}
    assert {setpoint.position for setpoint in flight.setpoints} == {AWAY}


def test_a_mission_that_begins_anew_begins_with_its_first_waypoint():
    """That it had been started before was on a disk that took nothing; the robot knows it."""
    flight = Flight()
    flight.onboard, flight.guard = (ID, 2), GuardState.HOLD
    flight.step(position=B)
    flight.operate(StartMission(FROM_SPAWN, ID))
    flight.step(seconds=0.1)
    assert (flight.state, flight.teleop.leg, flight.onboard) == ("FLYING", 0, (ID, 0))
    assert {s.waypoint for s in flight.setpoints} == {-1, 0}


def test_missions_without_a_number_follow_each_other():
    flight = Flight()
    for point in (A, B):
        flight.step(position=AWAY)
        flight.operate(GoTo(point))
        flight.step(seconds=0.05)
        assert flight.state == "FLYING"
        flight.operate(Cancel())
        flight.step(seconds=0.3)
    assert flight.onboard == (0, 0)
