"""Cloud's side of the handshake: its hellos, and which answers it accepts."""

import pytest

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Accept, Busy, Hello
from cloudrc.tunnel.handshake import COOKIES_MAX, LEFT_MAX, NO_COOKIE, REPLIES_MAX, ClientHandshake
from cloudrc.tunnel.session import AES_256_GCM, CHACHA20_POLY1305, Agreement

NONCE, CLOCK, WORLD = b"n" * 16, b"c" * 16, b"w" * 16


@pytest.fixture
def handshake():
    return ClientHandshake(NONCE, CLOCK, CHACHA20_POLY1305)


def test_a_hello_has_nonce_clock_cookie_and_suite(handshake):
    hello = codec.decode_hello(handshake.make_hello())
    assert hello == Hello(NONCE, CLOCK, NO_COOKIE, CHACHA20_POLY1305)


def test_answers_and_later_hellos_have_the_cookie(handshake):
    handshake.make_hello()
    answer = handshake.answer_challenge(b"1" * 16)
    assert answer is not None
    assert codec.decode_hello(answer).cookie == b"1" * 16
    assert codec.decode_hello(handshake.make_hello()).cookie == b"1" * 16


def test_repeated_challenges_get_a_limited_number_of_answers(handshake):
    assert handshake.answer_challenge(b"0" * 16) is None  # it has not asked
    handshake.make_hello()
    assert handshake.answer_challenge(b"1" * 16)
    assert handshake.answer_challenge(b"1" * 16) is None
    answers = [handshake.answer_challenge(b"%016d" % n) for n in range(50)]
    assert sum(answer is not None for answer in answers) == REPLIES_MAX - 1


def test_repeated_old_challenges_use_up_no_answers(handshake):
    old = [b"old %d" % n for n in range(REPLIES_MAX)]
    handshake.make_hello()
    assert all(handshake.answer_challenge(cookie) for cookie in old)
    handshake.make_hello()
    assert [handshake.answer_challenge(cookie) for cookie in 100 * old] == 300 * [None]
    answer = handshake.answer_challenge(b"1" * 16)
    assert codec.decode_hello(answer).cookie == b"1" * 16
    assert [handshake.answer_challenge(cookie) for cookie in old] == REPLIES_MAX * [None]
    assert codec.decode_hello(handshake.make_hello()).cookie == b"1" * 16


def test_a_cookie_beyond_the_limit_is_answered_next_time(handshake):
    handshake.make_hello()
    for number in range(REPLIES_MAX):
        handshake.answer_challenge(b"old %d" % number)
    assert handshake.answer_challenge(b"1" * 16) is None
    handshake.make_hello()
    assert handshake.answer_challenge(b"1" * 16)


def test_the_memory_of_cookies_is_bounded(handshake):
    for number in range(COOKIES_MAX + 1):
        handshake.make_hello()
        handshake.answer_challenge(b"%016d" % number)
    assert len(handshake._cookies) == COOKIES_MAX
    assert handshake.answer_challenge(b"%016d" % 1) is None
    assert handshake.answer_challenge(b"%016d" % 0)


def accept(nonce=NONCE, world=WORLD, suite=AES_256_GCM):
    return Accept(nonce, world, CLOCK, suite)


def accepted(handshake, epoch, answer, current, *, asks=True):
    return handshake.receive_accept(epoch, answer, current, asks=asks)


def test_an_acceptance_gives_the_agreement(handshake):
    agreement = accepted(handshake, 3, accept(suite=CHACHA20_POLY1305), 0)
    assert agreement == Agreement(NONCE, WORLD, CHACHA20_POLY1305)


@pytest.mark.parametrize(("epoch", "counts"), [(2, False), (3, False), (4, True)])
def test_of_one_world_only_a_newer_epoch_counts(handshake, epoch, counts):
    accepted(handshake, 3, accept(), 0)
    assert (accepted(handshake, epoch, accept(), 3) is not None) == counts


