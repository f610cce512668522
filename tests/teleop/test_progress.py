"""Progress is the most that journal or robot know: a waypoint is reached once, whatever is lost."""

import pytest

from cloudrc.messages import GuardState, OperatorRequest, Request, Start
from cloudrc.teleop.requests import PREDECESSORS, RequestSender
from cloudrc.teleop.store import number_of
from cloudrc.teleop.wire import Continue, Hold, RobotStatus, StartMission
from tests.teleop.conftest import (
    AWAY,
    ID,
    THREE,
    A,
    B,
    C,
    Flight,
    service_flying,
)


def test_the_robot_is_told_of_every_waypoint_reached():
    flight, _ = service_flying()
    number = flight.onboard[0]
    assert number == number_of("m1", b"")
    flight.step(seconds=0.05)
    assert flight.onboard == (number, 1)
    flight.step(position=B, seconds=0.05)
    assert flight.onboard == (number, 2)


def test_it_is_told_again_until_it_shows_that_it_knows():
    flight, _ = service_flying()
    flight.downlink = False
    told = len(flight.requests)
    flight.step(position=B, seconds=1.0)
    copies = flight.requests[told:]
    assert {(c.request, c.reached, c.number) for c in copies} == {(Request.PROGRESS, 2, 0)}
    assert 8 <= len(copies) <= 12
    flight.downlink = True
    flight.step(seconds=0.2)
    told = len(flight.requests)
    flight.step(seconds=1.0)
    assert len(flight.requests) == told


def continued(reached, *, leg=0, held=False):
    """A teleop that has forgotten, and a robot that has not."""
    flight = Flight()
    flight.onboard = (ID, reached)
    flight.guard = GuardState.HOLD
    flight.step(position=AWAY)
    flight.operate(Continue(THREE, leg, 5.0, flight.world, held, ID))
    flight.step(seconds=0.05)
    return flight


def test_what_the_robot_knows_counts_after_a_restart():
    flight = continued(2)
    assert [(e.event, e.waypoint) for e in flight.events] == [
        ("resumed", 0), ("reached", 0), ("reached", 1),
    ]  # fmt: skip
    assert "reached, as the robot reports," in flight.events[1].text
    assert flight.setpoints[-1].position == C
    flight.step(position=C)
    assert flight.state == "DONE"


@pytest.mark.parametrize(("onboard", "aims"), [(0, [A]), (2, [C]), (3, [])])
def test_the_robot_never_flies_back_to_a_reached_waypoint(onboard, aims):
    flight = Flight()
    flight.onboard = (ID, onboard)
    flight.operate(Continue(THREE, 0, 5.0, flight.world, False, ID))
    flight.downlink = False
    flight.step(position=AWAY, seconds=0.1)
    assert flight.state == "STARTING"
    assert [setpoint.position for setpoint in flight.setpoints] == aims


def test_what_the_journal_knows_counts_after_a_restart():
    flight = continued(0, leg=2)
    assert [(e.event, e.waypoint) for e in flight.events] == [("resumed", 2)]
    flight.step(seconds=0.1)
    assert flight.onboard == (ID, 2)  # and the robot knows it from now on


def test_a_mission_that_the_robot_knows_to_be_done_is_done():
    flight = continued(3)
    assert flight.state == "DONE"
    assert [e.waypoint for e in flight.events if e.event == "reached"] == [0, 1, 2]


def test_a_held_mission_stays_held_and_knows():
    flight = continued(1, held=True)
    assert (flight.state, flight.teleop.leg) == ("HELD", 1)
    assert flight.setpoints[-1].position == AWAY
    assert continued(3, held=True).state == "DONE"


def test_without_a_number_nothing_is_kept_on_board():
    flight = Flight()
    flight.step(position=AWAY)
    flight.operate(StartMission(THREE))
    flight.step(seconds=0.05)
    flight.step(position=A, seconds=0.3)
    flight.onboard = (0, 3)
    flight.step(seconds=0.3)
    assert flight.teleop.leg == 1
    assert not [r for r in flight.requests if r.request is Request.PROGRESS]


def test_more_than_there_is_cannot_be_reached():
    assert continued(9).state == "DONE"


def test_progress_waits_for_what_is_asked():
    repeater = RequestSender()
    seen = RobotStatus(1, A, GuardState.TRACK, 4, mission_id=ID, reached=0)
    repeater.see(seen, 0)
    repeater.report(ID, 2)
    repeater.ask(Request.END)
    assert repeater.due(0).request is Request.END
    assert repeater.due(50_000_000) is None
    repeater.see(seen._replace(mission=4 + PREDECESSORS), 0)
    assert repeater.due(99_999_999) is None
    told = OperatorRequest(0, Request.PROGRESS, Start.SPAWN, ID, 2, epoch=seen.epoch)
    assert repeater.due(100_000_000) == told


def test_with_a_full_disk_the_robot_remembers_its_waypoints():
    flight, _ = service_flying(key="uid")
    flight.full = True
    flight.step(position=B, seconds=0.1)
    flight.restart_teleop()  # what was not written is gone
    flight.full = False
    assert [each["waypoint"] for each in flight.view("m1")["reached"]] == [0]
    flight.step(position=AWAY, seconds=0.1)
    flight.step(position=C, seconds=0.1)
    view = flight.view("m1")
    assert [each["waypoint"] for each in view["reached"]] == [0, 1, 2]
    assert "reached, as the robot reports," in str(view["events"])
    assert view["verdict"]["exit_code"] == 0


def test_held_and_killed_it_is_held_again():
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    flight.restart_teleop()
    flight.step(seconds=0.1)
    assert flight.view(mission_id)["state"] == "held"


def test_hold_can_be_asked_of_the_machine_alone():
    flight = continued(1)
    flight.operate(Hold())
    flight.onboard = (ID, 2)
    flight.step(seconds=0.1)
    assert (flight.state, flight.teleop.leg) == ("HELD", 2)
