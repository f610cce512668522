# SPDX-License-Identifier: Apache-2.0

"""World's side of the handshake: cookies, epochs, keys, and which cloud gets the session."""

import pytest

from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import Accept, DecodeError, Kind
from cloudrc.wire.tunnel.handshake import (
    CHALLENGE_NS,
    CLOUDS_MAX,
    COOKIE_NS,
    EPOCH_MAX,
    NO_COOKIE,
    REPEATS_MAX,
    HelloAnswer,
)
from cloudrc.wire.tunnel.keys import KeySet
from tests.wire.tunnel.conftest import CLOCK, KEY, MS, NEW, NONCE, OTHER, SECOND_NS, WORLD, Doorstep


@pytest.fixture
def step():
    return Doorstep()


def signed_by(key, answer):
    (data,) = answer.datagrams
    return key.verifies(data[:-16], data[-16:])


@pytest.mark.parametrize("now_ns", [0, 10 * COOKIE_NS])
def test_a_hello_gets_a_cookie_and_with_the_cookie_a_session(step, now_ns):
    step.now_ns = now_ns
    before = dict(vars(step.door)) | {"_challenged_ns": now_ns}
    cookie = step.cookie()
    assert dict(vars(step.door)) == before, "without a cookie it changes nothing"
    step.now_ns += CHALLENGE_NS
    assert step.answer(cookie=cookie[:-1] + b"?")[0] == Kind.CHALLENGE, "a wrong one is as none"
    answer = step.receive_hello(cookie=cookie)
    assert (answer.outcome, answer.opened, step.world.epoch) == ("hello", True, 1)
    kind, epoch, _, body = step.cloud.open(answer.datagrams[0])
    assert (kind, epoch) == (Kind.ACCEPT, 1)
    assert Accept(*codec.decode(Kind.ACCEPT, body)) == Accept(NONCE, WORLD, CLOCK)


@pytest.mark.parametrize(("slots", "opened"), [(0, True), (1, True), (2, False)])
def test_a_cookie_lasts_its_slot_and_the_next(step, slots, opened):
    cookie = step.cookie()
    step.now_ns += slots * COOKIE_NS
    assert step.receive_hello(cookie=cookie).opened == opened


def test_challenges_are_at_most_100_ms_apart(step):
    for _ in range(50):
        assert step.receive_hello(cookie=NO_COOKIE).outcome == "hello"
        step.now_ns += CHALLENGE_NS - 1
        assert step.receive_hello(cookie=NO_COOKIE) == ("unanswered", [], False)
        assert step.receive_hello().datagrams, "a hello with a cookie is answered"
        step.now_ns += 1  # to the nanosecond


@pytest.mark.promise("old-datagrams-do-nothing")
def test_a_hello_with_a_cookie_is_answered_once(step):
    cookie = step.cookie()
    assert step.receive_hello(cookie=cookie, counter=7).opened
    for counter in (7, 6, 0):  # captured while its cookie is valid, and repeated
        assert step.receive_hello(cookie=cookie, counter=counter) == ("repeated", [], False)
    assert step.receive_hello(cookie=cookie, counter=8).datagrams
    step.now_ns += 2 * SECOND_NS
    assert step.receive_hello(OTHER, counter=0).opened
    step.now_ns += 2 * SECOND_NS
    assert step.receive_hello(counter=8).outcome == "repeated"
    assert step.world.epoch == 2


def test_the_memory_of_counters_is_bounded(step):
    for number in range(CLOUDS_MAX):
        step.receive_hello(NONCE)
        step.receive_hello(b"%016d" % number)
    assert len(step.door._counters) == CLOUDS_MAX
    assert NONCE in step.door._counters, "the one answered last is forgotten last"


def test_another_cloud_is_refused_while_the_incumbent_is_fresh(step):
    step.receive_hello()
    step.door.hear(step.now_ns)
    step.now_ns += 250 * MS
    answer = step.receive_hello(OTHER)
    assert (answer.outcome, answer.opened) == ("busy", False)
    assert codec.decode(Kind.BUSY, step.cloud.open(answer.datagrams[0])[-1])[0] == OTHER
    step.now_ns += 1
    assert step.receive_hello(OTHER).opened
    assert step.world.epoch == 2


