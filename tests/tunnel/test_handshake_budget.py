"""How many hellos world answers, and that no sender can use up the answers of another."""

import pytest

from cloudrc.tunnel.handshake import (
    ANSWERS_MAX,
    CHALLENGE_NS,
    COOKIE_NS,
    NO_COOKIE,
    REPEATS_MAX,
    USED_MAX,
)
from tests.tunnel.conftest import MS, NONCE, SECOND_NS, Doorstep


@pytest.fixture
def step():
    return Doorstep()


def test_used_nonces_are_remembered_longer_than_a_cookie_lasts():
    assert USED_MAX * SECOND_NS // ANSWERS_MAX * 2 > 2 * COOKIE_NS


def test_no_more_than_twenty_answers_in_any_second(step):
    answered_ns = []
    for _ in range(3000):
        for cookie in (NO_COOKIE, step.door._cookie(step.now_ns)):
            if step.receive_hello(cookie=cookie).datagrams:
                answered_ns.append(step.now_ns)
        step.now_ns += MS
    assert len(answered_ns) == 3 * 20
    for first, later in zip(answered_ns, answered_ns[20:], strict=False):
        assert later - first >= SECOND_NS


def test_hellos_without_cookies_use_up_only_challenges(step):
    cookie = step.cookie()
    for _ in range(1000):
        assert step.receive_hello(b"m" * 16).outcome == "unanswered"
    assert step.receive_hello(cookie=cookie).opened


def test_challenges_are_at_most_100_ms_apart(step):
    for _ in range(50):
        assert step.receive_hello().datagrams
        step.now_ns += CHALLENGE_NS - 1
        assert step.receive_hello()[:2] == ("unanswered", [])
        step.now_ns += 1  # to the nanosecond


def test_a_hello_that_cannot_be_answered_opens_nothing(step):
    cookie = step.cookie()
    while step.receive_hello(b"m" * 16, cookie).datagrams:
        pass
    step.now_ns += step.door._age_max_ns + SECOND_NS - 1
    step.door._answered_ns.extend([step.now_ns] * ANSWERS_MAX)
    answer = step.receive_hello(cookie=cookie)
    assert (answer.outcome, answer.opened, step.world.epoch) == ("unanswered", False, 1)
    assert answer.datagrams == []
    step.now_ns += SECOND_NS - 1
    assert not step.receive_hello(cookie=step.door._cookie(step.now_ns)).opened
    step.now_ns += 1  # to the nanosecond
    assert step.receive_hello(cookie=step.door._cookie(step.now_ns)).opened
    answers = [
        step.receive_hello(cookie=step.door._cookie(step.now_ns)) for _ in range(ANSWERS_MAX)
    ]
    assert [bool(one.datagrams) for one in answers] == (ANSWERS_MAX - 1) * [True] + [False]


def test_a_hello_with_a_cookie_is_answered_once(step):
    cookie = step.cookie()
    assert step.receive_hello(cookie=cookie, counter=7).opened
    for _ in range(1000):  # captured while its cookie is valid, and repeated
        for counter in (7, 6, 0):
            answer = step.receive_hello(cookie=cookie, counter=counter)
            assert (answer.outcome, answer.datagrams) == ("repeated", [])
    assert step.receive_hello(cookie=cookie, counter=8).datagrams
    step.now_ns += 2 * SECOND_NS
    assert step.receive_hello(b"m" * 16, step.cookie(), counter=0).opened


def test_a_fresh_incumbent_keeps_its_epoch_however_often_it_asks(step):
    step.receive_hello(cookie=step.cookie())
    step.door.hear(step.now_ns)
    for _ in range(REPEATS_MAX):
        assert not step.receive_hello(cookie=step.door._cookie(step.now_ns)).opened
    step.now_ns += 250 * MS
    assert not step.receive_hello(cookie=step.door._cookie(step.now_ns)).opened
    step.now_ns += 1  # to the nanosecond
    assert step.receive_hello(cookie=step.door._cookie(step.now_ns)).opened


def test_the_memory_of_nonces_is_bounded(step):
    for number in range(3 * USED_MAX):
        step.now_ns += 2 * SECOND_NS
        step.receive_hello(b"%016d" % number, step.door._cookie(step.now_ns))
    assert len(step.door._used) == USED_MAX
    assert len(step.door._answered_ns) == ANSWERS_MAX
    assert len(step.door._counters) == USED_MAX


def test_the_counter_that_was_answered_last_is_forgotten_last(step):
    for number in range(USED_MAX + 1):
        step.now_ns += 2 * SECOND_NS
        for nonce in (NONCE, b"%016d" % number):
            step.receive_hello(nonce, step.door._cookie(step.now_ns))
    assert NONCE in step.door._counters


def test_the_nonce_that_was_answered_last_is_forgotten_last(step):
    first, second, *others = (b"%16d" % number for number in range(USED_MAX + 1))
    for nonce in (first, second, *others[:-1], first, others[-1]):
        step.door._remember(nonce, 0)
    assert second not in step.door._counters
    assert first in step.door._counters


def test_without_an_epoch_a_hello_changes_nothing():
    epochs = [1]
    step = Doorstep(next_epoch=lambda: epochs.pop() if epochs else None)
    assert step.receive_hello(cookie=step.cookie()).opened
    step.now_ns += 2 * SECOND_NS
    for _ in range(2):
        assert step.receive_hello(b"m" * 16, step.door._cookie(step.now_ns))[:2] == (
            "unanswered",
            [],
        )
    assert not step.door.ready
    assert step.world.epoch == 1
    assert step.receive_hello(
        cookie=step.door._cookie(step.now_ns)
    ).datagrams  # the incumbent is, still
    epochs.append(2)
    assert step.door.ready
    assert epochs == []  # it is kept for the next session
    step.now_ns += 2 * SECOND_NS
    assert step.receive_hello(b"m" * 16, step.door._cookie(step.now_ns)).opened
    assert step.world.epoch == 2


def test_without_a_first_epoch_no_hello_is_answered():
    step = Doorstep(next_epoch=lambda: None)
    assert step.receive_hello(cookie=step.cookie())[:2] == ("unanswered", [])
    assert not step.door.ready
