"""Progress is the most that journal or robot know: a waypoint is reached once, whatever is lost."""

import pytest

from cloudrc.messages import GuardState, OperatorRequest, Request, Start
from cloudrc.teleop.journal import Journal
from cloudrc.teleop.requests import PREDECESSORS, RequestSender
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import Order, number_of
from cloudrc.teleop.wire import Continue, Hold, RobotStatus, StartMission
from tests.teleop.conftest import (
    AWAY,
    ID,
    PATH,
    SERVICE_PLAN,
    THREE,
    A,
    B,
    C,
    Flight,
    KilledError,
    MemoryDisk,
    ServiceFlight,
    full,
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


def test_numbers_of_missions_do_not_repeat_with_a_new_journal():
    numbers = {number_of(f"m{n}", salt) for n in range(100) for salt in (b"a", b"b")}
    assert len(numbers) == 200
    assert all(0 < number < 2**63 for number in numbers)
    assert number_of("m1", b"a") == number_of("m1", b"a")


class KilledFlight(ServiceFlight):
    """A service over a journal on a disk that may break off, and a robot that flies on."""

    def __init__(self):
        self.disk, self.journal = MemoryDisk(), None
        super().__init__()

    def restart_teleop(self):
        if self.journal is not None:
            self.disk.crash(power=True)
        self.journal = Journal(PATH, self.disk)
        self.teleop = MissionService(0.25, self.journal.append, self.journal.entries, salt=b"")

    def reached(self):
        return [r["waypoint"] for r in self.view("m1")["reached"]]

    def fly(self, points=(A, B, C)):
        """From point to point, each until it is known to be reached."""
        for count, point in enumerate(points, 1):
            for _ in range(20):
                self.step(position=point)
                if len(self.reached()) >= count:
                    break


def fly_killed_at(step):
    """Fly; teleop's process is killed before an operation of its disk; a new one goes on.

    Returns:
        The flight, and whether there was such an operation.
    """
    flight = KilledFlight()
    flight.step()
    flight.create(key="uid")
    flight.step(seconds=0.03)
    flight.disk.kill_at = flight.disk.steps + step
    try:
        flight.fly()
    except KilledError:
        flight.restart_teleop()
        flight.step(seconds=0.1)
        for point in (A, B, C):
            flight.step(position=point, seconds=0.1)
        return flight, True
    return flight, False


@pytest.mark.promise("waypoints-once-in-order")
def test_waypoints_are_reached_once_in_order_despite_kills():
    """Between write and sync, and everywhere else; power is lost, too."""
    killed, step = True, 0
    while killed:
        flight, killed = fly_killed_at(step)
        assert flight.reached() == [0, 1, 2], step
        names = flight.names("m1")
        assert names.count("started") == 1
        assert flight.view("m1")["state"] == "done"
        assert flight.view("m1")["verdict"]["exit_code"] == 0
        assert flight.create(key="uid") == "m1"
        step += 1
    assert step > 15


def test_with_a_full_disk_the_robot_remembers_its_waypoints():
    flight = KilledFlight()
    flight.step()
    flight.create(key="uid")
    flight.step(seconds=0.03)
    flight.disk.fault = full()
    flight.step(position=A, seconds=0.1)
    flight.step(position=B, seconds=0.1)
    assert flight.reached() == [0, 1]
    assert any("cannot be written: No space left" in fault.text for fault in flight.faults)
    flight.restart_teleop()  # what was not written is gone
    assert flight.reached() == []
    flight.step(position=AWAY, seconds=0.1)
    assert flight.reached() == [0, 1]
    flight.step(position=C, seconds=0.1)
    view = flight.view("m1")
    assert (flight.reached(), view["verdict"]["exit_code"]) == ([0, 1, 2], 0)
    assert "reached, as the robot reports," in str(view["events"])


def test_a_full_disk_refuses_a_mission_before_any_request():
    flight = KilledFlight()
    flight.step()
    flight.disk.fault = full()
    with pytest.raises(Exception, match="no mission can start: the journal cannot be written: No"):
        flight.create()
    flight.step(seconds=0.5)
    assert flight.requests == []
    assert flight.teleop.book.missions == {}
    flight.disk.fault = lambda name: None
    assert flight.create() == "m1"


def test_one_key_is_one_mission_however_often():
    flight = ServiceFlight()
    flight.step()
    ids = {
        flight.teleop.create(Order(SERVICE_PLAN, key="uid"), flight.now_ns)[0].id
        for _ in range(1000)
    }
    assert ids == {"m1"}


def test_told_twice_a_waypoint_is_reached_once():
    flight, mission_id = service_flying()
    entry = next(e for e in flight.kept if e.get("event") == "reached")
    flight.kept.append({**entry, "id": 99})
    flight.restart_teleop()
    assert len(flight.view(mission_id)["reached"]) == 1


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


def test_the_last_waypoint_is_recorded_once_despite_a_crash():
    flight, mission_id = service_flying()
    flight.step(position=B, seconds=0.1)
    flight.step(position=C, seconds=0.1)
    events = [entry.get("event") for entry in flight.kept]
    del flight.kept[events.index("done") :]
    assert flight.kept[-1]["event"] == "reached"
    flight.restart_teleop()
    flight.step(position=C, seconds=0.5)
    assert flight.view(mission_id)["state"] == "done"
    reached = [entry["waypoint"] for entry in flight.kept if entry.get("event") == "reached"]
    assert reached == [0, 1, 2]
