"""Without an epoch from the disk, only requests that need a new epoch are refused."""

import pytest

from cloudrc.messages import GuardState, Request, Start
from cloudrc.records import Fault, TelemetrySent
from cloudrc.tunnel.handshake import NO_EPOCH_TEXT
from tests.flights.conftest import MS, talking


@pytest.fixture
def disk() -> list[int]:
    """The epochs that the disk has."""
    return []


@pytest.fixture
def talk(disk):
    talk = talking()
    talk.world._door._next_epoch = lambda: disk.pop() if disk else None
    fly(talk)
    return talk


def fly(talk):
    for _ in range(10):
        talk.send(talk.command())
        talk.wait(talk.now_ns + 10 * MS)
    return talk.take(TelemetrySent)[-1].telemetry


def told(talk):
    return [fault.text for fault in talk.take(Fault)]


def test_a_cloud_gets_a_session_as_soon_as_an_epoch_exists(talk, disk):
    for _ in range(3):
        talk.wait(talk.now_ns + 1_100 * MS)  # the previous cloud is silent by now
        assert talk.hello(b"two") == 0
    assert told(talk) == [NO_EPOCH_TEXT]
    assert talk.world._session.epoch == 1
    disk.append(2)
    talk.wait(talk.now_ns + 1_100 * MS)
    assert talk.hello(b"two") == 2


def test_only_a_start_from_the_spawn_waits_for_an_epoch(talk, disk):
    for number in (2, 3):
        talk.request(number, Request.START, Start.SPAWN, mission_id=7)
        telemetry = fly(talk)
        assert (telemetry.mission, telemetry.mission_id) == (1, 0)
        assert telemetry.guard is GuardState.TRACK
    assert told(talk) == [NO_EPOCH_TEXT]
    assert talk.counts()["start_refused"] == 2
    disk.append(2)
    talk.request(3, Request.START, Start.SPAWN, mission_id=7)
    assert talk.world._session.epoch == 2
    assert talk.world._orders.mission_id == 7


def test_requests_that_need_no_epoch_are_obeyed(talk):
    talk.request(2, Request.END, Start.SPAWN)
    talk.request(3, Request.START, Start.HERE)
    talk.request(4, Request.ESTOP, Start.SPAWN)
    assert fly(talk).guard is GuardState.ESTOP
    assert told(talk) == []
