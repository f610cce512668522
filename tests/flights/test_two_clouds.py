# SPDX-License-Identifier: Apache-2.0

"""Two clouds and one robot: which cloud has authority, and that no command is reverted."""

from itertools import product

import pytest

from cloudrc.wire.records import Arrival
from cloudrc.wire.tunnel.codec import Kind
from tests.flights.conftest import Bare, both_ways, fly, ring

pytestmark = pytest.mark.usefixtures("shared_files")


@pytest.fixture
def bare():
    """Provide a world with a session of the cloud "a"."""
    bare = Bare(ring())
    bare.hello("a")
    return bare


@pytest.mark.promise("one-cloud-flies")
@pytest.mark.parametrize("alive", [True, False])
def test_the_incumbent_keeps_authority_while_it_is_heard(bare, alive):
    cloud = bare.speaker
    for _ in range(20):
        bare.wait(200)
        bare.send(cloud.session.seal(Kind.ALIVE, b"") if alive else cloud.command(bare.now_ns))
        assert bare.hello("b") == 0
    assert "BUSY" in bare.cloud("b").heard
    assert bare.world.counts["busy"] == 20
    assert bare.world.epoch == 1


@pytest.mark.parametrize(
    ("heard", "silence", "epoch"),
    [(True, 250, 1), (True, 251, 2), (False, 1000, 1), (False, 1001, 2)],
)
def test_a_silent_incumbent_loses_authority(bare, heard, silence, epoch):
    """At the age limit; a new session has one second to be heard. Copies count for nothing."""
    command = bare.command()
    if heard:
        bare.send(command)
    bare.wait(silence - 1)
    bare.send(command if heard else b"")
    bare.wait(1)
    bare.hello("b")
    assert bare.world.epoch == epoch


ACTIONS = {
    "a": lambda bare: act(bare, "a"),
    "b": lambda bare: act(bare, "b"),
    "silence": lambda bare: bare.wait(260),
    "replay": lambda bare: [bare.world.receive_datagram(d, bare.now_ns) for d in list(bare.sent)],
    "restart a": lambda bare: bare.clouds.pop("a", None),
    "spawn": lambda bare: spawn(bare),
}


def act(bare, name):
    """Let a cloud command if it has a session, and ask for one in any case."""
    cloud = bare.cloud(name)
    if cloud.session.epoch:
        bare.send(cloud.command(bare.now_ns))
        bare.sent.append(cloud.command(bare.now_ns))  # the link delays it until the replay
    if cloud.session.epoch != bare.world.epoch or not cloud.session.epoch:
        bare.send(cloud.hello())


def spawn(bare):
    """Let the cloud with the session start a mission from the spawn."""
    for cloud in bare.clouds.values():
        if cloud.session.epoch == bare.world.epoch != 0:
            bare.send(cloud.start(bare.world._number + 1))


def explore(actions, depth):
    """Play all interleavings: applied counters rise, and an epoch belongs to one cloud."""
    for names in product(actions, repeat=depth):
        bare, owner = Bare(ring()), {}
        for name in names:
            ACTIONS[name](bare)
            for cloud in bare.clouds.values():
                if cloud.session.epoch:
                    assert owner.setdefault(cloud.session.epoch, cloud) is cloud, names
        applied = [(r.epoch, r.counter) for r in bare.take(Arrival) if r.used]
        assert applied == sorted(set(applied)), names


BASIC = ["a", "b", "silence", "replay"]


@pytest.mark.promise("one-cloud-flies")
def test_no_short_interleaving_reverts_a_command():
    explore(BASIC, 5)
    explore(list(ACTIONS), 3)


@pytest.mark.full
def test_no_interleaving_of_all_actions_reverts_a_command():
    explore(list(ACTIONS), 4)


def test_the_check_finds_reverted_commands(monkeypatch):
    monkeypatch.setattr("cloudrc.wire.tunnel.window.ReceiveWindow.take", lambda *_: "used")
    with pytest.raises(AssertionError):
        explore(BASIC, 4)


def test_repeated_hellos_over_a_slow_lossy_link_open_no_session():
    """Each of them is seconds old when world gets it."""
    limits = "guard.command_age_max_ms=2000", "cloud.horizon_max_s=3", "cloud.freeze_after_s=3"
    link = both_ways(delay_ms=500, jitter_ms=100, loss=0.5)
    flown = fly("hover", *link, *limits, "criteria.time_limit_s=20", "seed=3")
    session = flown.flight.recording["/session"]
    causes = session["cause"][session["end"] == "world"]
    assert list(causes) == ["cloud said hello", "mission starts from spawn"]
