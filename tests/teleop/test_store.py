# SPDX-License-Identifier: Apache-2.0

"""The store of missions: what is on the disk is known, whatever happens to process and disk."""

import os
import sqlite3
from contextlib import closing

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.schema import Touch
from cloudrc.teleop import models
from cloudrc.teleop.refusals import UnavailableError, UnknownMissionError
from cloudrc.teleop.store import (
    KEPT,
    SHOWN,
    MissionStore,
    Order,
    StoreLockedError,
    connect,
    open_store,
)
from cloudrc.teleop.wire import Leg, Plan
from cloudrc.wire.messages import Start
from tests.teleop.conftest import A, B, C, KilledError, ServiceFlight, play, service_flying

PLAN = Plan((Leg(A, 0.1, float("inf"), 0.5, 3.0), Leg(B)), Start.HERE, 12.5)
ORDER = Order(PLAN, "näme", "key", touch=Touch(body="board"))
FULL = "the journal cannot be written: database or disk is full"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "volume" / "missions"


def begun(path):
    """A file with one mission under way; it is closed."""
    store = open_store(path, b"salt")
    mission = store.add(ORDER)
    store.note(mission, "starting", "the robot is asked to start")
    store.note(mission, "reached", "waypoint 1", waypoint=0, elapsed=1.5, world="w")
    store.close()
    return mission


def test_missions_are_read_back_exactly(path):
    mission = begun(path)
    store = open_store(path, b"other")
    assert store.missions == {"m1": mission}
    assert store.missions["m1"].events.maxlen == SHOWN
    assert [event["event"] for event in store.events_after(0)] == ["starting", "reached"]
    assert store.add(ORDER).number != mission.number
    assert (path.stat().st_mode & 0o777, store.notice) == (0o600, "")
    store.close()
    assert os.listdir(path.parent) == ["missions"]


def test_each_commit_waits_for_the_disk(path):
    open_store(path, b"").close()
    with closing(connect(path)) as database:
        for name, value in (("synchronous", 2), ("journal_mode", "wal")):
            assert database.execute(f"PRAGMA {name}").fetchone()[0] == value


def test_a_second_store_is_refused_until_the_first_is_closed(path):
    first = open_store(path, b"")
    with pytest.raises(StoreLockedError, match="another teleop has this journal open"):
        open_store(path, b"")
    first.add(ORDER)
    first.close()
    assert list(open_store(path, b"").missions) == ["m1"]


def overwrite(path, at, data):
    with path.open("r+b") as file:
        file.seek(at)
        file.write(data)


def execute(path, statement):
    with closing(sqlite3.connect(path)) as database, database:
        database.execute(statement)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: overwrite(path, 4096, os.urandom(9000)),
        lambda path: execute(path, "UPDATE missions SET status = '{'"),
        lambda path: execute(path, "UPDATE missions SET plan = '[1, {}]'"),
    ],
)
@pytest.mark.fault(
    36,
    "torn-journal",
    injects="the journal of the missions is damaged",
    expects="teleop keeps the file aside, says so, and begins a new journal",
)
def test_a_damaged_file_is_set_aside_and_named(path, damage):
    begun(path)
    damage(path)
    before = path.read_bytes()
    store = open_store(path, b"")
    aside = path.with_name("missions.damaged")
    assert store.notice.startswith(f"journal repaired: {path}: ")
    assert store.notice.endswith(f"its missions are lost, it is kept as {aside}")
    assert "\n" not in store.notice
    assert aside.read_bytes() == before
    assert store.missions == {}
    assert store.add(ORDER).id == "m1"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda path: path.write_bytes(b"a recording of somebody else"), "not a database"),
        (lambda path: path.with_name("missions-wal").mkdir(), "disk I/O error"),
    ],
)
def test_anything_else_is_refused_and_left_alone(path, make, said):
    path.parent.mkdir()
    make(path)
    with pytest.raises(BadInputError, match=f"journal {path}: .*{said}.*another"):
        open_store(path, b"")
    assert {"missions", "missions-wal"} >= set(os.listdir(path.parent))


def test_the_number_of_missions_and_events_is_bounded():
    store = MissionStore(connect(), b"")
    for _ in range(3 * KEPT):
        mission = store.add(Order(Plan((Leg(A),))))
        store.note(mission, "cancelled", "")
    assert list(store.missions) == [f"m{n}" for n in range(2 * KEPT, 3 * KEPT + 1)]
    for _ in range(2 * SHOWN):
        store.note(mission, "goto", "there")
    view = mission.as_json()
    assert (len(view["events"]), view["events_left_out"]) == (SHOWN, SHOWN + 1)
    models.MissionView.model_validate(view)


