"""What a full disk has refused is kept as soon as it can be, in order, before anything else."""

import pytest

from cloudrc.messages import GuardState, Request
from cloudrc.teleop.journal import Journal
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import (
    AT_ONCE,
    PASSING_MAX,
    Backlog,
    MissionStore,
    UnavailableError,
    first_verb,
)
from cloudrc.teleop.wire import Continue
from tests.teleop.conftest import (
    AWAY,
    PATH,
    SERVICE_PLAN,
    A,
    B,
    C,
    MemoryDisk,
    ServiceFlight,
    full,
    service_flying,
)


def finish(flight):
    for point in (B, C):
        flight.step(position=point, seconds=0.1)


def events(flight, mission_id="m1"):
    return [e["event"] for e in flight.kept if e.get("event") and e["mission"] == mission_id]


def ids(flight):
    return [e["id"] for e in flight.kept if "id" in e]


def test_a_refused_end_is_stored_before_the_next_mission():
    flight, mission_id = service_flying()
    flight.full = True
    finish(flight)
    assert flight.view(mission_id)["state"] == "done"
    assert "done" not in events(flight)
    flight.full = False
    second = flight.create()
    assert events(flight)[-3:] == ["reached", "reached", "done"]
    assert ids(flight) == list(range(1, len(ids(flight)) + 1))
    flight.restart_teleop()
    assert flight.view(mission_id)["verdict"]["exit_code"] == 0
    assert [m.id for m in flight.teleop.book.open()] == [second]


def test_it_is_kept_although_nothing_else_happens():
    flight, _ = service_flying()
    flight.full = True
    finish(flight)
    flight.full = False
    flight.step(seconds=1.05)
    assert events(flight)[-1] == "done"
    flight.restart_teleop()
    flight.step(seconds=0.2)
    assert flight.requests[-1].request is not Request.START


def test_a_full_disk_blocks_missions_and_is_retried_each_second():
    flight, _ = service_flying()
    flight.full = True
    finish(flight)
    before = flight.tries
    flight.step(seconds=3.0)
    assert 2 <= flight.tries - before <= 4
    with pytest.raises(UnavailableError, match="the journal cannot be written: No space left"):
        flight.create()
    assert list(flight.teleop.book.missions) == ["m1"]


def test_the_trouble_is_told_once_until_it_is_over():
    flight, _ = service_flying()
    for _ in range(2):
        flight.full = True
        for _ in range(3):
            flight.teleop.hold(flight.now_ns)
            flight.step(seconds=1.0)
            flight.teleop.resume(flight.now_ns)
        flight.full = False
        flight.step(seconds=1.5)
    assert [fault.code for fault in flight.faults] == ["journal", "journal"]


def test_a_cancelled_mission_with_a_lost_end_does_not_restart():
    flight, mission_id = service_flying()
    flight.full = True
    flight.teleop.cancel(mission_id, flight.now_ns)
    flight.step(seconds=0.3)
    flight.restart_teleop()  # killed before the disk was mended
    asked = len(flight.requests)
    flight.step(position=AWAY, seconds=1.0)
    assert Request.START not in {request.request for request in flight.requests[asked:]}
    assert flight.guard is GuardState.HOLD
    flight.full = False
    flight.step(seconds=1.1)
    view = flight.view(mission_id)
    assert (view["state"], view["verdict"]["failures"][0]["code"]) == ("failed", "end_lost")


def test_a_queued_mission_is_cancelled_once_that_is_stored():
    flight, _ = service_flying()
    waits = flight.create(queue=True)
    flight.full = True
    with pytest.raises(UnavailableError, match="m2 waits on: the journal cannot be written: No sp"):
        flight.teleop.cancel(waits, flight.now_ns)
    assert flight.view(waits)["state"] == "queued"
    flight.full = False
    flight.teleop.cancel(waits, flight.now_ns)
    finish(flight)
    flight.restart_teleop()
    flight.step(seconds=0.5)
    assert flight.view(waits)["state"] == "cancelled"
    assert [m.id for m in flight.teleop.book.open()] == []


@pytest.mark.parametrize("written", [1, 2])
def test_a_mission_with_only_its_order_stored_is_not_repeated(written):
    flight = ServiceFlight()
    flight.step()
    mission_id = flight.create()
    kept = flight.kept[:written]
    flight.step(seconds=0.05)
    flight.step(position=A)
    finish(flight)
    flight.step(seconds=0.2)
    assert flight.onboard[1] == 3
    flight.kept = kept  # a full disk has refused all else
    flight.restart_teleop()
    asked = len(flight.requests)
    flight.step(seconds=1.0)
    assert Request.START not in {request.request for request in flight.requests[asked:]}
    assert flight.view(mission_id)["verdict"]["failures"][0]["code"] == "end_lost"


def test_a_queued_mission_does_not_start_on_a_full_disk():
    """A teleop that has just begun does not know that the disk is full."""
    flight, _ = service_flying()
    waits = flight.create(queue=True)
    flight.guard = GuardState.LAND
    flight.step(seconds=0.1)
    flight.restart_teleop()
    flight.step(seconds=0.1)
    flight.full, asked, tried = True, len(flight.requests), flight.tries
    flight.teleop.acknowledge(flight.now_ns)
    flight.step(seconds=3.0)
    assert flight.view(waits)["state"] == "queued"
    assert {request.request for request in flight.requests[asked:]} == {Request.ACKNOWLEDGE}
    assert [fault.code for fault in flight.faults] == ["journal"]
    assert 2 <= flight.tries - tried <= 4
    flight.full = False
    flight.step(seconds=1.1)
    assert flight.view(waits)["state"] == "flying"
    assert flight.names(waits) == ["queued", "starting", "started"]


