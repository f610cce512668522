"""Cloud's side of the handshake, and the log of why there is no session."""

from __future__ import annotations

import pytest

from cloudrc.records import Fault
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Accept, Hello, Kind
from cloudrc.tunnel.handshake import (
    COOKIES_MAX,
    KEY_TEXT,
    NO_COOKIE,
    REPLIES_MAX,
    WORLDS_MAX,
    ClientHandshake,
    HandshakeLog,
)
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from tests.flights.conftest import Bare, BareCloud, ring
from tests.tunnel.conftest import CLOCK, NONCE, WORLD

NEXT_WORLD = b"v" * 16
STRANGER = KeyRing(KeySet(Key(b"x" * 32)))


@pytest.fixture
def handshake() -> ClientHandshake:
    return ClientHandshake(NONCE, CLOCK)


def hello(handshake: ClientHandshake) -> Hello:
    return codec.decode_hello(handshake.make_hello())


def accepted(
    handshake: ClientHandshake,
    epoch: int,
    world: bytes = WORLD,
    nonce: bytes = NONCE,
    *,
    asks: bool = True,
) -> bytes | None:
    return handshake.receive_accept(epoch, Accept(nonce, world, CLOCK), asks=asks)


def test_a_hello_has_nonce_clock_cookie_and_newest_epoch(handshake: ClientHandshake) -> None:
    assert hello(handshake) == Hello(NONCE, CLOCK, NO_COOKIE, 0)
    assert accepted(handshake, 3) == NONCE + WORLD
    answer = handshake.answer_challenge(b"1" * 13)
    assert answer is not None
    assert codec.decode_hello(answer) == hello(handshake) == Hello(NONCE, CLOCK, b"1" * 13, 3)


def test_repeated_challenges_get_a_limited_number_of_answers(handshake: ClientHandshake) -> None:
    assert handshake.answer_challenge(b"0" * 13) is None  # it has not asked
    handshake.make_hello()
    answers = [handshake.answer_challenge(b"%013d" % n) for n in range(50)]
    assert sum(answer is not None for answer in answers) == REPLIES_MAX
    handshake.make_hello()
    assert handshake.answer_challenge(b"%013d" % 49)


def test_repeated_old_challenges_use_up_no_answers(handshake: ClientHandshake) -> None:
    old = [b"old %d" % n for n in range(REPLIES_MAX)]
    handshake.make_hello()
    assert all(handshake.answer_challenge(cookie) for cookie in old)
    handshake.make_hello()
    assert [handshake.answer_challenge(cookie) for cookie in 100 * old] == 300 * [None]
    assert handshake.answer_challenge(b"1" * 13)
    assert [handshake.answer_challenge(cookie) for cookie in old] == REPLIES_MAX * [None]
    assert hello(handshake).cookie == b"1" * 13


def test_the_memory_of_cookies_and_worlds_is_bounded(handshake: ClientHandshake) -> None:
    for number in range(COOKIES_MAX + 1):
        handshake.make_hello()
        handshake.answer_challenge(b"%013d" % number)
        accepted(handshake, 1, b"%016d" % number)
    assert len(handshake._cookies) == COOKIES_MAX
    assert handshake.answer_challenge(b"%013d" % 1) is None
    assert handshake.answer_challenge(b"%013d" % 0)
    assert len(handshake._old_worlds) == WORLDS_MAX


@pytest.mark.parametrize(
    ("known", "epoch", "counts"),
    [
        *((3, 2, False), (3, 3, False), (3, 4, True)),
        *((1, 2**31, True), (1, 1 + 2**31, False)),  # half of all epochs are newer
        *((2**32 - 1, 2**32 - 2, False), (2**32 - 1, 1, True)),
    ],
)
def test_of_one_world_only_a_newer_epoch_counts(
    handshake: ClientHandshake, known: int, epoch: int, counts: bool
) -> None:
    handshake._world, handshake._epoch = WORLD, known
    assert (accepted(handshake, epoch) is not None) == counts


@pytest.mark.promise("old-datagrams-do-nothing")
def test_a_dead_world_does_not_come_back(handshake: ClientHandshake) -> None:
    accepted(handshake, 3)
    assert accepted(handshake, 1, NEXT_WORLD, asks=False) is None, "cloud hears its world"
    assert accepted(handshake, 4, asks=False)
    assert accepted(handshake, 5, asks=False)
    assert accepted(handshake, 1, NEXT_WORLD), "a new process may begin with epoch 1"
    assert accepted(handshake, 9) is None
    assert accepted(handshake, 5, NEXT_WORLD, hello(handshake).nonce)


def test_a_living_world_that_counts_as_dead_gets_a_new_nonce(handshake: ClientHandshake) -> None:
    """Cloud has accepted a late datagram of a dead world while it heard nobody."""
    accepted(handshake, 3, NEXT_WORLD)
    accepted(handshake, 9)
    assert accepted(handshake, 3, NEXT_WORLD) is None  # alive, and answers
    nonce = hello(handshake).nonce
    assert nonce != NONCE
    assert accepted(handshake, 9) is None  # the late datagram again
    assert accepted(handshake, 4, NEXT_WORLD, nonce)
    assert hello(handshake).nonce == nonce


def test_answers_for_another_nonce_are_ignored(handshake: ClientHandshake) -> None:
    assert accepted(handshake, 3, nonce=b"m" * 16) is None
    assert handshake.is_refused(NONCE)
    assert not handshake.is_refused(b"m" * 16)


def faults(bare: Bare) -> list[Fault]:
    return [record for record in bare.world.take_records() if isinstance(record, Fault)]


@pytest.mark.parametrize(
    ("data", "code", "text"),
    [
        (lambda: bytes([5]) + Bare(ring()).cloud("a").hello()[1:], "version", "v5, we speak v6: "),
        (lambda: BareCloud(b"a", STRANGER).hello(), "key", "same key file"),
    ],
)
def test_another_version_or_key_is_logged_once(data: object, code: str, text: str) -> None:
    bare, hello = Bare(ring()), data()  # type: ignore[operator]
    for _ in range(3):
        bare.world.receive_datagram(hello, 0)
    (fault,) = faults(bare)
    assert (fault.code, text in fault.text) == (code, True)
    assert bare.world.take_datagrams() == []


def test_within_a_session_garbage_is_only_counted() -> None:
    bare = Bare(ring())
    bare.send(bare.cloud("a").hello())
    bare.world.receive_datagram(BareCloud(b"b", STRANGER).hello(), 0)
    assert faults(bare) == []
    assert bare.world._counts["tag"] == 1


def test_only_another_version_and_a_wrong_key_are_logged() -> None:
    for outcome in ("malformed", "direction", "old_epoch"):
        assert HandshakeLog().about(outcome, bytes(16), 0) == []
    for kind in Kind:
        data = codec.encode_header(kind, 1, 1, 1)
        said = [Fault(7, "key", KEY_TEXT)] if kind <= Kind.BUSY else []
        assert HandshakeLog().about("tag", data, 7) == said


def test_a_text_is_logged_once_in_a_session() -> None:
    log = HandshakeLog()
    assert len(log.about("version", bytes(16), 7)) == 1
    (fault,) = log.about("version", bytes([4]) + bytes(15), 8)  # garbage does not hide the peer's
    assert fault.text.startswith("peer speaks v4, ")
    assert log.say("version", fault.text, 8) == []
    log.forget()
    assert log.say("version", fault.text, 9) == [Fault(9, "version", fault.text)]
