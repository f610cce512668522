"""Emergency stop and acknowledgement: they reach the robot, and nothing passes them by."""

from types import SimpleNamespace

import pytest

from cloudrc.drivers.teleop import turn
from cloudrc.errors import BadInputError
from cloudrc.messages import GuardState, Request
from cloudrc.teleop import wire
from cloudrc.teleop.bridge import Bridge
from cloudrc.teleop.store import ConflictError
from cloudrc.teleop.wire import ALARM, Acknowledge, EmergencyStop, GoTo, Pause, StartMission
from tests.teleop.conftest import AWAY, SERVICE_PLAN, B, Flight, ServiceFlight, service_flying
from tests.teleop.conftest import flying as machine_flying


def asked(flight):
    return [r.request for r in flight.requests if r.request is not Request.PROGRESS]


def test_a_flight_is_stopped_and_its_mission_has_failed():
    flight, mission_id = service_flying()
    mission = flight.teleop.stop_rotors(flight.now_ns)
    assert mission.id == mission_id
    flight.step(seconds=0.05)
    assert flight.guard is GuardState.ESTOP
    view = flight.view(mission_id)
    assert (view["state"], view["verdict"]["exit_code"]) == ("failed", 1)
    assert view["verdict"]["failures"][0]["code"] == "emergency_stopped"
    assert "emergency stop on the way to waypoint 2 of 3" in str(view["events"])
    assert flight.teleop.settled


def test_it_leaves_at_once_and_is_told_until_it_is_seen():
    """Cloud gives it a number, above all others, and repeats it towards the robot."""
    flight = machine_flying()
    flight.uplink = False
    flight.operate(EmergencyStop())
    flight.teleop.handle_deadline(flight.now_ns)
    assert ALARM in flight.teleop.take_outputs()
    flight.step(seconds=1.0)
    assert 10 <= flight.said.count(ALARM) <= 11
    flight.uplink = True
    flight.step(seconds=0.5)
    assert flight.said.count(ALARM) <= 11
    assert flight.guard is GuardState.ESTOP


def test_without_a_mission_it_is_asked_all_the_same():
    flight = ServiceFlight()
    flight.step()
    assert flight.teleop.stop_rotors(flight.now_ns) is None
    flight.step(seconds=0.05)
    assert flight.guard is GuardState.ESTOP
    assert asked(flight) == [Request.ESTOP]


@pytest.mark.parametrize("stops", [1, 2])
def test_after_a_stall_the_stop_belongs_to_the_stopped_mission(stops):
    """Past teleop's loop: it saw the robot stopped, and that was why the mission had failed."""
    (flight, mission_id), bridge = service_flying(), Bridge()
    bridge.open(flight.teleop)
    asked = [
        bridge.submit(lambda service, now_ns: service.stop_rotors(now_ns), "stop")
        for _ in range(stops)
    ]
    looked = bridge.submit(lambda service, now_ns: service.state(now_ns)["seen"]["guard"])
    flight.guard = GuardState.ESTOP
    cloud = SimpleNamespace(receive=lambda: [wire.encode(flight.seen)])
    take, now_ns = bridge.take, flight.now_ns + 5_000_000_000
    blind = {"blind": 2, "late_ns": 0, "now_ns": now_ns}
    turn(flight.teleop, cloud, wire.decode, take, stops=bridge.take_urgent, **blind)
    assert {each.result().id for each in asked} == {mission_id}, "all are one stop"
    assert looked.result() == "ESTOP", "what is no stop is asked of the present"
    flight.step(seconds=0.1)
    assert flight.names(mission_id)[-1] == "emergency_stopped"
    assert flight.teleop.settled


@pytest.mark.promise("emergency-stop-gets-through")
def test_nothing_supersedes_it():
    flight = machine_flying()
    flight.downlink = False
    flight.operate(EmergencyStop())
    flight.step(seconds=0.2)
    count = len(flight.requests)
    flight.operate(GoTo((1.0, 0.0, 1.0)))
    flight.step(seconds=1.0)
    assert {r.request for r in flight.requests[count:]} == {Request.ESTOP}
    flight.downlink = True
    flight.step(seconds=0.3)
    assert flight.guard is GuardState.ESTOP  # and the mission that wanted to start has failed
    assert flight.teleop.outcome.code == "guard_stopped"


