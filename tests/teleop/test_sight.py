"""What the user is told of the robot: its state, since when, what comes next, a new session."""

import pytest

from cloudrc.messages import Cause, GuardState
from cloudrc.teleop.service import NO_CLOUD, NOT_HEARD, SILENCE, next_step
from tests.teleop.conftest import AWAY, ServiceFlight, service_flying

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


def seen(flight):
    return flight.teleop.state(flight.now_ns)["seen"]


def texts(flight, mission_id, event):
    return [e["text"] for e in flight.view(mission_id)["events"] if e["event"] == event]


@pytest.mark.parametrize(
    ("guard", "mission", "said"),
    [
        (GROUND, None, "waits for a mission; it takes off, after a stop or a landing only when"),
        (GROUND, "flying", "takes off with the mission's first commands, after a stop"),
        (TRACK, None, "is telling the robot that its mission is over"),
        (TRACK, "flying", "flies its mission"),
        (TRACK, "held", "cloudrc mission resume"),
        (HOLD, None, "waits for a mission"),
        (HOLD, "flying", "continues by itself when they arrive"),
        (HOLD, "held", "continues by itself when they arrive"),
        *((stop, how, "find the cause, then: cloudrc mission acknowledge")
          for stop in (LAND, ESTOP) for how in (None, "flying", "held")),
    ],
)  # fmt: skip
def test_what_comes_next_follows_from_the_guard_and_the_mission(guard, mission, said):
    past = SILENCE + 0.01
    assert said in next_step(guard, 0.01, 0.01, mission)
    assert said in next_step(guard, SILENCE, SILENCE, mission)
    assert next_step(guard, past, SILENCE, mission) == NOT_HEARD
    assert next_step(guard, past, past, mission) == NO_CLOUD


def test_every_state_has_its_words():
    states = (None, "queued", "starting", "flying", "held")
    assert all(next_step(guard, 0.0, 0.0, mission) for guard in GuardState for mission in states)


def test_the_state_view_has_cause_duration_and_next_step():
    flight, _ = service_flying()
    flight.step(seconds=0.5)
    before = seen(flight)["guard_for_s"]
    assert before > 0.5
    assert seen(flight)["next_step"] == "the robot flies its mission"
    flight.guard, flight.cause, flight.downlink = HOLD, Cause.SILENCE, False
    flight.step()
    assert seen(flight)["cause"] == "no fresh commands"
    assert (seen(flight)["guard"], seen(flight)["guard_for_s"]) == ("HOLD", 0.0)
    flight.step(seconds=3.2)
    assert seen(flight)["guard_for_s"] == pytest.approx(3.2)
    assert "continues by itself" in seen(flight)["next_step"]


def test_the_state_duration_ends_only_with_a_new_world():
    flight, _ = service_flying()
    flight.guard = HOLD
    flight.step(seconds=1.0)
    flight.uplink = False
    flight.step(seconds=2.0)
    flight.uplink = True
    flight.restart_cloud()
    flight.step()
    assert seen(flight)["guard_for_s"] == pytest.approx(3.0)
    flight.restart()
    flight.guard = HOLD
    flight.step()
    assert seen(flight)["guard_for_s"] == 0.0


def test_a_silent_robot_is_shown_with_its_age():
    flight, _ = service_flying()
    flight.guard, flight.cause = HOLD, Cause.SILENCE
    flight.step(seconds=0.5)
    flight.uplink = False
    flight.step(seconds=1.0)
    assert seen(flight)["guard_for_s"] == pytest.approx(1.49)
    flight.step(seconds=1.0)
    shown = seen(flight)
    assert shown["guard_for_s"] is None
    assert (shown["guard"], shown["cause"]) == ("HOLD", "no fresh commands")
    assert shown["age_s"] == pytest.approx(2.0)


@pytest.mark.parametrize("cloud", [True, False])
def test_a_robot_that_is_silent_is_told_from_a_cloud_that_is(cloud):
    flight, _ = service_flying()
    flight.uplink = False
    for _ in range(10):
        flight.step(seconds=0.2)
        if cloud:
            flight.teleop.hear(flight.now_ns)
    age = flight.teleop.state(flight.now_ns + 50_000_000)["cloud_age_s"]
    assert age == pytest.approx(0.05 if cloud else 2.05)
    assert seen(flight)["next_step"] == (NOT_HEARD if cloud else NO_CLOUD)


def test_a_cloud_is_heard_before_the_robot_is_seen():
    flight = ServiceFlight()
    assert flight.teleop.state(0)["cloud_age_s"] is None
    flight.teleop.hear(1_000_000_000)
    assert flight.teleop.state(3_000_000_000)["cloud_age_s"] == 2.0
    assert seen(flight) is None


def test_nothing_is_shown_of_a_robot_that_has_not_been_seen():
    assert seen(ServiceFlight()) is None


def test_a_controller_restart_is_reported_once_with_its_waypoint():
    flight, mission_id = service_flying()
    flight.restart_cloud()
    flight.step(seconds=1.0)
    assert texts(flight, mission_id, "new_session") == [
        "the controller has a new session, as after a restart; the mission goes on to waypoint 2 "
        "of 3"
    ]
    assert flight.view(mission_id)["state"] == "flying"


def test_so_it_is_while_the_mission_is_held():
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    flight.step(position=AWAY)
    flight.restart_cloud()
    flight.step()
    (text,) = texts(flight, mission_id, "new_session")
    assert text.endswith("the mission is held on the way to waypoint 2 of 3")
    assert flight.view(mission_id)["state"] == "held"


def test_sessions_at_mission_start_or_between_are_not_reported():
    flight, mission_id = service_flying()
    flight.teleop.cancel(mission_id, flight.now_ns)
    flight.step(seconds=0.2)
    flight.restart_cloud()
    flight.step(seconds=0.2)
    second = flight.create()
    flight.step(seconds=0.2)
    assert "started" in flight.names(second)
    assert "new_session" not in flight.names(mission_id) + flight.names(second)


def test_a_joint_restart_is_reported_as_teleops_only():
    flight, mission_id = service_flying()
    flight.restart_cloud()
    flight.restart_teleop()
    flight.step(seconds=0.2)
    assert "restarted" in flight.names(mission_id)
    assert "new_session" not in flight.names(mission_id)
