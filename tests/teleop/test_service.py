"""Missions as a service: ids, keys, the queue, the operator's hand, verdicts."""

import pytest

from cloudrc.exposition.table import MISSION_OUTCOMES
from cloudrc.messages import GuardState, Request, Setpoint, Start
from cloudrc.teleop.store import (
    ENDED,
    STATES,
    ConflictError,
    Order,
)
from cloudrc.teleop.wire import Leg, Plan
from tests.teleop.conftest import AWAY, SERVICE_PLAN, A, B, C, ServiceFlight, service_flying

QUICK = Plan((Leg(A, dwell=0.0),), Start.HERE)


def finish(flight):
    for point in (A, B, C):
        flight.step(position=point, seconds=0.05)


def test_a_mission_is_flown_and_every_waypoint_noted_once():
    flight, mission_id = service_flying(name="round")
    finish(flight)
    view = flight.view(mission_id)
    assert (view["id"], view["name"], view["state"]) == ("m1", "round", "done")
    assert flight.names(mission_id) == ["starting", "started", *["reached"] * 3, "done"]
    assert [reached["waypoint"] for reached in view["reached"]] == [0, 1, 2]
    assert [event["id"] for event in view["events"]] == [1, 2, 3, 4, 5, 6]
    assert view["verdict"] == {"outcome": "success", "exit_code": 0, "failures": []}


def test_every_end_of_a_mission_is_counted_under_its_own_name():
    ends = {event for event, state in STATES.items() if state in ENDED}
    assert ends <= set(MISSION_OUTCOMES)


def test_the_same_key_is_answered_with_the_same_mission_for_ever():
    flight, mission_id = service_flying(key="uid")
    assert flight.create(key="uid") == mission_id
    finish(flight)
    assert flight.create(key="uid") == mission_id
    other = Plan((Leg(AWAY),), Start.HERE)
    for order in (Order(other, key="uid"), Order(SERVICE_PLAN, key="uid", contact=True)):
        with pytest.raises(ConflictError, match="'uid' is that of mission m1, with another plan"):
            flight.teleop.create(order, flight.now_ns)
    flight.restart_teleop()
    assert flight.create(key="uid") == mission_id
    assert flight.create(key="another") == "m2"


def test_a_second_mission_is_refused_and_names_the_first():
    flight, mission_id = service_flying()
    with pytest.raises(ConflictError, match="m1 is flying") as refused:
        flight.create()
    assert refused.value.mission == mission_id
    assert list(flight.teleop.book.missions) == [mission_id]


def test_a_queued_mission_starts_when_the_first_has_ended():
    flight, first = service_flying()
    second, third = flight.create(QUICK, queue=True), flight.create(QUICK, queue=True)
    assert flight.teleop.state(0)["queue"] == [second, third]
    assert flight.view(second)["state"] == "queued"
    finish(flight)
    flight.step(position=A, seconds=0.2)
    assert [flight.view(m)["state"] for m in (first, second, third)] == ["done"] * 3
    assert flight.names(second) == ["queued", "starting", "started", "reached", "done"]


def test_between_two_missions_the_robot_is_seen_to_hold():
    """Still on its way, it would be led past the spawn to the second one's first waypoint."""
    flight, first = service_flying()
    second = flight.create(queue=True)
    flight.downlink = False
    finish(flight)
    flight.step(seconds=1.0)
    assert (flight.view(first)["state"], flight.view(second)["state"]) == ("done", "starting")
    assert flight.requests[-1].request is Request.END
    assert flight.setpoints[-1].waypoint == -1
    flight.downlink = True
    flight.step(seconds=0.12)
    assert flight.requests[-1].request is Request.START
    assert flight.setpoints[-1] == Setpoint(A, 0.0, 0)
    assert flight.view(second)["state"] == "flying"


