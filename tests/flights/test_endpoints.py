"""The contract of both endpoints without a link: sessions, bad datagrams, restarts, stalls."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.config.load import load_experiment
from cloudrc.messages import Start
from cloudrc.records import (
    CommandApplied,
    Contact,
    GroundTruth,
    SessionOpened,
    TelemetrySent,
)
from cloudrc.teleop.wire import Leg, Plan
from cloudrc.tunnel import codec
from tests.flights.conftest import HOVER, MS, fly_on, join, talking

SHORT = load_experiment("hover", ["link.profile=ideal", "mission.waypoints.0.dwell_s=0.5"])


@pytest.fixture
def talk():
    return talking()


@pytest.mark.parametrize(
    "wakes", [(), (21_300_000,), (20_500_000, 21_300_000), (20 * MS, 20 * MS + 1)]
)
def test_a_command_is_applied_at_the_next_tick_whenever_the_driver_wakes(talk, wakes):
    for wake in wakes:
        talk.world.handle_deadline(wake)
    talk.now_ns = 21_300_000
    talk.send(talk.command(basis_ns=20 * MS))
    talk.wait(8.7)
    (applied,) = talk.take(CommandApplied)
    assert (applied.stamp_ns, applied.counter) == (22 * MS, 0)
    telemetry = talk.take(TelemetrySent)[-1].telemetry
    told = telemetry.stamp_ns, telemetry.echo_stamp_ns, telemetry.echo_hold_ns
    assert told == (30 * MS, 21_300_000, 8 * MS)


@pytest.mark.parametrize(
    ("spoil", "outcome"),
    [
        (lambda data: b"", "malformed"),
        (lambda data: data.ljust(65_000, b"x"), "malformed"),
        (lambda data: bytes([codec.VERSION + 1]) + data[1:], "version"),
        (lambda data: data[:1] + b"\0" + data[2:], "direction"),
        (lambda data: data[:2] + b"\x09" + data[3:], "old_epoch"),
        (lambda data: data[:-1] + bytes([data[-1] ^ 1]), "tag"),
    ],
)
def test_a_bad_datagram_is_dropped_and_counted(talk, spoil, outcome):
    talk.send(spoil(talk.command()))
    assert talk.counts()[outcome] == 1
    assert talk.take(CommandApplied) == []


ENDS = join(HOVER)[:2]


@given(st.binary(max_size=300))
@settings(max_examples=60, deadline=None)
def test_no_bytes_make_an_end_raise(data):
    for end in ENDS:
        end.receive_datagram(data, 0)


def test_after_a_stall_waiting_commands_are_stale(talk):
    data = talk.command()
    talk.now_ns = 60 * MS  # a short delay is caught up
    talk.world.handle_deadline(talk.now_ns)
    assert talk.world.slip_ns == 0
    stamps = [truth.stamp_ns for truth in talk.take(GroundTruth)]
    assert {b - a for a, b in pairwise(stamps)} == {10 * MS}
    talk.now_ns = 5_000 * MS  # the process stalled while the datagram was in the socket
    talk.send(data)
    assert talk.world.slip_ns > 4_000 * MS
    assert talk.counts()["stale"] == 1
    assert talk.take(CommandApplied) == []


def test_one_mission_can_follow_another_from_here():
    ends = join(SHORT)
    of_world, _ = fly_on(ends.run, 20_000 * MS, lambda: ends.cloud.mission_over)
    opened = [record for record in of_world if isinstance(record, SessionOpened)]
    assert [record.epoch for record in opened] == [1, 2], "the second for the start from the spawn"
    ends.cloud.teleop.start(ends.run.now_ns, Plan((Leg((0.5, 0.0, 1.0)),), Start.HERE))
    of_world, _ = fly_on(ends.run, 40_000 * MS, lambda: ends.cloud.mission_over)
    assert ends.cloud.teleop.outcome.event == "done"
    assert not [record for record in of_world if isinstance(record, SessionOpened | Contact)]
    assert abs(ends.world.robot.simulator.readings.position[0] - 0.5) < 0.2
