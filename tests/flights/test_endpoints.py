"""The contract of both endpoints without a link: sessions, bad datagrams, restarts, stalls."""

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc import assembly
from cloudrc.cloud.endpoint import CloudIdentity
from cloudrc.config.load import load_experiment
from cloudrc.messages import GuardState
from cloudrc.records import (
    Arrival,
    CommandApplied,
    Contact,
    Control,
    Counted,
    GroundTruth,
    GuardChange,
    SessionOpened,
    TelemetrySent,
)
from cloudrc.tunnel import codec
from cloudrc.world.endpoint import WorldIdentity
from tests.flights.conftest import MS, SHARED_CLOCK, Talk, join, records, talking

EXPERIMENT = load_experiment("hover", ["link.profile=ideal"])


@pytest.fixture
def talk():
    return talking()


def test_without_a_session_world_is_silent():
    talk = Talk()
    talk.wait(100 * MS)
    assert talk.world.take_datagrams() == []


def test_every_cloud_process_gets_a_new_epoch():
    talk, epochs = Talk(last_epoch=41), []
    for nonce in (b"one", b"one", b"two", b"two", b"three"):
        talk.wait(talk.now_ns + 1_100 * MS)  # the previous cloud is silent by now
        epochs.append(talk.hello(nonce))
    assert epochs == [42, 42, 43, 43, 44]


def test_a_command_is_applied_at_the_next_tick(talk):
    talk.wait(21_300_000)
    talk.send(talk.command(basis_ns=20 * MS))
    talk.wait(40 * MS)
    (applied,) = talk.take(CommandApplied)
    assert (applied.stamp_ns, applied.counter) == (22 * MS, 0)


def test_telemetry_echoes_the_command_and_how_long_it_was_held(talk):
    talk.now_ns = 21_300_000
    talk.send(talk.command(basis_ns=20 * MS))
    talk.wait(30 * MS)
    telemetry = talk.take(TelemetrySent)[-1].telemetry
    assert telemetry.stamp_ns == 30 * MS
    assert telemetry.echo_stamp_ns == 21_300_000
    assert telemetry.echo_hold_ns == 8 * MS


@pytest.mark.parametrize("wakes", [(21_300_000,), (20_500_000, 21_300_000), (20 * MS, 20 * MS + 1)])
def test_the_flight_does_not_depend_on_when_the_driver_wakes(talk, wakes):
    for wake in wakes:
        talk.world.handle_deadline(wake)
    talk.now_ns = 21_300_000
    talk.send(talk.command(basis_ns=20 * MS))
    talk.wait(200 * MS)
    last = talk.take(GroundTruth)[-1]
    other = talking()
    other.now_ns = 21_300_000
    other.send(other.command(basis_ns=20 * MS))
    other.wait(200 * MS)
    assert other.take(GroundTruth)[-1] == last


def test_late_and_repeated_commands_are_counted_and_not_flown(talk):
    first, second = talk.command((0.0, 0.0, 1.0)), talk.command((0.0, 0.0, 2.0))
    for data in (second, first, second):
        talk.send(data)
    counts = talk.counts()
    assert (counts["used"], counts["late"], counts["repeated"]) == (1, 1, 1)
    assert [applied.velocity for applied in talk.take(CommandApplied)] == [(0.0, 0.0, 2.0)]
    assert [arrival.used for arrival in talk.take(Arrival)] == [True, False, False]


@pytest.mark.parametrize(
    ("spoil", "outcome"),
    [
        (lambda data: data[:-1], "malformed"),
        (lambda data: data[:7], "malformed"),
        (lambda data: b"", "malformed"),
        (lambda data: data + b"x", "malformed"),
        (lambda data: data.ljust(65_000, b"x"), "malformed"),
        (lambda data: bytes([codec.VERSION + 1]) + data[1:], "version"),
        (lambda data: data[:1] + b"\0" + data[2:], "direction"),
        (lambda data: data[:2] + b"\x09" + data[3:], "old_epoch"),
        (lambda data: data[:6] + b"\x01" + data[7:], "tag"),
        (lambda data: data[:8] + b"\x09" + data[9:], "tag"),
        (lambda data: data[:30] + b"\x09" + data[31:], "tag"),
        (lambda data: data[:-1] + bytes([data[-1] ^ 1]), "tag"),
    ],
)
def test_a_bad_datagram_is_dropped_and_counted(talk, spoil, outcome):
    talk.send(spoil(talk.command()))
    assert talk.counts()[outcome] == 1
    assert talk.take(CommandApplied) == []


def test_absurd_and_stale_commands_are_refused_and_counted(talk):
    talk.wait(500 * MS)
    talk.send(talk.command((float("nan"), 0.0, 0.0)))
    talk.send(talk.command(basis_ns=100 * MS))
    counts = talk.counts()
    assert (counts["range"], counts["stale"]) == (1, 1)
    assert [change.state for change in talk.take(GuardChange)] == []


def test_after_a_stall_waiting_commands_are_stale(talk):
    data = talk.command()
    talk.now_ns = 5_000 * MS  # the process stalled while the datagram was in the socket
    talk.send(data)
    assert talk.world.slip_ns > 4_000 * MS
    assert talk.counts()["stale"] == 1
    assert talk.take(CommandApplied) == []


