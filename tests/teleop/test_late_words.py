"""Words of predecessors, of rivals and of sessions before: the robot is led by none of them."""

import pytest

from cloudrc.messages import GuardState, OperatorRequest, Request, Setpoint, Start
from cloudrc.teleop.mission import HELD_LOWEST, Teleop
from cloudrc.teleop.requests import REPEAT_NS
from cloudrc.teleop.wire import Acknowledge, Cancel, EmergencyStop, GoTo, Hold, Pause, StartMission
from tests.teleop.conftest import AWAY, FROM_SPAWN, ID, THREE, A, B, C, Flight


@pytest.mark.parametrize("first_sight", [True, False])
def test_a_robot_ready_for_a_lost_mission_does_not_take_off(first_sight):
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
def test_an_operator_request_precedes_ending_a_lost_mission(verb, word):
    flight = Flight()
    flight.operate(verb)
    flight.onboard = (ID, 0)
    flight.step(seconds=0.3)
    ended = [Request.END] if word is Request.ACKNOWLEDGE else []  # a stop ends it, too
    assert [request.request for request in flight.requests] == [word, *ended]


def started():
    flight = Flight()
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.05)
    assert flight.state == "FLYING"
    return flight


def test_a_predecessors_late_end_does_not_stop_the_mission():
    flight = started()
    flight.mission += 1
    flight.guard = GuardState.HOLD
    flight.step(seconds=0.2)
    assert flight.guard is GuardState.TRACK
    assert (flight.requests[-1].request, flight.requests[-1].start) == (Request.START, Start.HERE)
    assert flight.setpoints[-1].waypoint == 0
    assert [event.event for event in flight.events] == ["started"]


@pytest.mark.parametrize("guard", [GuardState.HOLD, GuardState.GROUND])
def test_a_robot_that_waits_during_its_mission_is_restarted(guard):
    """Another cloud's end in another session, or a predecessor's of the same number as ours."""
    flight = started()
    flight.restart_cloud()
    flight.guard = guard
    asked = len(flight.requests)
    flight.step(seconds=2.9)
    assert {r.request for r in flight.requests[asked:]} <= {Request.PROGRESS}
    flight.step(seconds=0.3)
    assert flight.requests[-1][1:3] == (Request.START, Start.HERE)
    assert (flight.guard, flight.state) == (GuardState.TRACK, "FLYING")


def test_a_robot_that_flies_and_rests_by_turns_is_told_nothing():
    flight = started()
    asked = len(flight.requests)
    for _ in range(5):
        flight.guard = GuardState.HOLD
        flight.step(seconds=2.9)
        flight.guard = GuardState.TRACK
        flight.step(seconds=0.02)
    assert flight.requests[asked:] == []


@pytest.mark.parametrize("in_sight", [True, False])
def test_a_mission_from_here_fails_if_another_client_moved_it(in_sight):
    """Whether it was ordered with the robot in sight or before that."""
    flight = Flight()
    flight.onboard, flight.guard = (ID - 1, 3), GuardState.HOLD
    flight.position = AWAY
    if in_sight:
        flight.step()
    flight.downlink = False
    flight.operate(StartMission(THREE, ID))
    flight.step(seconds=0.1)
    flight.restart_cloud()
    flight.onboard, flight.guard = (ID + 1, 1), GuardState.TRACK
    flight.step(position=B, seconds=0.1)
    assert (flight.state, flight.teleop.outcome.code) == ("FAILED", "taken_over")
    assert flight.setpoints[-1].position == B


def test_a_new_stop_cancels_an_earlier_acknowledgement():
    flight = started()
    flight.downlink = False
    for verb in (EmergencyStop(), Acknowledge(), EmergencyStop()):
        flight.operate(verb)
    flight.downlink = True
    flight.step(seconds=0.5)
    assert flight.guard is GuardState.ESTOP


def test_an_acknowledgement_survives_the_first_telemetry():
    flight = Flight()
    flight.operate(EmergencyStop())
    flight.operate(Acknowledge())
    flight.onboard = (ID, 0)
    flight.step(seconds=0.5)
    words = [r.request for r in flight.requests if r.request is not Request.PROGRESS]
    assert words == [Request.ESTOP, Request.ACKNOWLEDGE]
    assert flight.guard is GuardState.GROUND


def test_after_a_foreign_start_the_robot_counts_as_flying():
    flight = started()
    flight.operate(Cancel())
    flight.step(seconds=0.1)
    flight.mission += 1
    flight.guard = GuardState.TRACK  # by a predecessor's late start
    flight.step()
    flight.downlink = False
    flight.operate(StartMission(FROM_SPAWN, ID + 1))
    flight.step(seconds=0.2)
    assert flight.setpoints[-1].position == AWAY


def test_a_setpoint_says_for_which_session_it_is():
    flight = Flight()
    said = []
    for epoch in (1, 2):
        flight.epoch = epoch
        flight.see()
        said += flight.teleop.take_outputs()
    assert [(type(each), each.epoch) for each in said] == [(Setpoint, 1), (Setpoint, 2)]


def test_each_copy_of_a_request_names_the_current_session():
    flight = Flight()
    flight.step()
    flight.operate(StartMission(FROM_SPAWN, ID))
    said = []
    for epoch in (1, 1, 2):
        flight.epoch = epoch
        flight.now_ns += REPEAT_NS
        flight.see()
        flight.teleop.handle_deadline(flight.now_ns)
        said += [each for each in flight.teleop.take_outputs() if isinstance(each, OperatorRequest)]
    assert {each.request for each in said} == {Request.START}
    assert [each.epoch for each in said] == [1, 1, 2]
    assert len({each.number for each in said}) == 1


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


def test_in_a_new_session_a_start_keeps_the_robot_in_place():
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
def test_a_finished_mission_found_flying_is_ended(ended):
    flight = Flight()
    flight.teleop = Teleop(lambda number: ended and number == ID)
    flight.onboard, flight.guard = (ID, 1), GuardState.TRACK
    flight.step(position=AWAY, seconds=0.2)
    assert {request.request for request in flight.requests} == ({Request.END} if ended else set())
    assert flight.setpoints[-1].position == AWAY
