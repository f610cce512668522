"""After a restart: what was known is known, and the mission in flight goes on, or has failed."""

import pytest

from cloudrc.messages import MISSION_OVER, GuardState, Request, Start
from cloudrc.teleop.store import SHOWN, ConflictError
from tests.teleop.conftest import AWAY, B, C, ServiceFlight, service_flying


def test_after_a_restart_the_mission_continues_at_its_waypoint():
    flight, mission_id = service_flying(key="uid")
    flight.step(position=AWAY, seconds=5.0)
    flight.restart_teleop()
    flight.step(seconds=0.05)
    assert flight.view(mission_id)["state"] == "flying"
    assert (flight.requests[-1].request, flight.requests[-1].start) == (Request.START, Start.HERE)
    assert flight.setpoints[-1].position == B
    assert flight.create(key="uid") == mission_id
    for point in (B, C):
        flight.step(position=point, seconds=0.05)
    view = flight.view(mission_id)
    assert [reached["waypoint"] for reached in view["reached"]] == [0, 1, 2]
    assert view["verdict"]["exit_code"] == 0
    assert flight.names(mission_id).count("started") == 1


def test_a_mission_before_take_off_survives_a_teleop_restart():
    """The new teleop sees a robot that stands, told of a mission, before it takes that up."""
    flight, mission_id = service_flying()
    flight.guard = GuardState.GROUND
    before = len(flight.requests)
    flight.restart_teleop()
    flight.see()
    flight.step(seconds=0.3)
    assert flight.view(mission_id)["state"] == "flying"
    assert {request.request for request in flight.requests[before:]} == {Request.START}


def test_a_cancel_right_after_a_restart_is_a_cancel_in_flight():
    flight, mission_id = service_flying()
    flight.restart_teleop()
    flight.teleop.cancel(mission_id, flight.now_ns)
    flight.step(seconds=0.3)
    assert flight.view(mission_id)["state"] == "cancelled"
    assert "before it began" not in flight.view(mission_id)["events"][-1]["text"]
    assert flight.onboard[1] == MISSION_OVER
    assert flight.guard is GuardState.HOLD


def test_slip_before_a_restart_does_not_invalidate_a_mission():
    """Neither do the seconds count that were flown since the last entry."""
    flight, mission_id = service_flying()
    flight.step(seconds=10.0)
    flight.slip_ns = 300_000_000
    flight.step(seconds=0.1)
    flight.restart_teleop()
    flight.slip_ns = 600_000_000
    for point in (B, C):
        flight.step(position=point, seconds=0.1)
    assert flight.view(mission_id)["verdict"]["outcome"] == "success"


def test_who_is_asked_to_end_leaves_what_waits_to_its_successor():
    flight, first = service_flying()
    second = flight.create(queue=True)
    flight.step(position=B, seconds=0.05)
    flight.teleop.pause(flight.now_ns)
    flight.step(position=C, seconds=0.5)
    assert flight.view(first)["state"] == "done"
    assert flight.view(second)["state"] == "queued"
    flight.restart_teleop()
    flight.step(seconds=0.3)
    assert flight.view(second)["state"] == "flying"


def test_a_new_pod_goes_on_at_the_same_waypoint():
    """Cloud and teleop are new: a new epoch, requests counted from 0 again, the same world."""
    flight, mission_id = service_flying()
    flight.restart_cloud()
    flight.restart_teleop()
    flight.step(seconds=0.05)
    assert flight.view(mission_id)["state"] == "flying"
    assert flight.view(mission_id)["waypoint"] == 1
    assert "resumed" in flight.names(mission_id)


def test_cloud_alone_restarts_and_nothing_is_asked_of_the_robot():
    flight, mission_id = service_flying()
    asked = [r for r in flight.requests if r.request is not Request.PROGRESS]
    flight.restart_cloud()
    flight.step(seconds=0.2)
    assert flight.view(mission_id)["state"] == "flying"
    assert [r for r in flight.requests if r.request is not Request.PROGRESS] == asked


@pytest.mark.parametrize("teleop_too", [False, True])
def test_a_world_that_restarts_fails_the_mission(teleop_too):
    flight, mission_id = service_flying()
    flight.restart()
    if teleop_too:
        flight.restart_teleop()
    flight.step(seconds=0.05)
    view = flight.view(mission_id)
    assert view["state"] == "failed"
    assert view["verdict"]["exit_code"] == 1
    assert view["verdict"]["failures"][0]["code"] == "world_restarted"