def test_operator_and_alive_are_let_in_once(step):
    step.receive_hello()
    for kind in (Kind.OPERATOR, Kind.ALIVE):
        step.door.accept_once(kind, 5, step.now_ns)
        step.door.accept_once(kind, 4, step.now_ns)  # late, but new
        with pytest.raises(DecodeError, match=r"^repeated$"):
            step.door.accept_once(kind, 5, step.now_ns + 200 * MS)
    with pytest.raises(DecodeError, match=r"^malformed$"):
        step.door.accept_once(Kind.TELEMETRY, 0, step.now_ns)
    step.now_ns += 300 * MS
    assert codec.peek(step.door.begin_next_epoch(step.now_ns))[:2] == (Kind.ACCEPT, 2)
    step.door.accept_once(Kind.ALIVE, 5, step.now_ns - 300 * MS)  # counters restart
    assert step.receive_hello(OTHER).opened, "a repeat is no sign of life"


def test_an_incumbent_that_asks_gets_its_epoch_again(step):
    """Its hellos may be under way for seconds, while world hears nothing else."""
    step.receive_hello()
    for _ in range(20):
        step.now_ns += SECOND_NS // 2
        assert step.answer()[:2] == (Kind.ACCEPT, 1)
    assert step.receive_hello(OTHER).opened, "a hello is no sign of life"


def test_a_cloud_that_left_its_epoch_gets_a_later_one_once(step):
    step.receive_hello()
    assert [step.answer(epoch=2)[1] for _ in range(9)] == [3] * 9


def test_a_cloud_that_tries_two_keys_keeps_the_epoch_of_one(step):
    step.world.ring.keys = KeySet(NEW, KEY)
    assert step.receive_hello().opened
    for key in (KEY, KEY, NEW) * (2 * REPEATS_MAX):
        assert not step.receive_hello(key=key).opened
    for _ in range(REPEATS_MAX):
        assert not step.receive_hello(key=KEY).opened
    step.door.hear(step.now_ns)  # an encrypted datagram, too, shows the epoch's key
    assert not step.receive_hello(key=KEY).opened


@pytest.mark.parametrize(
    ("last", "known", "epoch"),
    [
        (41, 0, 42),
        (0, 41, 42),  # world has restarted, cloud has not
        (EPOCH_MAX, 0, 1),
        (0, EPOCH_MAX, 1),
    ],
)
def test_epochs_rise_through_restarts_of_world(step, last, known, epoch):
    step.door._epoch = last
    assert step.answer(epoch=known)[1] == step.world.epoch == epoch
    step.now_ns += 2 * SECOND_NS
    assert step.answer(OTHER, epoch=known)[1] == epoch + 1


def test_a_session_uses_the_key_of_its_hello(step):
    step.world.ring.keys = KeySet(NEW, KEY)
    for key in (KEY, NEW):
        for cookie in (NO_COOKIE, None):
            step.now_ns += 2 * SECOND_NS
            answer = step.receive_hello(key.name.encode().ljust(16), cookie, key=key)
            assert signed_by(key, answer)
        assert step.world.epoch_key == key
        assert signed_by(key, HelloAnswer("", [step.door.begin_next_epoch(step.now_ns)]))


def test_an_incumbent_with_the_newest_key_gets_a_new_epoch(step):
    step.receive_hello()
    step.world.ring.keys = KeySet(NEW, KEY)
    for key, epoch, opened in ((KEY, 1, False), (NEW, 2, True), (KEY, 2, False), (NEW, 2, False)):
        step.door.hear(step.now_ns)
        answer = step.receive_hello(key=key)
        assert (step.world.epoch, answer.opened) == (epoch, opened)
        assert signed_by(step.world.epoch_key, answer), "which cloud takes as the epoch's"
    assert step.world.epoch_key == NEW


def test_a_cloud_without_the_key_of_its_epoch_gets_a_new_one(step):
    """Cloud's key file was restored to an older version, world's was not."""
    step.world.ring.keys = KeySet(NEW, KEY)
    assert step.receive_hello().opened
    answers = [step.receive_hello(key=KEY) for _ in range(REPEATS_MAX + 2)]
    opened = [False] * REPEATS_MAX + [True, False]
    assert [answer.opened for answer in answers] == opened
    assert [signed_by(KEY, answer) for answer in answers] == [False] * REPEATS_MAX + [True, True]


@pytest.mark.promise("old-keys-end")
def test_after_its_key_was_dropped_a_cloud_gets_a_new_epoch(step):
    step.receive_hello()
    step.world.ring.keys = KeySet(NEW)
    answer = step.receive_hello()
    assert (answer.opened, step.world.epoch, step.world.epoch_key) == (True, 2, NEW)
