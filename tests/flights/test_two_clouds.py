"""Two clouds and one robot: which cloud has authority, and that no command is reverted."""

from itertools import product

import pytest

from cloudrc.tunnel.codec import Kind
from tests.flights.conftest import Bare, ring


def a_session(name: str = "a", bare: Bare | None = None) -> Bare:
    bare = bare or Bare(ring())
    bare.send(bare.cloud(name).hello())
    return bare


def test_a_hello_brings_a_session_in_two_round_trips():
    bare = a_session()
    assert bare.cloud("a").heard == ["CHALLENGE", "ACCEPT"]
    assert bare.cloud("a").session.epoch == bare.world._session.epoch == 1


@pytest.mark.promise("one-cloud-flies")
def test_the_incumbent_keeps_authority_while_it_is_heard():
    bare = a_session()
    for _ in range(20):
        bare.wait(200)
        bare.send(bare.cloud("a").command(bare.now_ns))
        bare.send(bare.cloud("b").hello())
    assert bare.cloud("b").session.epoch == 0
    assert "BUSY" in bare.cloud("b").heard
    assert bare.world._counts["busy"] == 20
    assert bare.world._session.epoch == 1


@pytest.mark.parametrize(("silence", "epoch"), [(250, 1), (251, 2)])
def test_a_silent_incumbent_loses_authority_at_the_age_limit(silence, epoch):
    bare = a_session()
    bare.send(bare.cloud("a").command())
    bare.cloud("b")
    bare.wait(silence)
    bare.send(bare.cloud("b").hello())
    assert bare.world._session.epoch == epoch


@pytest.mark.parametrize(("silence", "epoch"), [(1000, 1), (1001, 2)])
def test_a_new_session_has_one_second_to_be_heard(silence, epoch):
    bare = a_session()
    bare.wait(silence)
    bare.send(bare.cloud("b").hello())
    assert bare.world._session.epoch == epoch


def test_an_idle_cloud_keeps_authority_by_alive_datagrams():
    bare = a_session()
    for _ in range(10):
        bare.wait(200)
        bare.send(bare.cloud("a").session.seal(Kind.ALIVE, b""))
        bare.send(bare.cloud("b").hello())
    assert bare.world._session.epoch == 1


def test_repeated_datagrams_do_not_keep_authority():
    bare = a_session()
    cloud = bare.cloud("a")
    captured = [cloud.session.seal(Kind.ALIVE, b""), cloud.command(), cloud.start(0)]
    for data in captured:
        bare.send(data)
    bare.wait(200)
    for data in captured:
        bare.send(data)
    bare.wait(100)
    bare.send(bare.cloud("b").hello())
    assert bare.world._session.epoch == 2


def test_a_cloud_regains_authority_under_a_new_epoch():
    bare = a_session()
    bare.wait(1100)
    a_session("b", bare)
    bare.wait(1100)
    bare.send(bare.cloud("a").hello())
    assert bare.cloud("a").session.epoch == bare.world._session.epoch == 3


def test_a_new_cloud_has_a_session_within_a_second():
    bare = a_session()
    bare.send(bare.cloud("a").command())
    tries = 0
    while not bare.cloud("b").session.epoch:
        tries += 1
        bare.wait(100)
        bare.send(bare.cloud("b").hello())
    assert tries == 3


def test_a_captured_hello_of_a_dead_cloud_opens_nothing():
    bare = a_session()
    captured = list(bare.sent)
    del bare.clouds["a"]
    bare.wait(1100)
    a_session("b", bare)
    bare.wait(1100)  # b is silent, and the cookie is still valid
    for data in captured:
        bare.send(data)
    bare.wait(5000)  # and now it is no longer valid
    for data in captured:
        bare.send(data)
    assert bare.world._session.epoch == 2


def test_hellos_that_waited_through_a_stall_are_not_answered():
    bare = a_session()
    bare.now_ns += 5_000_000_000
    outcome = bare.outcome(bare.cloud("b").hello())
    assert outcome["stale"] == 1
    assert "hello" not in outcome


ACTIONS = {
    "a": lambda bare: act(bare, "a"),
    "b": lambda bare: act(bare, "b"),
    "silence": lambda bare: bare.wait(260),
    "replay": lambda bare: [bare.world.receive_datagram(d, bare.now_ns) for d in list(bare.sent)],
    "restart a": lambda bare: bare.clouds.pop("a", None),
    "spawn": lambda bare: spawn(bare),
}


def act(bare: Bare, name: str) -> None:
    """Let a cloud command if it has a session, and ask for one in any case."""
    cloud = bare.cloud(name)
    if cloud.session.epoch:
        bare.send(cloud.command(bare.now_ns))
        cloud.held = cloud.command(bare.now_ns)  # the link delays it until the replay
        bare.sent.append(cloud.held)
    if cloud.session.epoch != bare.world._session.epoch or not cloud.session.epoch:
        bare.send(cloud.hello())


def spawn(bare: Bare) -> None:
    """Let the cloud with the session start a mission from the spawn."""
    for cloud in bare.clouds.values():
        if cloud.session.epoch == bare.world._session.epoch != 0:
            bare.send(cloud.start(bare.world._orders.number + 1))


def check(names: tuple[str, ...]) -> None:
    """Play one interleaving: applied counters rise, and an epoch belongs to one cloud."""
    bare, applied, owner = Bare(ring()), [], {}
    for name in names:
        ACTIONS[name](bare)
        applied += bare.used()
        for cloud in bare.clouds.values():
            if cloud.session.epoch:
                assert owner.setdefault(cloud.session.epoch, cloud) is cloud, names
    assert applied == sorted(set(applied)), names


def explore(actions: list[str], depth: int) -> int:
    played = 0
    for names in product(actions, repeat=depth):
        check(names)
        played += 1
    return played


BASIC = ["a", "b", "silence", "replay"]
BACK = "two-cloud interleavings to depth {}: commands that go back"


@pytest.mark.promise("one-cloud-flies")
def test_no_short_interleaving_reverts_a_command(figure):
    assert explore(BASIC, 5) == 4**5
    assert explore(list(ACTIONS), 4) == 6**4
    figure(BACK.format("5"), 0, "==", 0, count=4**5)


def test_the_check_finds_reverted_commands(monkeypatch):
    monkeypatch.setattr("cloudrc.tunnel.channel.Channel.take", lambda channel, counter: "used")
    with pytest.raises(AssertionError):
        explore(BASIC, 4)


@pytest.mark.full
@pytest.mark.parametrize("first", list(product(BASIC, repeat=2)))
def test_no_interleaving_of_ten_reverts_a_command(first, figure):
    for names in product(BASIC, repeat=8):
        check(first + names)
    figure(BACK.format("10"), 0, "==", 0, count=4**8)


@pytest.mark.full
@pytest.mark.parametrize("first", list(ACTIONS))
def test_no_interleaving_of_7_with_restarts_reverts_a_command(first):
    for names in product(ACTIONS, repeat=6):
        check((first, *names))
