"""The mission machine: each transition, each early end, and who may move the robot."""

import pytest

from cloudrc.messages import GuardState, Request, Setpoint, Start
from cloudrc.teleop.mission import HELD_LOWEST
from cloudrc.teleop.wire import Leg, Plan
from tests.teleop.conftest import AWAY, FROM_SPAWN, ID, PLAN, THREE, A, B, C, Flight, asked, flying

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
AT_ONCE = Plan((Leg(A, dwell=0.0),))


def last_event(flight):
    return flight.events[-1].event


def test_the_old_world_does_not_confirm_a_start_from_spawn():
    flight = Flight()
    flight.step()
    flight.operate("start", PLAN)
    flight.downlink = False
    flight.step()
    flight.mission = flight.requests[0].number  # a predecessor's word, by chance of this number
    flight.step(seconds=0.15)
    assert (flight.state, flight.events) == ("STARTING", [])
    assert flight.requests[-1].number == flight.requests[0].number + 1
    flight.downlink = True
    flight.step(seconds=0.15)
    assert (flight.state, flight.epoch) == ("FLYING", 2)


def test_a_mission_flies_its_legs_in_order_and_ends_in_a_hold():
    flight = flying()
    assert (flight.requests[0].request, flight.requests[0].start) == (Request.START, Start.SPAWN)
    assert (
        flight.events[0].text
        == "mission started from the spawn, waypoints: 3, judged by the measured position"
    )
    flight.step(position=A, seconds=0.6)
    assert flight.events[-1].text == "waypoint 1 of 3 reached at 0.52 s"
    assert flight.setpoints[-1] == Setpoint(B, 0.0, 1)
    flight.step(position=B, seconds=0.02)
    assert flight.setpoints[-1] == Setpoint(C, 0.0, 2)
    there = (3.05, 0.0, 1.0)
    flight.step(position=there, seconds=0.7)
    assert flight.setpoints[-1] == Setpoint(there, 0.0, -1)
    assert [event.event for event in flight.events] == ["started", *["reached"] * 3, "done"]
    assert [event.waypoint for event in flight.events] == [0, 0, 1, 2, 2]
    assert (flight.state, flight.guard) == ("DONE", HOLD)


@pytest.mark.parametrize("away", [(1.11, 0.0, 1.0), (1.07, 0.07, 1.07)])
def test_dwell_starts_again_outside_of_the_tolerance(away):
    flight = flying()
    flight.step(position=A, seconds=0.45)
    flight.step(position=away)
    flight.step(position=A, seconds=0.45)
    assert last_event(flight) == "started"
    flight.step(position=A, seconds=0.06)
    assert last_event(flight) == "reached"


def test_legs_of_infinite_tolerance_last_their_dwell_time():
    flight = flying(Plan(tuple(Leg(at, tolerance=float("inf"), dwell=0.4) for at in (A, B, C))))
    flight.step(position=AWAY, seconds=1.3)
    first, second, third = (e.stamp_ns for e in flight.events if e.event == "reached")
    assert (second - first, third - second) == (400_000_000, 400_000_000)
    assert flight.state == "DONE"


def test_time_in_hold_or_unseen_is_no_dwell():
    flight = flying()
    flight.guard = HOLD
    flight.step(position=A, seconds=2.0)
    flight.guard = TRACK
    flight.step(seconds=0.4)
    flight.now_ns += 4_000_000_000  # two glimpses do not show that it stayed there
    flight.see()
    assert last_event(flight) == "started"
    flight.step(seconds=0.6)
    assert last_event(flight) == "reached"


# Early ends


def assert_failed(flight, code, text):
    outcome = flight.teleop.outcome
    assert (flight.state, outcome.event, outcome.text) == ("FAILED", code, text)
    assert (flight.events[-1].event, flight.events[-1].text) == (code, text)
    assert flight.setpoints[-1].waypoint == -1
    flight.step(seconds=0.05)
    assert flight.requests[-1].request is Request.END


