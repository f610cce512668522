"""A teleop that takes over from one that was killed, and what that one had said or not written."""

from argparse import Namespace

import pytest

from cloudrc.cli.teleop import _start
from cloudrc.config.load import load_experiment
from cloudrc.messages import GuardState, OperatorRequest, Request, Start
from cloudrc.teleop.mission import Teleop
from cloudrc.teleop.requests import PREDECESSORS, REPEAT_NS, RequestSender
from cloudrc.teleop.store import ConflictError
from cloudrc.teleop.wire import EmergencyStop, Leg, Pause, Plan, RobotStatus, StartMission
from cloudrc.tunnel.codec import NUMBER_MAX
from tests.teleop.conftest import (
    AWAY,
    FROM_SPAWN,
    ID,
    THREE,
    A,
    B,
    Flight,
    ServiceFlight,
    service_flying,
)


def held_back(flight, number):
    """A start of the teleop before reaches the robot only now."""
    flight._obey(OperatorRequest(number, Request.START, Start.HERE, mission_id=ID))


def test_its_first_number_is_above_that_of_one_that_was_not_seen():
    """Whoever begins later begins higher, though both see a robot that has been asked nothing."""
    numbers = []
    for now_ns in (REPEAT_NS * 5_000, REPEAT_NS * 5_010, 0):
        flight = Flight()
        flight.see()
        repeater = RequestSender()
        repeater.see(flight.teleop._seen, now_ns)
        repeater.ask(Request.END)
        numbers.append(repeater.due(now_ns).number)
    assert numbers == [PREDECESSORS + 5_000, PREDECESSORS + 5_010, PREDECESSORS]


def test_a_start_with_the_stops_number_does_not_confirm_the_stop():
    flight = Flight()
    flight.step()
    flight.downlink = False
    flight.operate(EmergencyStop())
    flight.step(seconds=0.2)
    held_back(flight, flight.mission + 1)
    flight.step(seconds=0.05)
    assert flight.teleop.stopping
    flight.downlink = True
    flight.step(seconds=0.2)
    assert flight.guard is GuardState.ESTOP
    assert flight.teleop.settled


def test_a_start_that_becomes_visible_later_is_ended():
    """Nobody flies that mission any more."""
    flight = Flight()
    flight.teleop = Teleop(ended=lambda number: number == ID)
    flight.step(seconds=0.5)
    assert flight.requests == []
    held_back(flight, 1)
    flight.step(seconds=0.1)
    assert flight.requests[-1].request is Request.END
    assert flight.guard is GuardState.HOLD


def test_the_next_teleop_repeats_an_unacknowledged_stop():
    """The robot may not have heard of it: the link was silent, and then teleop died."""
    flight, mission_id = service_flying()
    waiting = flight.create(queue=True)
    flight.downlink = False
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.2)
    flight.restart_teleop()
    flight.downlink = True
    flight.step(seconds=0.5)
    assert flight.guard is GuardState.ESTOP
    assert flight.view(waiting)["state"] == "queued"
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=0.5)
    assert flight.names(mission_id)[-1] == "acknowledged"
    assert flight.view(mission_id)["state"] == "failed"
    assert flight.view(waiting)["state"] == "flying"


def test_an_early_stop_stops_the_current_mission():
    """It stopped nobody's mission: if the robot did not hear, the next teleop flew on."""
    flight, mission_id = service_flying()
    flight.downlink = False
    flight.restart_teleop()
    assert flight.teleop.stop_rotors(flight.now_ns).id == mission_id
    flight.step(seconds=0.2)
    flight.restart_teleop()
    flight.downlink = True
    flight.step(seconds=0.5)
    assert flight.guard is GuardState.ESTOP
    assert flight.names(mission_id)[-1] == "emergency_stopped"


@pytest.mark.parametrize("since", ["other mission", "other world"])
def test_a_stop_is_not_repeated_after_a_later_flight(since):
    """Somebody has acknowledged it elsewhere, or what flies was not written down."""
    flight, _ = service_flying()
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.2)
    if since == "other world":
        flight.restart()
    else:
        flight.guard, flight.onboard = GuardState.TRACK, (ID, 1)
    asked = len(flight.requests)
    flight.restart_teleop()
    flight.step(seconds=0.5)
    assert Request.ESTOP not in {request.request for request in flight.requests[asked:]}