def test_a_short_delay_is_caught_up_without_slipping(talk):
    talk.now_ns = 60 * MS
    talk.world.handle_deadline(talk.now_ns)
    assert talk.world.slip_ns == 0
    stamps = [truth.stamp_ns for truth in talk.take(GroundTruth)]
    assert {b - a for a, b in pairwise(stamps)} == {10 * MS}


def test_a_start_from_the_spawn_begins_a_new_epoch():
    ends = join(load_experiment("hover", ["link.profile=ideal", "mission.waypoints.0.dwell_s=0.5"]))
    of_world = []
    ends.run.fly(lambda: ends.cloud.mission_over, 20_000 * MS, lambda w, c: of_world.extend(w))
    opened = [record for record in of_world if isinstance(record, SessionOpened)]
    assert [record.epoch for record in opened] == [1, 2]
    assert opened[1].cause == "mission starts from spawn"
    states = [record.state for record in of_world if isinstance(record, GuardChange)]
    assert states == [GuardState.GROUND, GuardState.TRACK, GuardState.HOLD]


def test_one_mission_can_follow_another_from_here():
    from cloudrc.messages import Start
    from cloudrc.teleop.wire import Leg, Plan

    ends = join(load_experiment("hover", ["mission.waypoints.0.dwell_s=0.5"]))
    done = lambda: ends.cloud.mission_over  # noqa: E731
    ends.run.fly(done, 20_000 * MS, lambda w, c: None)
    plan = Plan((Leg((0.5, 0.0, 1.0)),), Start.HERE)
    ends.cloud.teleop.start(ends.run.now_ns, plan)
    of_world = []
    ends.run.fly(done, 40_000 * MS, lambda w, c: of_world.extend(w))
    assert ends.cloud.teleop.outcome.success
    assert not [record for record in of_world if isinstance(record, SessionOpened)]
    assert not [record for record in of_world if isinstance(record, Contact)]
    assert abs(ends.world.robot.simulator.readings.position[0] - 0.5) < 0.2


def fly_with_restart(restart):
    """Hover, replace one end by a new process at 2 s, and return the records of both ends."""
    ends = join(load_experiment("hover", ["mission.waypoints.0.dwell_s=8"]))
    of_world, of_cloud = [], []

    def sink(w, c):
        of_world.extend(w)
        of_cloud.extend(c)

    ends.run.fly(lambda: ends.run.now_ns >= 2_000 * MS, 60_000 * MS, sink)
    new = restart(ends)
    ends.run.fly(lambda: new.cloud.mission_over, 8_000 * MS, sink)
    return new, of_world, of_cloud


def test_a_restart_of_world_fails_the_mission():
    def restart(ends):
        identity = WorldIdentity(SHARED_CLOCK, b"another world".ljust(16), last_epoch=2)
        world = assembly.build_world(EXPERIMENT, identity, lambda: ends.run.now_ns)
        ends.run._world = world
        return ends._replace(world=world)

    ends, of_world, _ = fly_with_restart(restart)
    assert [r.epoch for r in of_world if isinstance(r, SessionOpened)] == [1, 2, 3]
    assert ends.cloud.teleop.outcome.code == "world_restarted"


def test_a_restarted_cloud_gets_a_new_epoch_and_flies():
    def restart(ends):
        identity = CloudIdentity(SHARED_CLOCK, b"another cloud".ljust(16))
        experiment = load_experiment(
            "hover", ["mission.start=here", "mission.waypoints.0.dwell_s=1"]
        )
        cloud = assembly.build_cloud(experiment, identity, lambda: ends.run.now_ns)
        ends.run._cloud = cloud
        return ends._replace(cloud=cloud)

    ends, of_world, of_cloud = fly_with_restart(restart)
    assert [r.epoch for r in of_world if isinstance(r, SessionOpened)] == [1, 2, 3]
    assert ends.cloud.teleop.outcome.success
    first = next(r for r in of_cloud if isinstance(r, Control) and r.epoch == 3)
    assert (first.counter, first.horizon) == (0, 0.0)


@given(st.binary(max_size=300))
@settings(max_examples=60, deadline=None)
def test_no_bytes_make_an_end_raise(data):
    for end in GARBAGE_TAKERS:
        end.receive_datagram(data, 0)


GARBAGE_TAKERS = join(EXPERIMENT)[:2]


def test_a_duplicating_link_changes_nothing_but_counts():
    hover = ["link.profile=ideal", "mission.waypoints.0.dwell_s=0.5"]
    twice = [f"link.{way}.duplicate=1.0" for way in ("uplink", "downlink")]
    plain, doubled = (records(load_experiment("hover", s)) for s in (hover, hover + twice))
    truths = [[r for r in run[0] if isinstance(r, GroundTruth)] for run in (plain, doubled)]
    assert truths[0] == truths[1]
    last = {r.name: r.total for r in doubled[0] if isinstance(r, Counted)}
    assert last["repeated"] > 100
