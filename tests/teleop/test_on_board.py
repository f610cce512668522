"""What the robot knows of missions, whose it is and what is over: nobody flies on against it."""

import pytest

from cloudrc.messages import MISSION_OVER, GuardState, Request
from cloudrc.teleop.wire import Cancel, Continue, EmergencyStop, GoTo, StartMission
from tests.teleop.conftest import AWAY, FROM_SPAWN, ID, THREE, A, B, Flight


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


def test_a_robot_ready_for_another_mission_does_not_take_off():
    flight = Flight()
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.05)
    flight.onboard, flight.guard = (ID + 1, 0), GuardState.GROUND
    flight.step(seconds=0.05)
    assert flight.teleop.outcome.code == "taken_over"
    assert flight.requests[-1].request is Request.END


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


def test_before_its_start_the_old_mission_is_no_takeover():
    flight = Flight()
    flight.onboard = (ID + 1, 3)
    flight.downlink = False
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.3)
    assert (flight.state, flight.events) == ("STARTING", [])


@pytest.mark.parametrize("verb", [Cancel(), EmergencyStop()])
def test_the_robot_learns_that_a_mission_ended_early(verb):
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


def test_a_mission_that_ended_on_board_is_not_continued():
    """Its end was on a disk that took nothing, and with teleop it was lost."""
    flight = Flight()
    flight.onboard = (ID, MISSION_OVER)
    flight.operate(Continue(THREE, 1, 5.0, flight.world, False, ID))
    flight.step(position=AWAY, seconds=0.5)
    assert (flight.state, flight.teleop.outcome.code) == ("FAILED", "end_lost")
    assert flight.teleop.outcome.reached == 1
    assert {request.request for request in flight.requests} == {Request.END}
    assert {setpoint.position for setpoint in flight.setpoints} == {AWAY}


def test_a_restarted_mission_begins_at_its_first_waypoint():
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


@pytest.mark.parametrize("in_sight", [True, False])
@pytest.mark.parametrize("again", [True, False])
def test_a_completed_mission_flies_again_only_if_ordered_anew(again, in_sight):
    """As a second run of `cloudrc cloud` does; but not by a teleop that finds it in its journal."""
    flight = Flight()
    flight.onboard = (ID, len(FROM_SPAWN.legs))
    if in_sight:
        flight.step()
    flight.operate(StartMission(FROM_SPAWN, ID, again))
    flight.step(seconds=0.1)
    assert flight.state == ("FAILED" if again else "FLYING")
    assert (Request.START in {request.request for request in flight.requests}) is not again
