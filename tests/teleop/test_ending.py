"""A teleop that has been asked to end: it begins nothing."""

import pytest

from cloudrc.cli.teleop import _Ending
from cloudrc.drivers.teleop import serve_teleop
from cloudrc.messages import GuardState, OperatorRequest, Request
from cloudrc.teleop import wire
from cloudrc.teleop.store import UnavailableError
from tests.teleop.conftest import AWAY, B, C, Disk, ServiceFlight, service_flying

HALFWAY = (0.5, 0.0, 1.0)


def idle():
    flight = ServiceFlight()
    flight.step()
    return flight


def done():
    flight, _ = service_flying()
    for point in (B, C):
        flight.step(position=point, seconds=0.1)
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
        (idle, go_to),
        (done, go_to),
        (held, go_to),
        (held, resume),
    ],
)
def test_nothing_is_begun_while_teleop_ends(before, say):
    """It is refused, for its sender to say it again to the next teleop; nothing is kept of it."""
    flight = before()
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.2)
    kept, asked = list(flight.kept), len(flight.requests)
    with pytest.raises(UnavailableError, match="teleop ends; repeat this when teleop runs again"):
        say(flight)
    flight.step(seconds=0.5)
    assert flight.kept == kept
    assert Request.START not in {request.request for request in flight.requests[asked:]}
    assert AWAY not in {setpoint.position for setpoint in flight.setpoints}


def test_a_known_order_stays_known_during_and_after_shutdown():
    flight = idle()
    mission_id = flight.create(key="uid")
    flight.teleop.pause(flight.now_ns)
    assert flight.create(key="uid") == mission_id
    flight.restart_teleop()
    assert flight.create(key="uid") == mission_id


def test_where_it_is_seen_the_robot_stays_though_its_end_is_lost():
    """Cloud keeps the setpoint, and obeys it alone while there is no teleop."""
    flight, _ = service_flying()
    flight.step(position=HALFWAY, seconds=0.1)
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.1)
    assert flight.setpoints[-1].position == HALFWAY


@pytest.mark.parametrize("state", ["flying", "held", "starting"])
def test_an_early_shutdown_pauses_the_current_mission(state):
    """The robot flew on to its waypoint, and nothing was written down."""
    flight = idle() if state == "starting" else held() if state == "held" else service_flying()[0]
    if state == "starting":
        flight.downlink = False
        flight.create()
        flight.downlink = True
    asked = len(flight.requests)
    flight.restart_teleop()
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.5)
    assert flight.guard in (GuardState.HOLD, GuardState.GROUND)
    assert {request.request for request in flight.requests[asked:]} == {Request.END}
    assert flight.kept[-1]["event"] == "paused"
    assert flight.teleop.settled
    flight.restart_teleop()
    flight.step(seconds=0.5)
    assert flight.view("m1")["state"] == ("held" if state == "held" else "flying")


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
    cloud = Neighbour(flight.teleop.sight.seen)
    serve_teleop(
        flight.teleop,
        cloud,
        wire.encode,
        wire.decode,
        calls=list,
        tell=lambda told: None,
        stop=_Ending(flight.teleop, lambda: True),
    )
    asked = [said.request for said in cloud.said if isinstance(said, OperatorRequest)]
    assert asked.count(Request.END) >= 3
    assert clock[0] - flight.now_ns < 2_000_000_000


def test_during_shutdown_teleop_still_stops_and_releases():
    flight, _ = service_flying()
    flight.teleop.pause(flight.now_ns)
    flight.step(seconds=0.1)
    flight.teleop.stop_rotors(flight.now_ns)
    flight.step(seconds=0.1)
    assert flight.guard is GuardState.ESTOP
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=0.1)
    assert flight.guard is GuardState.GROUND
