"""A teleop that has been asked to end: it begins nothing, and what is ordered is not lost."""

import pytest
from service_harness import ServiceFlight, flying
from teleop_harness import AWAY, B, C

from cloudrc.cloud.teleop.service_book import ConflictError, UnavailableError
from cloudrc.messages import GuardState, Request


def idle():
    flight = ServiceFlight()
    flight.step()
    return flight


def done():
    flight, _ = flying()
    for point in (B, C):
        flight.step(position=point, seconds=0.1)
    return flight


def held():
    flight, _ = flying()
    flight.teleop.hold(flight.now_ns)
    return flight


@pytest.mark.promise("P-MISSION-4")
@pytest.mark.parametrize("before", [idle, done])
def test_what_is_ordered_while_teleop_ends_is_flown_by_its_successor(before):
    flight = before()
    flight.teleop.pause(flight.now_ns)
    asked = len(flight.requests)
    mission_id = flight.create(key="uid")
    flight.step(seconds=0.5)
    assert flight.view(mission_id)["state"] == "queued"
    assert "the next teleop" in flight.view(mission_id)["events"][-1]["text"]
    assert Request.START not in {request.request for request in flight.requests[asked:]}
    flight.restart_teleop()
    assert flight.create(key="uid") == mission_id
    flight.step(seconds=0.3)
    assert flight.view(mission_id)["state"] == "flying"


def test_a_second_order_then_is_like_one_behind_any_other():
    flight = idle()
    flight.teleop.pause(flight.now_ns)
    first = flight.create()
    with pytest.raises(ConflictError, match=f"mission {first} is queued"):
        flight.create()
    second = flight.create(queue=True)
    flight.teleop.cancel(first, flight.now_ns)
    flight.restart_teleop()
    flight.step(seconds=0.3)
    assert [flight.view(each)["state"] for each in (first, second)] == ["cancelled", "flying"]


@pytest.mark.parametrize("before", [idle, done, held])
def test_a_point_to_go_to_is_refused_while_teleop_ends(before):
    """The next teleop would lead the robot there whenever it comes."""
    flight = before()
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.2)
    kept = list(flight.kept)
    with pytest.raises(UnavailableError, match="teleop ends"):
        flight.teleop.go_to(AWAY, 0.0, flight.now_ns)
    flight.step(seconds=0.2)
    assert flight.kept == kept
    assert AWAY not in {setpoint.position for setpoint in flight.setpoints}


def test_a_teleop_that_ends_still_stops_the_rotors_and_releases_the_robot():
    flight, _ = flying()
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.1)
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.1)
    assert flight.guard is GuardState.ESTOP
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=0.1)
    assert flight.guard is GuardState.GROUND