def test_a_cancel_does_not_hide_a_failure_by_world_restart():
    flight, mission_id = service_flying()
    flight.restart()
    flight.restart_teleop()
    flight.see()
    with pytest.raises(ConflictError, match=f"mission {mission_id} has ended: failed"):
        flight.teleop.cancel(mission_id, flight.now_ns)
    view = flight.view(mission_id)
    assert (view["state"], view["events"][-1]["event"]) == ("failed", "world_restarted")
    assert view["verdict"]["failures"][0]["code"] == "world_restarted"


def test_an_unstarted_mission_starts_in_the_new_world():
    flight = ServiceFlight()
    flight.step()
    flight.downlink = False
    mission_id = flight.create()
    flight.step(seconds=0.2)
    flight.restart()
    flight.restart_teleop()
    flight.downlink = True
    flight.step(seconds=0.05)
    assert flight.view(mission_id)["state"] == "flying"
    assert flight.requests[-1].start is Start.SPAWN


def test_a_held_mission_stays_held():
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    flight.restart_teleop()
    before = len(flight.setpoints)
    flight.step(position=AWAY, seconds=0.1)
    assert flight.view(mission_id)["state"] == "held"
    assert {setpoint.position for setpoint in flight.setpoints[before:]} == {AWAY}
    flight.teleop.resume(flight.now_ns)
    flight.step()
    assert flight.setpoints[-1].position == B


def test_a_stop_is_known_though_its_event_is_not_kept():
    flight, mission_id = service_flying()
    flight.teleop.stop_rotors(flight.now_ns)
    for _ in range(SHOWN):
        flight.teleop.book.note(flight.teleop.book.find(mission_id), "new_session", "")
    assert flight.names(mission_id) == ["new_session"] * SHOWN
    assert flight.stored().stopped().id == mission_id


def test_a_held_mission_stays_held_through_two_restarts():
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    flight.restart_teleop()
    flight.teleop.handle_deadline(flight.now_ns)  # and again, before the robot was seen
    flight.restart_teleop()
    flight.step(seconds=0.05)
    assert flight.view(mission_id)["state"] == "held"


def test_time_goes_on_where_it_stood():
    flight, mission_id = service_flying()
    flight.step(position=AWAY, seconds=10.0)
    flight.step(position=B)  # noted at 10 s
    flight.restart_teleop()
    flight.step(position=AWAY, seconds=0.05)
    elapsed = flight.view(mission_id)["events"][-1]["time_s"]
    assert elapsed == pytest.approx(10.1, abs=0.1)
    flight.step(seconds=50.0)
    assert flight.view(mission_id)["verdict"]["failures"][0]["code"] == "timed_out"


def test_a_robot_never_seen_again_fails_the_mission():
    flight, mission_id = service_flying()
    flight.uplink = False
    flight.restart_teleop()
    flight.step(seconds=61.0)
    assert flight.view(mission_id)["state"] == "failed"


def test_a_pipe_touched_while_teleop_was_away_counts():
    flight, mission_id = service_flying()
    flight.restart_teleop()
    flight.pipe_contacts = 1
    flight.step(seconds=0.05)
    for point in (B, C):
        flight.step(position=point, seconds=0.05)
    failures = flight.view(mission_id)["verdict"]["failures"]
    assert [failure["code"] for failure in failures] == ["pipe_touched"]


def test_a_queue_survives_and_nothing_new_slips_in():
    flight, first = service_flying()
    second = flight.create(queue=True)
    flight.restart_teleop()
    with pytest.raises(ConflictError):
        flight.create()
    flight.step(seconds=0.05)
    assert flight.view(first)["state"] == "flying"
    assert flight.view(second)["state"] == "queued"


def test_a_crash_after_the_last_waypoint_completes_the_mission():
    flight, mission_id = service_flying()
    for point in (B, C):
        flight.step(position=point, seconds=0.05)
    while flight.kept[-1]["event"] != "reached":
        flight.images.pop()
    flight.restart_teleop()
    flight.step(position=C, seconds=0.1)
    assert flight.view(mission_id)["state"] == "done"