def test_no_mission_starts_before_the_stop_is_acknowledged():
    flight, _ = service_flying()
    queued = flight.create(queue=True)
    flight.downlink = False
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.2)
    with pytest.raises(ConflictError, match="an emergency stop is on its way to the robot; find"):
        flight.create(queue=True)
    flight.downlink = True
    flight.step(seconds=0.2)
    why = r"the guard is in ESTOP \(emergency stop\) and lets nothing fly"
    with pytest.raises(ConflictError, match=why):
        flight.create(queue=True)
    assert flight.view(queued)["state"] == "queued"
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=0.3)
    assert flight.view(queued)["state"] == "flying"


def test_an_acknowledgement_waits_for_what_was_asked_before():
    flight = machine_flying()
    flight.downlink = False
    flight.operate(EmergencyStop())
    flight.operate(Acknowledge())
    flight.operate(Acknowledge())
    flight.downlink = True
    flight.step(seconds=0.3)
    assert asked(flight)[-2:] == [Request.ESTOP, Request.ACKNOWLEDGE]
    assert flight.guard is GuardState.GROUND
    assert flight.teleop.settled


def test_in_a_mission_there_is_nothing_to_acknowledge():
    flight, mission_id = service_flying()
    with pytest.raises(ConflictError, match=f"mission {mission_id} is flying; there is nothing"):
        flight.teleop.acknowledge(flight.now_ns)
    with pytest.raises(BadInputError, match="acknowledge: the mission is FLYING"):
        machine_flying().operate(Acknowledge())


def test_a_landed_robot_flies_again_once_acknowledged():
    flight, mission_id = service_flying()
    flight.guard = GuardState.LAND
    flight.step(seconds=0.05)
    assert flight.view(mission_id)["verdict"]["failures"][0]["code"] == "guard_stopped"
    with pytest.raises(ConflictError, match="the guard is in LAND"):
        flight.create()
    with pytest.raises(ConflictError, match="guard is in LAND"):
        flight.teleop.go_to(AWAY, 0.0, flight.now_ns)
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=0.3)
    second = flight.create()
    flight.step(seconds=0.1)
    assert flight.view(second)["state"] == "flying"


def test_teleop_pauses_at_shutdown_and_its_successor_continues():
    flight, mission_id = service_flying()
    flight.teleop.pause(flight.now_ns)
    assert flight.kept[-1]["event"] == "paused"
    assert flight.kept[-1]["text"].startswith("paused by shutdown on the way to waypoint 2 of 3")
    flight.step(seconds=0.05)
    assert asked(flight)[-1] is Request.END
    assert flight.guard is GuardState.HOLD
    assert flight.teleop.settled
    flight.restart_teleop()
    flight.step(seconds=0.1)
    assert flight.view(mission_id)["state"] == "flying"
    assert flight.setpoints[-1].position == B


@pytest.mark.parametrize("guard", [GuardState.LAND, GuardState.ESTOP])
@pytest.mark.parametrize("begun", [0, 1], ids=["starting", "flying"])
def test_a_landing_without_teleop_fails_the_mission(guard, begun):
    flight = ServiceFlight()
    flight.downlink = bool(begun)
    mission_id = flight.create()
    flight.step(seconds=0.1)
    assert flight.view(mission_id)["state"] == ("flying" if begun else "starting")
    waits = flight.create(queue=True)
    flight.guard = guard
    flight.restart_teleop()
    flight.see()  # before teleop does anything
    flight.step(seconds=0.2)
    failure, *_ = flight.view(mission_id)["verdict"]["failures"]
    assert failure["code"] == "guard_stopped"
    assert flight.view(waits)["state"] == "queued"


def test_without_a_mission_there_is_nothing_to_pause():
    flight = ServiceFlight()
    flight.step()
    flight.teleop.pause(flight.now_ns)
    assert flight.requests == []
    with pytest.raises(BadInputError, match="pause: the mission is IDLE"):
        Flight().teleop.operate(Pause(), 0)


def test_a_start_that_is_refused_on_board_fails_the_mission():
    flight = Flight()
    flight.guard = GuardState.ESTOP
    flight.step()
    flight.operate(StartMission(SERVICE_PLAN))
    flight.step(seconds=0.1)
    assert flight.teleop.outcome.code == "guard_stopped"