def test_a_leg_that_takes_too_long_fails_the_mission():
    """Neither the time before take-off counts, nor that in which the mission is held."""
    flight = flying(Plan((Leg(A, dwell=0.0), Leg(B, time_limit=2.0)), time_limit=60.0))
    flight.step(position=A)
    flight.step(position=AWAY, seconds=0.5)
    flight.guard = GROUND
    flight.step(seconds=2.5)
    flight.guard = TRACK
    flight.operate("hold")
    flight.step(seconds=10.0)
    flight.operate("resume")
    flight.step(seconds=1.4)
    assert flight.state == "FLYING"
    flight.step(seconds=0.2)
    assert_failed(flight, "leg_timed_out", "waypoint 2 of 2 not reached in 2 s")
    assert flight.events[-1].waypoint == 1


def test_no_robot_is_held_where_it_would_scrape_along_the_floor():
    flight = flying()
    flight.step(position=(0.2, 0.1, 0.12))
    for verb in ("hold", "cancel"):
        flight.operate(verb)
        assert flight.setpoints[-1] == Setpoint((0.2, 0.1, HELD_LOWEST), 0.3, -1)


# The first setpoint: an armed robot flies to it at once


@pytest.fixture
def ended():
    """A mission is done, but its end has not reached the robot, which tracks on."""
    flight = flying(AT_ONCE)
    flight.downlink = False
    flight.step(position=A)
    assert (flight.state, flight.guard) == ("DONE", TRACK)
    return flight


@pytest.mark.parametrize("acted_on", [None, False, True])
def test_a_robot_seen_to_hold_gets_the_first_waypoint_at_once(ended, acted_on):
    """Not after a request between end and start, which may have taken effect."""
    ended.downlink = True
    ended.step(seconds=0.15)
    assert ended.guard is HOLD
    if acted_on is not None:
        ended.operate("start", Plan((Leg(B),), Start.HERE))
        ended.uplink, ended.downlink = False, acted_on
        ended.step(seconds=0.15)
        ended.downlink = False
        ended.operate("cancel")
        ended.uplink = True
        ended.step(seconds=0.15)
    before = len(ended.setpoints)
    ended.operate("start", PLAN)
    assert ended.setpoints[before:] == ([Setpoint(A, 0.3, 0)] if acted_on is None else [])


def test_cloud_is_told_the_setpoint_again_in_every_session():
    flight = started()
    told = flight.setpoints[-1]
    flight.restart_cloud()
    flight.step(seconds=0.02)
    assert flight.setpoints.count(told) == 2
    flight.operate("hold")
    flight.operate("go_to", Leg(C))
    flight.restart_cloud()
    flight.step(position=A)
    assert [setpoint.position for setpoint in flight.setpoints[-2:]] == [C, C]


@pytest.mark.parametrize("before", ["cancel", "acknowledge"])
def test_after_a_foreign_start_the_robot_counts_as_flying(before):
    """A predecessor's late start moves it; it would leave for the next mission's point."""
    flight = started() if before == "cancel" else Flight()
    flight.onboard = (ID + 1, 2)
    flight.step(position=AWAY)
    if flight.state != "FAILED":
        flight.operate(before)
    flight.step(seconds=0.1)
    flight.mission += 1
    flight.guard = TRACK
    flight.step()
    flight.downlink = False
    flight.operate("start", FROM_SPAWN, ID + 2)
    flight.step(seconds=0.2)
    assert flight.setpoints[-1].position == AWAY


# What the robot stores on board


def started():
    flight = Flight()
    flight.step(position=AWAY)
    flight.operate("start", THREE, ID)
    flight.step(seconds=0.05)
    return flight


# Requests of others


def test_a_predecessors_late_end_does_not_stop_the_mission():
    flight = started()
    flight.mission += 1
    flight.guard = HOLD
    flight.step(seconds=0.2)
    assert flight.guard is TRACK
    assert (flight.requests[-1].request, flight.requests[-1].start) == (Request.START, Start.HERE)
    assert [event.event for event in flight.events] == ["started"]


@pytest.mark.parametrize("guard", [HOLD, GROUND])
def test_a_robot_that_waits_during_its_mission_is_started_again(guard):
    """Another cloud's end in another session; but not one that flies and rests by turns."""
    flight = started()
    flight.restart_cloud()
    for _ in range(3):
        flight.guard = guard
        count = len(flight.requests)
        flight.step(seconds=2.9)
        assert asked(flight, count) == []
        flight.guard = TRACK
        flight.step(seconds=0.02)
    flight.guard = guard
    flight.step(seconds=3.2)
    assert flight.requests[-1][1:3] == (Request.START, Start.HERE)
    assert (flight.guard, flight.state) == (TRACK, "FLYING")
