# SPDX-License-Identifier: Apache-2.0

"""Operator requests reach the guard, which confirms only those that it acts on."""

from math import nan

import pytest

from cloudrc.results.exposition.live import LiveMetrics
from cloudrc.wire.messages import ZERO, Cause, GuardState, Request, Start
from cloudrc.wire.records import CommandApplied, Contact, GuardChange, SessionOpened
from tests.flights.conftest import MS, Bare, ring, talking


@pytest.fixture
def talk():
    """Fly; the request to start had number 1."""
    talk = talking()
    fly(talk, 10)
    return talk


def fly(talk, count):
    for _ in range(count):
        talk.send(talk.command())
        talk.wait(10)


def ask(talk, number, request, start=Start.HERE):
    talk.request(number, request, start)
    talk.wait(20)
    return talk.telemetry.guard, talk.telemetry.mission


@pytest.mark.promise("only-the-operator-arms")
@pytest.mark.parametrize("start", Start)
def test_a_start_is_refused_until_the_stop_is_acknowledged(talk, start):
    assert ask(talk, 2, Request.ESTOP) == (GuardState.ESTOP, 2)
    sessions = len(talk.take(SessionOpened))
    assert ask(talk, 3, Request.START, start) == (GuardState.ESTOP, 2)
    assert len(talk.take(SessionOpened)) == sessions
    assert talk.counts()["start_refused"] == 1
    assert ask(talk, 4, Request.END) == (GuardState.ESTOP, 4), "an end is confirmed even then"
    assert ask(talk, 5, Request.ACKNOWLEDGE) == (GuardState.GROUND, 5)
    assert ask(talk, 3, Request.START, start) == (GuardState.GROUND, 5)  # a late copy
    fly(talk, 5)
    assert talk.change.state is GuardState.GROUND
    assert ask(talk, 6, Request.START)[1] == 6
    fly(talk, 5)
    assert talk.change.state is GuardState.TRACK


@pytest.mark.parametrize(
    ("held_back", "ahead", "outcome"), [(998, 0, ""), (1_003, 0, "stale"), (0, 3, "future")]
)
def test_a_start_that_was_held_back_on_the_way_starts_nothing(talk, held_back, ahead, outcome):
    """Its mission may be over by then, so nobody expects the robot to take off."""
    talk.request(2, Request.END, Start.HERE)
    talk.now_ns += ahead * MS
    captured = talk.asked(3, Request.START, Start.SPAWN)
    talk.wait(held_back - ahead)
    talk.send(captured)
    assert talk.world.counts[outcome] == (outcome != "")
    assert talk.world.robot.guard.armed == (outcome == "")
    if outcome:  # repeated, it is obeyed
        talk.send(talk.asked(4, Request.START, Start.SPAWN))
        assert talk.world.robot.guard.armed


@pytest.mark.parametrize("request_", [Request.START, Request.END, Request.ESTOP])
def test_after_a_stall_a_stop_counts_and_a_start_does_not(talk, request_):
    """World's clock stood still in the meantime, so the age of a start's basis means nothing."""
    captured = talk.asked(2, request_, Start.SPAWN)
    talk.now_ns += 60_000 * MS
    talk.send(captured)
    started = request_ is Request.START
    assert talk.world.counts["stale"] == started
    assert talk.world._number == (1 if started else 2)
    assert talk.world.robot.guard.armed is started


def test_commands_during_a_stop_or_a_hold_are_not_echoed(talk):
    applied = len(talk.take(CommandApplied))
    talk.wait(2_000)
    echo_ns = talk.telemetry.echo_stamp_ns
    fly(talk, 9)
    assert talk.telemetry.echo_stamp_ns == echo_ns
    fly(talk, 1)
    assert len(talk.take(CommandApplied)) == applied + 1
    assert talk.telemetry.echo_stamp_ns > echo_ns
    talk.send(talk.command())
    talk.request(2, Request.ESTOP, Start.HERE)
    talk.wait(20)
    assert len(talk.take(CommandApplied)) == applied + 1


