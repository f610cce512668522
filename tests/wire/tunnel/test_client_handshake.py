# SPDX-License-Identifier: Apache-2.0

"""Cloud's side of the handshake, and the faults that it causes."""

from collections import Counter

import pytest

from cloudrc.wire.records import Fault
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import Accept, Hello, Kind
from cloudrc.wire.tunnel.end import Identity, TunnelEnd
from cloudrc.wire.tunnel.handshake import (
    COOKIES_MAX,
    KEY_TEXT,
    NO_COOKIE,
    REPLIES_MAX,
    WORLDS_MAX,
    ClientHandshake,
)
from cloudrc.wire.tunnel.keys import Key, KeyRing, KeySet
from tests.flights.conftest import Bare, BareCloud, ring
from tests.wire.tunnel.conftest import CLOCK, NONCE, WORLD

NEXT_WORLD = b"v" * 16
STRANGER = KeyRing(KeySet(Key(b"x" * 32)))


class Asking:
    """A cloud's handshake with short methods for the tests."""

    def __init__(self):
        self.handshake = ClientHandshake(NONCE, CLOCK)

    def hello(self):
        return Hello(*codec.decode(Kind.HELLO, self.handshake.make_hello()))

    def accepts(self, epoch, world=WORLD, nonce=NONCE, *, asks=True):
        return self.handshake.receive_accept(epoch, Accept(nonce, world, CLOCK), asks=asks)


@pytest.fixture
def cloud():
    return Asking()


def test_a_hello_has_nonce_clock_cookie_and_newest_epoch(cloud):
    assert cloud.hello() == Hello(NONCE, CLOCK, NO_COOKIE, 0)
    assert cloud.accepts(3, nonce=b"m" * 16) is None
    assert cloud.accepts(3) == NONCE + WORLD
    answer = cloud.handshake.answer_challenge(b"1" * 13)
    assert answer is not None
    assert cloud.hello() == Hello(NONCE, CLOCK, b"1" * 13, 3)
    assert codec.decode(Kind.HELLO, answer) == cloud.hello()
    assert cloud.handshake.is_refused(NONCE)
    assert not cloud.handshake.is_refused(b"m" * 16)


def test_a_cloud_that_left_its_epoch_asks_for_a_later_one(cloud):
    """It had lost its key for a moment; counters must not start again with the same keys."""
    cloud.handshake.leave()
    assert cloud.hello().epoch == 0, "there was no epoch"
    assert cloud.accepts(3) is not None
    cloud.handshake.leave()
    assert cloud.hello().epoch == 4
    assert cloud.accepts(3) is None
    assert cloud.accepts(4) is not None, "which world began meanwhile"
    assert cloud.hello().epoch == 4


def test_repeated_challenges_get_a_limited_number_of_answers(cloud):
    answer = cloud.handshake.answer_challenge
    assert answer(b"0" * 13) is None, "it has not asked"
    cloud.hello()
    assert sum(answer(b"%013d" % n) is not None for n in range(50)) == REPLIES_MAX
    cloud.hello()
    old = [b"%013d" % n for n in range(REPLIES_MAX)]
    assert [answer(cookie) for cookie in 100 * old] == 300 * [None], "old ones use up no answers"
    assert answer(b"%013d" % 49), "one that got no answer is new"
    assert answer(b"1" * 13)
    assert [answer(cookie) for cookie in old] == REPLIES_MAX * [None]
    assert cloud.hello().cookie == b"1" * 13


def test_the_memory_of_cookies_and_worlds_is_bounded(cloud):
    for number in range(COOKIES_MAX + 1):
        cloud.hello()
        cloud.handshake.answer_challenge(b"%013d" % number)
        cloud.accepts(1, b"%016d" % number)
    assert len(cloud.handshake._cookies) == COOKIES_MAX
    assert cloud.handshake.answer_challenge(b"%013d" % 1) is None
    assert cloud.handshake.answer_challenge(b"%013d" % 0)
    assert len(cloud.handshake._old_worlds) == WORLDS_MAX


@pytest.mark.parametrize(
    ("known", "epoch", "counts"),
    [
        *((3, 3, False), (3, 4, True), (2**32 - 1, 1, True)),
        *((1, 2**31, True), (1, 1 + 2**31, False)),  # half of all epochs are newer
    ],
)
def test_of_one_world_only_a_newer_epoch_counts(cloud, known, epoch, counts):
    cloud.handshake._world, cloud.handshake._epoch = WORLD, known
    assert (cloud.accepts(epoch) is not None) == counts


@pytest.mark.promise("old-datagrams-do-nothing")
def test_a_dead_world_does_not_come_back(cloud):
    cloud.accepts(3)
    assert cloud.accepts(1, NEXT_WORLD, asks=False) is None, "cloud hears its world"
    assert cloud.accepts(4, asks=False)
    assert cloud.accepts(5, asks=False)
    assert cloud.accepts(1, NEXT_WORLD), "a new process may begin with epoch 1"
    assert cloud.accepts(9) is None
    assert cloud.accepts(5, NEXT_WORLD, cloud.hello().nonce)


def test_a_living_world_that_counts_as_dead_gets_a_new_nonce(cloud):
    """Without a session, cloud has accepted a late datagram of a world that has ended."""
    cloud.accepts(3, NEXT_WORLD)
    cloud.accepts(9)
    assert cloud.accepts(3, NEXT_WORLD) is None  # alive, and answers
    nonce = cloud.hello().nonce
    assert nonce != NONCE
    assert cloud.accepts(9) is None  # the late datagram again
    assert cloud.accepts(4, NEXT_WORLD, nonce)
    assert cloud.hello().nonce == nonce


@pytest.mark.parametrize(("code", "text"), [("version", "v5, we speak v8: "), ("key", KEY_TEXT)])
def test_another_version_or_key_is_logged_once(code, text):
    bare = Bare(ring())
    old = bytes([5]) + bare.cloud("a").hello()[1:]
    data = old if code == "version" else BareCloud(b"a", STRANGER).hello()
    for _ in range(3):
        bare.world.receive_datagram(data, 0)
    (fault,) = [one for one in bare.world.take_records() if isinstance(one, Fault)]
    assert (fault.code, text in fault.text) == (code, True)
    assert "link.*.corrupt" in fault.text, "a flipped bit looks alike"
    assert bare.world.take_datagrams() == []
    bare.send(bare.cloud("a").hello())
    bare.world.take_records()
    bare.world.receive_datagram(data, 0)
    assert bare.world.take_records() == [], "within a session garbage is only counted"


def test_a_text_is_told_once_in_a_session():
    end = TunnelEnd(
        Identity(CLOCK, NONCE, ring()), codec.Direction.UPLINK, Counter(), newest_wins=True
    )
    for data in (bytes(16), bytes([4]) + bytes(15), bytes(16)):
        end._tell_refusal("version", data, 7)
    end._tell_refusal("malformed", bytes(16), 7)
    assert len(end.take_records()) == 2, "garbage does not hide the peer's version"
    for kind in Kind:
        end._told.clear()
        end._tell_refusal("tag", codec.encode_header(kind, 1, 1, 1), 7)
        assert end.take_records() == [Fault(7, "key", KEY_TEXT)] * (kind <= Kind.BUSY)