@pytest.mark.parametrize(("ahead", "counts"), [(2**31 - 1, True), (2**31, False)])
def test_half_of_all_epochs_are_newer(handshake, ahead, counts):
    accepted(handshake, 1, accept(), 0)
    assert (accepted(handshake, 1 + ahead, accept(), 1) is not None) == counts


def test_a_new_world_process_may_begin_with_epoch_1(handshake):
    accepted(handshake, 3, accept(), 0)
    assert accepted(handshake, 1, accept(world=b"v" * 16), 3)


@pytest.mark.promise("old-datagrams-do-nothing")
def test_a_dead_world_does_not_come_back(handshake):
    accepted(handshake, 3, accept(), 0)
    accepted(handshake, 4, accept(world=b"v" * 16), 3)
    assert accepted(handshake, 9, accept(), 4) is None
    name = codec.decode_hello(handshake.make_hello()).nonce
    assert accepted(handshake, 5, accept(name, b"v" * 16), 4)


def test_a_late_acceptance_of_a_dead_world_is_ignored(
    handshake,
):
    accepted(handshake, 3, accept(), 0)
    assert accepted(handshake, 1, accept(world=b"v" * 16), 3, asks=False) is None
    assert accepted(handshake, 4, accept(), 3, asks=False)


def test_a_living_world_that_counts_as_dead_gets_a_new_nonce(handshake):
    """Cloud has accepted a late datagram of a dead world while it heard nobody."""
    accepted(handshake, 3, accept(world=b"v" * 16), 0)
    accepted(handshake, 9, accept(), 3)
    assert accepted(handshake, 3, accept(world=b"v" * 16), 9) is None  # alive, and answers
    name = codec.decode_hello(handshake.make_hello()).nonce
    assert name != NONCE
    assert accepted(handshake, 9, accept(), 9) is None  # the late datagram again
    assert accepted(handshake, 4, accept(name, b"v" * 16), 9)
    assert codec.decode_hello(handshake.make_hello()).nonce == name


def test_the_first_epoch_is_newer_than_the_last(handshake):
    accepted(handshake, 2**32 - 1, accept(), 0)
    assert accepted(handshake, 2**32 - 2, accept(), 2**32 - 1) is None
    assert accepted(handshake, 1, accept(), 2**32 - 1)


def test_an_acceptance_for_another_nonce_is_ignored(handshake):
    assert accepted(handshake, 3, accept(nonce=b"m" * 16), 0) is None


def test_after_a_refusal_cloud_asks_again_with_the_same_nonce(handshake):
    assert handshake.receive_busy(Busy(NONCE, used=False))
    assert codec.decode_hello(handshake.make_hello()).nonce == NONCE


def test_a_used_nonce_is_replaced_once(handshake):
    assert not handshake.receive_busy(Busy(NONCE, used=True))
    second = codec.decode_hello(handshake.make_hello()).nonce
    assert second != NONCE
    assert not handshake.receive_busy(Busy(NONCE, used=True))  # an answer to a hello before that
    assert codec.decode_hello(handshake.make_hello()).nonce == second
    handshake.receive_busy(Busy(second, used=True))
    assert codec.decode_hello(handshake.make_hello()).nonce not in (NONCE, second)
    assert accepted(handshake, 1, accept(), 0) is None


def test_a_refusal_for_another_nonce_is_ignored(handshake):
    assert not handshake.receive_busy(Busy(b"m" * 16, used=False))


def test_the_first_world_makes_no_old_world(handshake):
    accepted(handshake, 3, accept(), 0)
    assert not handshake._old_worlds


def test_the_memory_of_old_worlds_is_bounded(handshake):
    for number in range(3 * LEFT_MAX):
        accepted(handshake, 1, accept(world=b"%016d" % number), 0)
    assert len(handshake._old_worlds) == LEFT_MAX