class DiskFlight(ServiceFlight):
    """With a real journal on a disk in memory."""

    def __init__(self):
        self.disk = MemoryDisk()
        super().__init__()

    def restart_teleop(self):
        self.disk.crash(power=True)
        self.journal = Journal(PATH, self.disk)
        self.teleop = MissionService(0.25, self.journal.append, self.journal.entries, salt=b"")


@pytest.mark.parametrize("refused", range(12))
def test_the_journal_is_complete_after_any_refused_entry(refused):
    flight = DiskFlight()
    flight.step()
    flight.create()
    flight.step(seconds=0.05)
    flight.disk.fault = full(after=refused)
    for point in (A, B, C):
        flight.step(position=point, seconds=0.1)
    flight.disk.fault = lambda name: None
    flight.step(seconds=2.0)
    before = flight.view("m1")
    flight.restart_teleop()
    assert flight.view("m1") == before
    assert before["state"] == "done"


def entry(number, event="held", mission="m1", **more):
    return {"kind": "event", "id": number, "mission": mission, "event": event, **more}


class Full:
    """A journal that takes what it is told to."""

    def __init__(self):
        self.takes, self.kept = 0, []

    def __call__(self, what):
        if not self.takes:
            raise OSError(28, "No space left on device")
        self.takes -= 1
        self.kept.append(what)


def wait(backlog, entries):
    for each in entries:
        with pytest.raises(OSError, match="No space"):
            backlog.note(each)


def test_what_waits_is_bounded_and_what_a_mission_needs_stays():
    journal = Full()
    backlog = Backlog(journal)
    needed = [entry(n, "reached") for n in range(50)]
    wait(backlog, [entry(50, "goto"), *needed, entry(51, "held", "m2")])
    passing = [entry(n, "held" if n % 2 else "resumed") for n in range(100, 100 + 3 * PASSING_MAX)]
    wait(backlog, passing)
    wait(backlog, [entry(9_999, "done", verdict={})])
    assert len(backlog) == PASSING_MAX + 51
    journal.takes = 10_000
    while backlog:
        backlog.flush()
    kept = [e["id"] for e in journal.kept]
    assert kept[:51] == [*range(50), 51]  # m2 is held, and nothing newer says so
    assert kept[51:] == [e["id"] for e in passing[-(PASSING_MAX - 1) :]] + [9_999]


def test_a_held_mission_stays_held_whatever_comes_after_it():
    journal = Full()
    backlog = Backlog(journal)
    wait(backlog, [entry(0, "held")] + [entry(n, "goto") for n in range(1, 2 * PASSING_MAX)])
    journal.takes = 10_000
    while backlog:
        backlog.flush()
    assert journal.kept[0]["event"] == "held"
    assert len(journal.kept) == PASSING_MAX


def test_only_so_much_is_written_at_once():
    """Every entry takes the disk its time, in which teleop does nothing else."""
    journal = Full()
    backlog = Backlog(journal)
    wait(backlog, [entry(n) for n in range(3 * AT_ONCE)])
    journal.takes = 10_000
    backlog.note(entry(3 * AT_ONCE))
    assert len(journal.kept) == AT_ONCE
    backlog.append(entry(3 * AT_ONCE + 1))  # a mission is not begun before all is kept
    assert [e["id"] for e in journal.kept] == list(range(3 * AT_ONCE + 2))


def test_a_disk_that_breaks_off_loses_and_repeats_nothing():
    journal = Full()
    backlog = Backlog(journal)
    wait(backlog, [entry(n) for n in range(5)])
    for takes in (1, 0, 2, 1):
        journal.takes = takes
        with pytest.raises(OSError, match="No space"):
            backlog.flush()
    journal.takes = 9
    backlog.flush()
    assert [e["id"] for e in journal.kept] == list(range(5))


def test_a_mission_that_has_begun_closes_those_before_it():
    """Their ends are missing in a journal that was damaged."""
    flight, first = service_flying()
    second, third = flight.create(queue=True), flight.create(queue=True)
    finish(flight)
    flight.step(position=AWAY, seconds=0.2)
    assert flight.view(second)["state"] == "flying"
    damaged = [e for e in flight.kept if (e["mission"], e.get("event")) != (first, "done")]
    book = MissionStore(lambda entry: None, damaged, b"")
    assert [mission.id for mission in book.open()] == [second, third]
    closed = book.find(first)
    assert (closed.state, closed.verdict["exit_code"]) == ("failed", 1)
    assert closed.verdict["failures"][0]["code"] == "end_lost"


def test_a_queued_mission_that_is_cancelled_closes_nothing():
    flight, first = service_flying()
    second = flight.create(queue=True)
    flight.teleop.cancel(second, flight.now_ns)
    book = MissionStore(lambda entry: None, flight.kept, b"")
    assert [mission.id for mission in book.open()] == [first]


def test_a_held_mission_is_still_held_when_the_robot_knew_more():
    """What is known on board to be reached is caught up with while it is held."""
    flight, mission_id = service_flying()
    flight.teleop.hold(flight.now_ns)
    flight.onboard = (flight.onboard[0], 2)
    flight.step(seconds=0.2)
    assert flight.view(mission_id)["state"] == "held"
    assert flight.view(mission_id)["waypoint"] == 2
    verb = first_verb(MissionStore(lambda entry: None, flight.kept, b"").find(mission_id))
    assert isinstance(verb, Continue)
    assert (verb.held, verb.leg, len(SERVICE_PLAN.legs)) == (True, 2, 3)
