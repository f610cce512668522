"""The mission machine: each transition, each early end, and who may move the robot."""

import pytest

from cloudrc.messages import Cause, GuardState, Request, Setpoint, Start
from cloudrc.teleop.mission import HELD_LOWEST, Teleop
from cloudrc.teleop.store import Mission, Order
from cloudrc.teleop.wire import Leg, Plan
from tests.teleop.conftest import AWAY, FROM_SPAWN, ID, PLAN, THREE, A, B, C, Flight, asked, flying

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
AT_ONCE = Plan((Leg(A, dwell=0.0),))


def last_event(flight):
    return flight.events[-1].event


def test_without_a_mission_the_setpoint_is_where_each_world_shows_the_robot():
    flight = Flight()
    for point in (A, AWAY, B):
        flight.step(position=point)
        if point is AWAY:
            flight.restart()
    assert flight.said == [Setpoint(A), Setpoint(B)]
    assert (flight.state, flight.teleop.outcome) == ("IDLE", None)


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
    assert flight.events[0].text == "mission started from the spawn, waypoints: 3"
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
    assert (flight.state, outcome.code, outcome.text) == ("FAILED", code, text)
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


@pytest.mark.parametrize(
    ("how", "said"),
    [
        *((how, "mission not done within 3 s: on the way to waypoint 1 of 1")
          for how in ("flown", "held", "unseen")),
        ("not started", "the robot has not started within 3 s; is the link up?"),
    ],
)  # fmt: skip
def test_a_mission_that_takes_too_long_fails(how, said):
    plan = Plan((Leg(A),), time_limit=3.0)
    flight = Flight() if how == "not started" else flying(plan)
    if how == "not started":
        flight.downlink = False
        flight.step()
        flight.operate("start", plan)
    if how == "held":
        flight.operate("hold")
    flight.uplink = how != "unseen"
    flight.step(seconds=2.95)
    assert flight.teleop.outcome is None
    flight.step(seconds=0.05)
    assert_failed(flight, "timed_out", said)


def test_no_robot_is_held_where_it_would_scrape_along_the_floor():
    flight = flying()
    flight.step(position=(0.2, 0.1, 0.12))
    for verb in ("hold", "cancel"):
        flight.operate(verb)
        assert flight.setpoints[-1].position == (0.2, 0.1, HELD_LOWEST)


@pytest.mark.parametrize("guard", [LAND, ESTOP])
def test_a_guard_that_lands_or_stops_fails_the_mission(guard):
    flight = flying()
    flight.guard, flight.cause = HOLD, Cause.SILENCE
    flight.step(seconds=20.0)
    assert flight.state == "FLYING"
    flight.guard, flight.cause = guard, Cause.IMPOSSIBLE
    flight.step()
    text = f"guard went to {guard.name} (impossible commands) on the way to waypoint 1 of 3"
    assert_failed(flight, "guard_stopped", text)


def test_an_emergency_stop_by_somebody_else_is_not_undone():
    flight = started()
    flight.mission += 1
    flight.guard = ESTOP
    flight.step(seconds=0.3)
    assert flight.teleop.outcome.code == "guard_stopped"
    assert asked(flight) == [Request.START, Request.END]
    assert flight.guard is ESTOP


# The first setpoint: an armed robot flies to it at once


@pytest.fixture
def ended():
    """A mission is done, but its end has not reached the robot, which tracks on."""
    flight = flying(AT_ONCE)
    flight.downlink = False
    flight.step(position=A)
    assert (flight.state, flight.guard) == ("DONE", TRACK)
    return flight


def test_a_flying_robot_gets_no_new_setpoint_before_a_new_start(ended):
    """It would fly past the spawn, through whatever stands between."""
    ended.operate("start", PLAN)
    ended.step(seconds=0.5)
    assert ended.setpoints[-1] == Setpoint(A, 0.0, -1)
    ended.downlink = True
    ended.step(seconds=0.15)
    assert (ended.state, ended.setpoints[-1]) == ("FLYING", Setpoint(A, 0.3, 0))


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


def test_a_robot_on_the_ground_may_have_been_told_to_start():
    """Until it is seen to have heard of the end, too, nothing leads it away."""
    flight = Flight()
    flight.step()
    flight.operate("start", FROM_SPAWN, ID)
    flight.downlink = False
    flight.operate("cancel")
    flight.step(seconds=0.2)
    flight.operate("start", FROM_SPAWN, ID + 1)
    flight.step(seconds=0.2)
    assert (flight.guard, flight.setpoints[-1].waypoint) == (GROUND, -1)
    flight.downlink = True
    flight.step(seconds=0.2)
    assert (flight.state, flight.setpoints[-1].waypoint) == ("FLYING", 0)


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


def test_in_a_new_session_a_start_keeps_the_robot_in_place():
    """Somebody else has had it in between, and has left it armed elsewhere."""
    flight = Flight()
    flight.step()
    flight.downlink = False
    flight.operate("start", FROM_SPAWN, ID)
    flight.step(seconds=0.05)
    assert flight.setpoints[-1].position == A
    flight.restart_cloud()
    flight.onboard, flight.guard = (ID + 1, 3), TRACK
    flight.step(position=AWAY, seconds=0.3)
    assert (flight.state, flight.setpoints[-1].position) == ("STARTING", AWAY)
    flight.downlink = True
    flight.step(seconds=0.3)
    assert (flight.state, flight.setpoints[-1].position) == ("FLYING", A)


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


