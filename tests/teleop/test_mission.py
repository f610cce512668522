"""The mission machine and its requests: transitions, early ends, and who may move the robot."""

from math import dist, inf

import pytest

from cloudrc.messages import GuardState
from cloudrc.teleop.wire import Leg, Plan
from tests.teleop.conftest import AWAY, PLAN, A, B, Flight, flying

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


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


@pytest.mark.parametrize(("downlink", "after"), [(True, 0.02), (False, 5.02)])
def test_a_mission_is_over_once_the_robot_knows_or_after_5_s(downlink, after):
    flight = flying()
    flight.downlink = downlink
    flight.operate("cancel")
    over = [(flight.step(), flight.teleop.over)[1] for _ in range(600)]
    assert over.index(True) * 0.01 == pytest.approx(after, abs=0.02)


def test_dwell_starts_again_outside_of_the_tolerance():
    flight = flying()
    flight.step(position=A, seconds=0.45)
    flight.step(position=(1.07, 0.07, 1.07))
    flight.step(position=A, seconds=0.45)
    assert last_event(flight) == "started"
    flight.step(position=A, seconds=0.06)
    assert last_event(flight) == "reached"


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


@pytest.mark.parametrize("at", [B, AWAY])
def test_setpoints_end_on_time_and_tell_the_distance_from_the_last_one(at):
    track = ((0.0, A), (1.0, B), (2.0, B))
    flight = flying(Plan((Leg(A, tolerance=inf, time_limit=inf),), track=track))
    flight.step(position=B, seconds=1.8)
    assert flight.state == "FLYING"
    flight.step(position=at, seconds=0.3)
    assert last_event(flight) == "done"
    texts = " ".join(event.text for event in flight.events)
    assert f"{dist(at, B):.2f} m from the last one" in texts
    assert "waypoint" not in texts


# Requests and the emergency stop: repeated until the robot has acted on them


def test_a_stop_with_the_number_of_an_acknowledgement_does_not_confirm_it():
    flight = Flight()
    flight.step()
    for verb in ("stop", "acknowledge"):
        flight.operate(verb)
        flight.step(seconds=0.3)
    flight.operate("stop")
    flight.step(seconds=0.3)
    flight.downlink = False  # cloud's last copy of the stop overtakes the acknowledgement
    flight.operate("acknowledge")
    flight.step()
    flight.mission = flight.requests[-1].number
    flight.step()
    flight.downlink = True
    flight.step(seconds=0.3)
    assert flight.guard is GuardState.GROUND
