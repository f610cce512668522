"""Cloud's side of the greetings: what its hellos say, and which answers count."""

import pytest

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Accept, Busy, Hello
from cloudrc.tunnel.handshake import COOKIES_MAX, LEFT_MAX, NO_COOKIE, REPLIES_MAX, Knocker
from cloudrc.tunnel.session import AES_256_GCM, CHACHA20_POLY1305, Agreement

NONCE, CLOCK, WORLD = b"n" * 16, b"c" * 16, b"w" * 16


@pytest.fixture
def knocker():
    return Knocker(NONCE, CLOCK, CHACHA20_POLY1305)


def test_a_hello_says_who_asks(knocker):
    hello = codec.decode_hello(knocker.hello())
    assert hello == Hello(NONCE, CLOCK, NO_COOKIE, CHACHA20_POLY1305)


def test_a_challenge_is_answered_with_its_cookie_and_later_hellos_have_it_too(knocker):
    knocker.hello()
    answer = knocker.challenged(b"1" * 16)
    assert answer is not None
    assert codec.decode_hello(answer).cookie == b"1" * 16
    assert codec.decode_hello(knocker.hello()).cookie == b"1" * 16


def test_challenges_cannot_make_cloud_talk(knocker):
    assert knocker.challenged(b"0" * 16) is None  # it has not asked
    knocker.hello()
    assert knocker.challenged(b"1" * 16)
    assert knocker.challenged(b"1" * 16) is None
    answers = [knocker.challenged(b"%016d" % n) for n in range(50)]
    assert sum(answer is not None for answer in answers) == REPLIES_MAX - 1


def test_old_challenges_that_are_repeated_take_no_ones_turn(knocker):
    old = [b"old %d" % n for n in range(REPLIES_MAX)]
    knocker.hello()
    assert all(knocker.challenged(cookie) for cookie in old)
    knocker.hello()
    assert [knocker.challenged(cookie) for cookie in 100 * old] == 300 * [None]
    answer = knocker.challenged(b"1" * 16)
    assert codec.decode_hello(answer).cookie == b"1" * 16
    assert [knocker.challenged(cookie) for cookie in old] == REPLIES_MAX * [None]
    assert codec.decode_hello(knocker.hello()).cookie == b"1" * 16


def test_a_cookie_that_found_no_turn_left_is_taken_at_the_next(knocker):
    knocker.hello()
    for number in range(REPLIES_MAX):
        knocker.challenged(b"old %d" % number)
    assert knocker.challenged(b"1" * 16) is None
    knocker.hello()
    assert knocker.challenged(b"1" * 16)


def test_what_is_remembered_of_cookies_is_bounded(knocker):
    for number in range(COOKIES_MAX + 1):
        knocker.hello()
        knocker.challenged(b"%016d" % number)
    assert len(knocker._cookies) == COOKIES_MAX
    assert knocker.challenged(b"%016d" % 1) is None
    assert knocker.challenged(b"%016d" % 0)


def accept(nonce=NONCE, world=WORLD, suite=AES_256_GCM):
    return Accept(nonce, world, CLOCK, suite)


def accepted(knocker, epoch, answer, current, *, asks=True):
    return knocker.accepted(epoch, answer, current, asks=asks)


def test_an_acceptance_gives_what_both_agree_on(knocker):
    agreement = accepted(knocker, 3, accept(suite=CHACHA20_POLY1305), 0)
    assert agreement == Agreement(NONCE, WORLD, CHACHA20_POLY1305)


@pytest.mark.parametrize(("epoch", "counts"), [(2, False), (3, False), (4, True)])
def test_of_one_world_only_a_newer_epoch_counts(knocker, epoch, counts):
    accepted(knocker, 3, accept(), 0)
    assert (accepted(knocker, epoch, accept(), 3) is not None) == counts


@pytest.mark.parametrize(("ahead", "counts"), [(2**31 - 1, True), (2**31, False)])
def test_half_of_all_epochs_are_newer(knocker, ahead, counts):
    accepted(knocker, 1, accept(), 0)
    assert (accepted(knocker, 1 + ahead, accept(), 1) is not None) == counts


def test_another_process_of_world_may_begin_again_from_one(knocker):
    accepted(knocker, 3, accept(), 0)
    assert accepted(knocker, 1, accept(world=b"v" * 16), 3)


@pytest.mark.promise("old-datagrams-do-nothing")
def test_a_world_that_is_gone_does_not_come_back(knocker):
    accepted(knocker, 3, accept(), 0)
    accepted(knocker, 4, accept(world=b"v" * 16), 3)
    assert accepted(knocker, 9, accept(), 4) is None
    name = codec.decode_hello(knocker.hello()).nonce
    assert accepted(knocker, 5, accept(name, b"v" * 16), 4)


def test_what_a_world_that_is_gone_said_late_does_not_take_the_place_of_the_one_that_is_heard(
    knocker,
):
    accepted(knocker, 3, accept(), 0)
    assert accepted(knocker, 1, accept(world=b"v" * 16), 3, asks=False) is None
    assert accepted(knocker, 4, accept(), 3, asks=False)


def test_a_world_that_was_taken_for_gone_is_asked_under_another_name(knocker):
    """What the one before had said came late, and was taken while nobody was heard."""
    accepted(knocker, 3, accept(world=b"v" * 16), 0)
    accepted(knocker, 9, accept(), 3)
    assert accepted(knocker, 3, accept(world=b"v" * 16), 9) is None  # alive, and answers
    name = codec.decode_hello(knocker.hello()).nonce
    assert name != NONCE
    assert accepted(knocker, 9, accept(), 9) is None  # the late word, once more
    assert accepted(knocker, 4, accept(name, b"v" * 16), 9)
    assert codec.decode_hello(knocker.hello()).nonce == name


def test_after_the_last_epoch_of_all_the_first_is_newer(knocker):
    accepted(knocker, 2**32 - 1, accept(), 0)
    assert accepted(knocker, 2**32 - 2, accept(), 2**32 - 1) is None
    assert accepted(knocker, 1, accept(), 2**32 - 1)


def test_an_acceptance_of_somebody_else_does_not_count(knocker):
    assert accepted(knocker, 3, accept(nonce=b"m" * 16), 0) is None


def test_a_refusal_by_anothers_authority_is_told_and_asked_again_as_before(knocker):
    assert knocker.refused(Busy(NONCE, used=False))
    assert codec.decode_hello(knocker.hello()).nonce == NONCE


def test_a_used_name_is_replaced_once(knocker):
    assert not knocker.refused(Busy(NONCE, used=True))
    second = codec.decode_hello(knocker.hello()).nonce
    assert second != NONCE
    assert not knocker.refused(Busy(NONCE, used=True))  # an answer to a hello before that
    assert codec.decode_hello(knocker.hello()).nonce == second
    knocker.refused(Busy(second, used=True))
    assert codec.decode_hello(knocker.hello()).nonce not in (NONCE, second)
    assert accepted(knocker, 1, accept(), 0) is None


def test_somebody_elses_refusal_does_not_count(knocker):
    assert not knocker.refused(Busy(b"m" * 16, used=False))


def test_the_first_world_is_nobodys_successor(knocker):
    accepted(knocker, 3, accept(), 0)
    assert not knocker._old_worlds


def test_what_is_remembered_of_worlds_is_bounded(knocker):
    for number in range(3 * LEFT_MAX):
        accepted(knocker, 1, accept(world=b"%016d" % number), 0)
    assert len(knocker._old_worlds) == LEFT_MAX