@pytest.mark.parametrize(
    ("onboard", "guard", "words"),
    [
        *(((number, reached), TRACK, [Request.START])
          for number, reached in ((0, 3), (ID + 1, 0), (ID + 1, 3))),
        ((ID + 1, 0), GROUND, [Request.START, Request.END]),
    ],
)  # fmt: skip
def test_who_finds_another_mission_on_board_does_not_fly_on(onboard, guard, words):
    """Another cloud has moved the robot; what is not its own it ends only on the ground."""
    flight = started()
    flight.onboard, flight.guard = onboard, guard
    flight.step(seconds=0.3)
    assert (flight.teleop.outcome.code, flight.teleop.leg) == ("taken_over", 0)
    assert flight.setpoints[-1].waypoint == -1
    assert asked(flight) == words


def test_before_its_start_the_old_mission_is_no_takeover():
    flight = Flight()
    flight.onboard = (ID + 1, 3)
    flight.downlink = False
    flight.step(position=AWAY)
    flight.operate("start", THREE, ID)
    flight.step(seconds=0.3)
    assert (flight.state, flight.events) == ("STARTING", [])


@pytest.mark.parametrize("in_sight", [True, False])
def test_a_mission_from_here_fails_if_another_client_moved_it(in_sight):
    """Whether it was ordered with the robot in sight or before that."""
    flight = Flight()
    flight.onboard, flight.guard = (ID - 1, 3), HOLD
    flight.position = AWAY
    if in_sight:
        flight.step()
    flight.downlink = False
    flight.operate("start", THREE, ID)
    flight.step(seconds=0.1)
    flight.restart_cloud()
    flight.onboard, flight.guard = (ID + 1, 1), TRACK
    flight.step(position=B, seconds=0.1)
    assert (flight.state, flight.teleop.outcome.code) == ("FAILED", "taken_over")
    assert flight.setpoints[-1].position == B


def continued(reached, *, leg=0, held=False, mission=ID, downlink=True):
    """A teleop that has forgotten, and a robot that has not."""
    flight = Flight()
    flight.onboard, flight.guard = (mission, reached), HOLD
    flight.downlink = downlink
    flight.step(position=AWAY)
    before = Mission("m1", Order(THREE), ID, "held" if held else "flying", flight.world, 5.0)
    before.reached = [{}] * leg
    flight.operate("continue_mission", before)
    flight.step(seconds=0.05)
    return flight


def test_what_the_robot_or_the_store_knows_counts_after_a_restart():
    flight = continued(2)
    assert [(e.event, e.waypoint) for e in flight.events] == [
        *(("resumed", 0), ("reached", 0), ("reached", 1)),
    ]
    assert "reached, as the robot reports," in flight.events[1].text
    assert flight.setpoints[-1].position == C
    flight.step(position=C)
    assert flight.state == "DONE"
    assert continued(3).state == continued(9).state == continued(3, held=True).state == "DONE"
    flight = continued(0, leg=2)
    assert [(e.event, e.waypoint) for e in flight.events] == [("resumed", 2)]
    flight.step(seconds=0.1)
    assert flight.onboard == (ID, 2)  # and the robot knows it from now on
    flight = continued(1, held=True)
    assert (flight.state, flight.teleop.leg, flight.setpoints[-1].position) == ("HELD", 1, AWAY)


@pytest.mark.parametrize(("onboard", "aims"), [(0, [A]), (2, [C]), (3, [])])
def test_the_robot_never_flies_back_to_a_reached_waypoint(onboard, aims):
    flight = continued(onboard, downlink=False)
    assert flight.state == "STARTING"
    assert [s.position for s in flight.setpoints if s.waypoint >= 0] == aims


@pytest.mark.parametrize("first_sight", [True, False])
def test_a_robot_ready_for_a_lost_mission_does_not_take_off(first_sight):
    """Its order was in a file that is gone; or it arrives when nobody knows of it any more."""
    flight = Flight()
    if not first_sight:
        flight.step()
        flight.epoch += 1
    flight.onboard = (ID, 0)
    flight.step(seconds=0.05)
    assert asked(flight) == [Request.END]
    assert flight.setpoints[-1].position == (0.0, 0.0, HELD_LOWEST)
    assert flight.teleop.settled


@pytest.mark.parametrize(
    ("mission", "guard", "ended", "words"),
    [
        (0, GROUND, False, []),
        (ID, HOLD, False, []),
        (ID, TRACK, False, []),
        (ID, TRACK, True, [Request.END]),
    ],
)
def test_of_foreign_missions_only_a_finished_one_is_ended(mission, guard, ended, words):
    flight = Flight()
    flight.teleop = Teleop(lambda number: ended and number == ID)
    flight.onboard, flight.guard = (mission, 0), guard
    flight.step(position=AWAY, seconds=0.05)
    assert asked(flight) == words
    assert flight.setpoints[-1].position == AWAY


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