def test_cancelling_a_queued_mission_leaves_the_first_alone():
    flight, first = service_flying()
    second = flight.create(queue=True)
    flight.teleop.cancel(second, flight.now_ns)
    view = flight.view(second)
    assert (view["state"], view["verdict"]["exit_code"]) == ("cancelled", 130)
    assert flight.view(first)["state"] == "flying"
    with pytest.raises(ConflictError, match="has ended"):
        flight.teleop.cancel(second, flight.now_ns)


def test_a_cancelled_mission_is_interrupted_and_the_robot_holds():
    flight, mission_id = service_flying()
    flight.teleop.cancel(mission_id, flight.now_ns)
    flight.step(seconds=0.05)
    view = flight.view(mission_id)
    assert (view["state"], view["verdict"]["outcome"]) == ("cancelled", "interrupted")
    assert flight.guard is GuardState.HOLD
    assert flight.requests[-1].request is Request.END


def test_the_operator_holds_moves_and_resumes():
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    assert flight.view(mission_id)["state"] == "held"
    flight.teleop.go_to(AWAY, 0.5, flight.now_ns)
    flight.step()
    assert flight.setpoints[-1] == Setpoint(AWAY, 0.5, -1)
    flight.teleop.resume(flight.now_ns)
    flight.step()
    assert flight.setpoints[-1].position == B
    assert flight.names(mission_id)[-3:] == ["held", "goto", "resumed"]
    with pytest.raises(ConflictError, match="must be held"):
        flight.teleop.resume(flight.now_ns)


def test_go_to_is_a_mission_of_its_own_if_none_is_under_way():
    flight = ServiceFlight()
    flight.step()
    mission = flight.teleop.go_to(A, 0.0, flight.now_ns)
    flight.step(seconds=0.05)
    with pytest.raises(ConflictError, match="hold or cancel"):
        flight.teleop.go_to(B, 0.0, flight.now_ns)
    flight.step(position=A, seconds=0.6)
    view = flight.view(mission.id)
    assert (view["name"], view["state"], view["verdict"]["exit_code"]) == ("goto", "done", 0)


@pytest.mark.parametrize("verb", ["hold", "resume"])
def test_without_a_mission_there_is_nothing_to_hold(verb):
    with pytest.raises(ConflictError, match="no mission"):
        getattr(ServiceFlight().teleop, verb)(0)


def test_the_setpoint_is_repeated_at_10_hz():
    flight = ServiceFlight()
    flight.step(position=A, seconds=2.0)
    assert len(flight.setpoints) == pytest.approx(20, abs=1)
    assert set(flight.setpoints) == {Setpoint(A)}


@pytest.mark.parametrize(
    ("seen", "code", "exit_code"),
    [
        ({"pipe_contacts": 2}, "pipe_touched", 1),
        ({"touch_speed": 0.3}, "contact_too_fast", 1),
        ({}, "board_not_touched", 1),
        ({"slip_ns": 1_000_000_000, "touch_speed": 0.1}, "not_real_time", 6),
    ],
)
def test_what_the_robot_touched_decides(seen, code, exit_code):
    flight, mission_id = service_flying(contact=True)
    for name, value in seen.items():
        setattr(flight, name, value)
    finish(flight)
    verdict = flight.view(mission_id)["verdict"]
    assert verdict["exit_code"] == exit_code
    assert verdict["failures"][0]["code"] == code


def test_a_gentle_touch_is_a_success_and_noted_when_it_happens():
    flight, mission_id = service_flying(contact=True)
    flight.touch_speed = 0.12
    finish(flight)
    assert flight.view(mission_id)["verdict"]["outcome"] == "success"
    (touch,) = (e for e in flight.view(mission_id)["events"] if e["event"] == "board_touched")
    assert "0.12 m/s" in touch["text"]


def test_it_is_over_when_all_has_ended_and_the_robot_holds():
    flight, _ = service_flying()
    assert not flight.teleop.over
    finish(flight)
    assert flight.teleop.over
