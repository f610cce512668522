"""The service while teleop ends, and what it shows of the robot."""

import pytest

from cloudrc.cli.teleop import ending
from cloudrc.drivers.teleop import serve_teleop
from cloudrc.messages import (
    Cause,
    GuardState,
    OperatorRequest,
    Request,
)
from cloudrc.teleop import wire
from cloudrc.teleop.service import NO_CLOUD, NOT_HEARD, SILENCE, next_step
from cloudrc.teleop.store import UnavailableError
from tests.teleop.conftest import (
    AWAY,
    B,
    C,
    Disk,
    ServiceFlight,
    asked,
    finish,
    service_flying,
)

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


def state(flight, mission_id="m1"):
    return flight.view(mission_id)["state"]


def idle():
    flight = ServiceFlight()
    flight.step()
    return flight


def done():
    flight, _ = service_flying()
    finish(flight)
    return flight


def held():
    flight, _ = service_flying()
    flight.teleop.hold(flight.now_ns)
    return flight


def go_to(flight):
    flight.teleop.go_to(AWAY, 0.0, flight.now_ns)


def resume(flight):
    flight.teleop.resume(flight.now_ns)


@pytest.mark.parametrize(
    ("before", "say"),
    [
        (idle, ServiceFlight.create),
        (done, ServiceFlight.create),
        (held, lambda flight: flight.create(queue=True)),
        *((before, go_to) for before in (idle, done, held)),
        (held, resume),
    ],
)
def test_nothing_is_begun_while_teleop_ends(before, say):
    """It is refused, for its sender to say it again to the next teleop; nothing is kept of it."""
    flight = before()
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.2)
    kept, count = flight.kept, len(flight.requests)
    with pytest.raises(UnavailableError, match="teleop ends; repeat this when teleop runs again"):
        say(flight)
    flight.step(seconds=0.5)
    assert flight.kept == kept
    assert Request.START not in asked(flight, count)
    assert AWAY not in {setpoint.position for setpoint in flight.setpoints}


def test_what_is_known_stays_known_and_what_waits_waits_for_the_next_teleop():
    flight, first = service_flying(key="uid")
    second = flight.create(queue=True)
    flight.step(position=B, seconds=0.05)
    flight.teleop.pause(flight.now_ns)
    assert flight.create(key="uid") == first
    flight.step(position=C, seconds=0.5)
    assert (state(flight, first), state(flight, second)) == ("done", "queued")
    flight.restart_teleop()
    assert flight.create(key="uid") == first
    flight.step(seconds=0.3)
    assert state(flight, second) == "flying"


@pytest.mark.parametrize("before", ["flying", "restarted", "held", "starting"])
def test_a_shutdown_pauses_the_current_mission(before):
    """The robot stays where it is seen; the next teleop goes on."""
    flight = idle() if before == "starting" else held() if before == "held" else None
    flight = flight or service_flying()[0]
    if before == "starting":
        flight.downlink = False
        flight.create()
        flight.downlink = True
    flight.step(position=(0.5, 0.0, 1.0), seconds=0.0 if before == "starting" else 0.1)
    count = len(flight.requests)
    if before != "flying":
        flight.restart_teleop()
    flight.teleop.pause(flight.now_ns)
    assert flight.kept[-1]["text"].startswith("paused by shutdown on the way to waypoint")
    flight.step(seconds=0.5)
    assert flight.guard in (HOLD, GROUND)
    assert set(asked(flight, count)) == {Request.END}
    if before == "flying":
        assert flight.setpoints[-1].position == (0.5, 0.0, 1.0)
    assert flight.teleop.settled
    flight.restart_teleop()
    flight.step(seconds=0.5)
    assert state(flight) == ("held" if before == "held" else "flying")


def test_during_shutdown_teleop_still_stops_and_releases():
    flight, _ = service_flying()
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.1)
    for ask, guard in ((flight.teleop.stop_rotors, ESTOP), (flight.teleop.acknowledge, GROUND)):
        ask(flight.now_ns)
        flight.step(seconds=0.1)
        assert flight.guard is guard


class Neighbour:
    """Cloud, which shows where the robot is whenever teleop looks."""

    def __init__(self, seen):
        self.said, self._seen = [], wire.encode(seen)

    def receive(self):
        return [self._seen]

    def send(self, data):
        self.said.append(wire.decode(data))
        return True


@pytest.mark.parametrize("fsync_ns", [0, 600_000_000, 1_000_000_000])
def test_a_slow_disk_does_not_delay_the_pause_at_shutdown(monkeypatch, fsync_ns):
    """The time for that was over before: the robot flew on to its waypoint."""
    flight, _ = service_flying()
    clock, commit = [flight.now_ns], Disk.commit

    def sleep(seconds):
        clock[0] += round(seconds * 1e9)

    def fsync(disk):
        clock[0] += fsync_ns
        commit(disk)

    monkeypatch.setattr(Disk, "commit", fsync)
    monkeypatch.setattr("cloudrc.drivers.teleop.time.sleep", sleep)
    monkeypatch.setattr("cloudrc.drivers.teleop.time.monotonic_ns", lambda: clock[0])
    cloud, service = Neighbour(flight.teleop.sight.seen), flight.teleop
    how = {"calls": list, "tell": lambda told: None, "stop": ending(service, lambda: True)}
    serve_teleop(service, cloud, wire.encode, wire.decode, **how)
    said = [each.request for each in cloud.said if isinstance(each, OperatorRequest)]
    assert said.count(Request.END) >= 3
    assert clock[0] - flight.now_ns < 2_000_000_000


def seen(flight):
    return flight.teleop.state(flight.now_ns)["seen"]


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


def test_the_state_is_shown_with_cause_and_since_when_in_this_world():
    flight, _ = service_flying()
    flight.step(seconds=0.5)
    assert seen(flight)["guard_for_s"] > 0.5
    assert seen(flight)["next_step"] == "the robot flies its mission"
    flight.guard, flight.cause, flight.downlink = HOLD, Cause.SILENCE, False
    flight.step()
    assert (seen(flight)["guard"], seen(flight)["guard_for_s"]) == ("HOLD", 0.0)
    flight.step(seconds=0.5)
    flight.uplink = False
    flight.step(seconds=2.0)
    shown = seen(flight)
    assert (shown["guard_for_s"], shown["cause"]) == (None, "no fresh commands")
    assert shown["age_s"] == pytest.approx(2.0)
    flight.uplink = True
    flight.restart_cloud()
    flight.step()
    assert seen(flight)["guard_for_s"] == pytest.approx(2.51)
    flight.restart()
    flight.guard = HOLD
    flight.step()
    assert seen(flight)["guard_for_s"] == 0.0


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


@pytest.mark.parametrize("is_held", [False, True])
def test_a_controller_restart_is_reported_once_with_its_waypoint(is_held):
    flight = held() if is_held else service_flying()[0]
    flight.restart_cloud()
    flight.step(seconds=1.0)
    (text,) = (e["text"] for e in flight.view("m1")["events"] if e["event"] == "new_session")
    goes_on = "is held on the way to" if is_held else "goes on to"
    assert text == (
        f"the controller has a new session, as after a restart; the mission {goes_on} "
        "waypoint 2 of 3"
    )


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