@pytest.mark.fault(
    32,
    "slow-reader",
    injects="a reader of the event stream does not read",
    expects="only this reader misses events, the oldest first, and they are counted",
)
def test_a_reader_that_was_away_misses_what_was_forgotten():
    store = MissionStore(connect(), b"")
    first, second = store.add(ORDER), store.add(ORDER)
    store.note(second, "queued", "")
    for _ in range(SHOWN + 5):
        store.note(first, "goto", "there")
    last = SHOWN + 6
    assert [event["id"] for event in store.events_after(last - 2)] == [last - 1, last]
    assert (store.events_after(last), store.dropped) == ([], 0)
    assert [event["id"] for event in store.events_after(0)] == [1, *range(7, last + 1)]
    assert store.events_after(last + 1) == store.events_after(0), "of a file that is gone"
    assert store.dropped == 0
    assert (len(store.events_after(3)), store.dropped) == (SHOWN, 3)


def test_missions_are_found_by_id_number_and_key():
    store, other = MissionStore(connect(), b"a"), MissionStore(connect(), b"b")
    numbers = {each.add(Order(PLAN)).number for _ in range(100) for each in (store, other)}
    assert len(numbers) == 200
    assert all(0 < number < 2**63 for number in numbers)
    with pytest.raises(UnknownMissionError, match="no mission 'm777'"):
        store.find("m777")
    first = store.add(ORDER)
    assert (store.find(first.id), store.with_key("key"), store.with_key("")) == (first, first, None)


def test_what_is_over_and_what_was_stopped_is_known():
    store = MissionStore(connect(), b"")
    first, second, third = (store.add(Order(PLAN, queue=True)) for _ in range(3))
    store.note(third, "cancelled", "")
    assert store.stopped() is None
    store.note(first, "started", "")
    store.note(first, "emergency_stopped", "")
    for _ in range(SHOWN):
        store.note(first, "new_session", "")
    assert store.stopped() is first, "those after it have not begun, and its event is not kept"
    assert [mission.id for mission in store.open()] == ["m2"]
    ended = [store.has_ended(mission.number) for mission in (first, second, third)]
    assert ended == [True, False, True]
    assert not store.has_ended(1)
    store.note(second, "started", "")
    assert store.stopped() is None, "the robot has flown since"


def test_a_full_disk_stops_no_flight_and_is_told_once():
    flight, mission_id = service_flying()
    before = flight.kept
    flight.full = True
    play(flight, "B C")
    assert (flight.view(mission_id)["state"], flight.kept) == ("done", before)
    tried = flight.commits
    flight.step(seconds=3.0)
    assert 2 <= flight.commits - tried <= 4
    assert [fault.text for fault in flight.faults] == [f"{FULL}; free or repair its volume"]
    with pytest.raises(UnavailableError, match=f"no mission can start: {FULL}"):
        flight.create()
    assert list(flight.teleop.book.missions) == ["m1"]
    flight.full = False
    flight.step(seconds=1.05)
    assert flight.kept[-1]["event"] == "done"
    assert [event["id"] for event in flight.kept] == list(range(1, len(flight.kept) + 1))
    assert flight.stored().missions == flight.teleop.book.missions


def flown(kill, at):
    """Fly a mission whose process is killed once; say whether it was."""
    flight, killed = ServiceFlight(), False
    setattr(flight, kill, at)

    def fly(position):
        flight.step(seconds=0.1 if killed else 0.01)
        flight.create(key="uid")
        flight.step(position=position, seconds=0.1)

    for position in (A, A, B, C, C):
        try:
            fly(position)
        except KilledError:
            killed = True
            flight.restart_teleop()
            fly(position)
    return flight, killed


@pytest.mark.promise("waypoints-once-in-order")
@pytest.mark.parametrize("kill", ["killed_before", "killed_after"])
def test_waypoints_are_reached_once_whenever_teleop_is_killed(kill):
    killed, at = True, 0
    while killed:
        at += 1
        flight, killed = flown(kill, at)
        view = flight.view("m1")
        assert [each["waypoint"] for each in view["reached"]] == [0, 1, 2], at
        assert (view["state"], view["verdict"]["exit_code"]) == ("done", 0), at
        assert flight.names("m1").count("started") == 1
        assert flight.stored().missions == flight.teleop.book.missions
        assert list(flight.teleop.book.missions) == ["m1"]
    assert at > 6