def test_contacts_are_reported_until_the_next_mission_starts(talk):
    """Cloud may die right after the touch; the next cloud must learn of it."""
    ask(talk, 2, Request.END)
    talk.world._obstacles = 1
    talk.wait(300)
    talk.hello("another")
    for number, mission_id, contacts in ((3, 0, 1), (4, 7, 0)):
        talk.request(number, Request.START, Start.HERE, mission_id)
        talk.wait(20)
        assert talk.telemetry.obstacle_contacts == contacts


@pytest.mark.parametrize(
    ("touch", "counted", "speed"), [("board", 2, 0.0), ("pillar", 2, 0.0), ("", 3, nan)]
)
def test_what_a_mission_touches_is_no_obstacle(talk, touch, counted, speed):
    ask(talk, 2, Request.END)
    talk.request(3, Request.START, Start.HERE, mission_id=7, touch=touch)
    for body in ("pillar", "board", "floor", "world"):
        talk.world.robot.simulator.touches.append(Contact(0, body, ZERO, ZERO, ZERO, by_probe=True))
    talk.wait(20)
    assert talk.telemetry.obstacle_contacts == counted
    assert talk.telemetry.touch_speed == pytest.approx(speed, nan_ok=True)


def test_the_end_of_a_mission_ends_the_hold_that_interrupts_it(talk):
    """The robot holds on, for no mission."""
    talk.wait(3_000)
    before = talk.change
    for number in (2, 3):
        ask(talk, number, Request.END)
    ended = talk.change
    assert talk.take(GuardChange).count(ended) == 1
    assert (ended.state, ended.cause) == (GuardState.HOLD, Cause.ENDED.words)
    assert talk.telemetry.cause is Cause.ENDED
    talk.wait(4_000)
    live = LiveMetrics("world")
    live.see(talk.records)
    assert live.read()["cloudrc_guard_holds_total"] == {(): 1}
    held = (ended.stamp_ns - before.stamp_ns) * 1e-9
    assert live.read()["cloudrc_guard_held_seconds_total"] == {(): pytest.approx(held)}
    assert 2 < held < 4


def test_commands_of_an_earlier_cloud_do_not_count(talk):
    """Nine fresh commands of one cloud and one of another do not prove a link."""
    fly(talk, 100)
    talk.wait(1_000)
    fly(talk, 9)
    talk.wait(260)
    assert talk.hello("another") > 0
    fly(talk, 2)
    assert talk.change.state is GuardState.HOLD
    fly(talk, 8)
    talk.wait(10)
    assert talk.change.state is GuardState.TRACK


ID = 2**62 + 5


def progress(talk, request, number=0, *, start=Start.HERE, **fields):
    """Return the mission and the progress that the robot shows after a request."""
    talk.send(talk.speaker.ask(number, request, start, basis_ns=talk.now_ns, **fields))
    talk.wait(20)
    return talk.telemetry.mission_id, talk.telemetry.reached


def test_progress_rises_and_belongs_to_the_mission_started_last():
    talk = Bare(ring(), flies=True)
    talk.hello("cloud")
    for expected, request, number, fields in (
        ((0, 0), Request.PROGRESS, 0, {"mission_id": ID, "reached": 3}),
        ((ID, 0), Request.START, 1, {"mission_id": ID}),
        ((ID, 2), Request.PROGRESS, 0, {"mission_id": ID, "reached": 2}),
        ((ID, 2), Request.PROGRESS, 0, {"mission_id": ID, "reached": 1}),
        ((ID, 2), Request.PROGRESS, 0, {"mission_id": ID + 1, "reached": 9}),
        ((ID, 2), Request.END, 2, {}),
        ((ID, 2), Request.START, 3, {"mission_id": ID}),  # the same mission continues
    ):
        assert progress(talk, request, number, **fields) == expected
    talk.wait(2_000)  # the first cloud is not fresh any more
    talk.hello("another")
    assert progress(talk, Request.END, 1) == (ID, 2)
    assert progress(talk, Request.START, 2, mission_id=ID + 1) == (ID + 1, 0)
    progress(talk, Request.PROGRESS, mission_id=ID + 1, reached=2)
    # From the spawn a mission begins anew.
    assert progress(talk, Request.START, 3, mission_id=ID + 1, start=Start.SPAWN) == (ID + 1, 0)