@pytest.mark.parametrize("since", ["other mission", "other world"])
def test_a_stop_before_first_telemetry_stops_any_flight(since):
    """It was taken for one of the teleop before, which is not asked again of another robot."""
    flight, mission_id = service_flying()
    if since == "other world":
        flight.restart()
    flight.guard, flight.onboard = GuardState.TRACK, (ID, 1)
    flight.restart_teleop()
    assert flight.teleop.stop_rotors(flight.now_ns).id == mission_id
    flight.step(seconds=0.2)
    assert flight.guard is GuardState.ESTOP


def test_a_stop_is_acknowledged_once_the_robot_is_released():
    """Written down before, it would count for a stop that has yet to act."""
    flight, mission_id = service_flying()
    flight.downlink = False
    for ask in (flight.teleop.stop_rotors, flight.teleop.acknowledge):
        ask(flight.now_ns)
        flight.step(seconds=0.2)
    assert flight.names(mission_id)[-1] == "emergency_stopped"
    flight.restart_teleop()
    flight.downlink = True
    flight.step(seconds=0.3)
    assert flight.guard is GuardState.ESTOP
    flight.teleop.acknowledge(flight.now_ns)
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.3)
    assert flight.guard is GuardState.ESTOP
    assert flight.names(mission_id)[-1] == "emergency_stopped"


def test_request_numbers_last_for_a_thousand_restarts():
    seen, now_ns = RobotStatus(1, A, GuardState.GROUND, 0), 10 * 365 * 86_400 * 10**9
    for _ in range(1_000):
        repeater = RequestSender()
        repeater.see(seen, now_ns)
        repeater.ask(Request.END)
        seen = seen._replace(mission=repeater.due(now_ns).number)
    assert seen.mission < NUMBER_MAX / 10


@pytest.mark.parametrize("next_mission", [False, True])
def test_a_stop_that_was_acknowledged_is_not_asked_again(next_mission):
    flight, _ = service_flying()
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.2)
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=0.2)
    if next_mission:
        flight.create()
        flight.step(seconds=0.2)
    asked = len(flight.requests)
    flight.restart_teleop()
    flight.step(seconds=0.5)
    assert Request.ESTOP not in {request.request for request in flight.requests[asked:]}


@pytest.mark.parametrize("state", ["flying", "starting"])
def test_while_pausing_no_waypoint_becomes_the_setpoint(state):
    flight = Flight()
    flight.step()
    flight.downlink = state == "flying"
    flight.operate(StartMission(THREE if state == "flying" else FROM_SPAWN, ID))
    flight.step(seconds=0.05)
    flight.downlink = False
    flight.operate(Pause())
    for point in (A, B):
        flight.step(position=point, seconds=0.1)
    assert flight.setpoints[-1].waypoint == -1


def test_a_held_mission_records_no_resume_after_a_restart():
    """Killed between the two, teleop would fly on in its next life."""
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    flight.restart_teleop()
    flight.step(seconds=0.3)
    assert flight.view(mission_id)["state"] == "held"
    assert "resumed" not in flight.names(mission_id)


def test_what_waits_is_not_begun_before_the_robot_is_seen():
    """It may be latched, and would fail it."""
    flight, _ = service_flying()
    waiting = flight.create(queue=True)
    flight.guard = GuardState.LAND
    flight.step(position=AWAY, seconds=0.2)
    for _ in range(2):
        flight.restart_teleop()
        flight.teleop.handle_deadline(flight.now_ns)
        flight.step(seconds=0.2)
        assert flight.view(waiting)["state"] == "queued"


def test_time_in_which_nobody_looks_is_no_dwell():
    """Two glimpses four seconds apart do not show that the robot stayed there between them."""
    flight = Flight()
    flight.step()
    flight.operate(StartMission(Plan((Leg(A, dwell=2.0),), Start.HERE), ID))
    flight.step(seconds=0.1)
    flight.position = A
    flight.see()
    flight.now_ns += 4_000_000_000
    flight.see()
    assert flight.state == "FLYING"
    flight.step(seconds=2.1)
    assert flight.state == "DONE"


def test_a_restart_with_the_same_options_continues_the_mission():
    flight, flags = ServiceFlight(), Namespace(start=True, mission=None, api=None)
    flight.step()
    assert _start(flags, load_experiment("hover"), flight.teleop)
    (mission_id,) = flight.teleop.book.missions
    flight.restart_teleop()
    assert _start(flags, load_experiment("hover"), flight.teleop)
    assert list(flight.teleop.book.missions) == [mission_id]
    with pytest.raises(ConflictError, match=f"mission {mission_id} is"):
        _start(flags, load_experiment("paper"), flight.teleop)
    flight.teleop.cancel(mission_id, flight.now_ns)
    assert _start(flags, load_experiment("hover"), flight.teleop)
    assert len(flight.teleop.book.missions) == 2
