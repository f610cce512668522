"""World's side of the handshake: cookies, nonces, and which cloud has authority."""

from types import SimpleNamespace

import pytest

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Accept, Busy, DecodeError, Direction, Kind
from cloudrc.tunnel.handshake import (
    CHALLENGE_NS,
    COOKIE_NS,
    EPOCH_MAX,
    GRACE_NS,
    NO_COOKIE,
    REPEATS_MAX,
    ServerHandshake,
    epochs_after,
)
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import AES_256_GCM, CHACHA20_POLY1305, Agreement, Session
from tests.tunnel.conftest import CLOCK, KEY, MS, NONCE, SECOND_NS, WORLD, Doorstep


@pytest.fixture
def step():
    return Doorstep()


def test_a_hello_without_a_cookie_gets_one_and_changes_nothing(step):
    before = dict(vars(step.door))
    assert step.receive_hello().outcome == "hello"
    del before["_challenged_ns"]
    assert {name: vars(step.door)[name] for name in before} == before
    assert step.world.epoch == 0


def test_with_the_cookie_it_gets_a_session(step):
    answer = step.receive_hello(cookie=step.cookie())
    assert (answer.outcome, answer.opened) == ("hello", True)
    assert step.world.epoch == 1
    kind, _, epoch, _, body = step.cloud.open(answer.datagrams[0])
    assert (kind, epoch) == (Kind.ACCEPT, 1)
    assert codec.decode_accept(body) == Accept(NONCE, WORLD, CLOCK, AES_256_GCM)


@pytest.mark.parametrize("spoil", [lambda c: bytes(16), lambda c: c[:-1] + bytes([c[-1] ^ 1])])
def test_a_wrong_cookie_is_as_good_as_none(step, spoil):
    cookie = step.cookie()
    step.now_ns += CHALLENGE_NS
    assert step.answer(cookie=spoil(cookie))[0] == Kind.CHALLENGE
    assert step.world.epoch == 0


@pytest.mark.parametrize(("slots", "opened"), [(0, True), (1, True), (2, False)])
def test_a_cookie_lasts_its_slot_and_the_next(step, slots, opened):
    cookie = step.cookie()
    step.now_ns += slots * COOKIE_NS
    assert step.receive_hello(cookie=cookie).opened == opened


def test_a_cookie_of_an_earlier_process_is_invalid(step):
    other = Doorstep(nonce=b"v" * 16)
    assert not other.receive_hello(cookie=step.cookie()).opened


def test_a_cookie_cannot_be_made_without_the_key(step):
    assert step.cookie() != Doorstep().cookie()[::-1]
    strange = Doorstep()
    strange.door = ServerHandshake(
        Session(Direction.UPLINK, KeyRing(KeySet(Key(b"x" * 32)))),
        SimpleNamespace(
            nonce=WORLD, clock_id=CLOCK, suite=1, last_epoch=0, next_epoch=None
        ),
        age_max_ns=1,
    )  # fmt: skip
    assert strange.door._cookie(step.now_ns) != step.cookie()


def test_a_repeated_hello_gets_the_same_acceptance(step):
    cookie = step.cookie()
    assert step.receive_hello(cookie=cookie).opened
    again = step.receive_hello(cookie=cookie)
    assert (again.outcome, again.opened) == ("hello", False)
    assert codec.peek(again.datagrams[0])[:2] == (Kind.ACCEPT, 1)


def test_another_cloud_is_refused_while_the_incumbent_is_fresh(step):
    step.receive_hello(cookie=step.cookie())
    step.door.hear(step.now_ns)
    step.now_ns += 250 * MS
    answer = step.receive_hello(b"m" * 16, step.cookie())
    assert (answer.outcome, answer.opened) == ("busy", False)
    body = step.cloud.open(answer.datagrams[0])[4]
    assert codec.decode_busy(body) == Busy(b"m" * 16, used=False)
    step.now_ns += 1
    assert step.receive_hello(b"m" * 16, step.cookie()).opened
    assert step.world.epoch == 2


@pytest.mark.promise("old-datagrams-do-nothing")
def test_a_nonce_that_had_its_session_gets_no_other(step):
    step.receive_hello(cookie=step.cookie())
    step.now_ns += 2 * SECOND_NS
    step.receive_hello(b"m" * 16, step.cookie())
    step.now_ns += 2 * SECOND_NS
    answer = step.receive_hello(cookie=step.cookie())
    assert answer.outcome == "hello"
    kind, _, _, _, body = step.cloud.open(answer.datagrams[0])
    assert kind == Kind.BUSY
    assert codec.decode_busy(body) == Busy(NONCE, used=True)
    assert step.world.epoch == 2


@pytest.mark.parametrize(
    ("wishes", "agreed"),
    [
        ((AES_256_GCM, AES_256_GCM), AES_256_GCM),
        ((CHACHA20_POLY1305, AES_256_GCM), CHACHA20_POLY1305),
        ((AES_256_GCM, CHACHA20_POLY1305), CHACHA20_POLY1305),
        ((77, AES_256_GCM), AES_256_GCM),
    ],
)
def test_the_suite_is_chacha_if_one_end_is_slow_at_aes(wishes, agreed):
    step = Doorstep(suite=wishes[1])
    _, _, body = step.answer(cookie=step.cookie(), suite=wishes[0])
    assert codec.decode_accept(body).suite == agreed
    assert step.world._agreement == Agreement(NONCE, WORLD, agreed)


def test_a_session_can_open_at_time_zero(step):
    step.now_ns = 0
    assert step.receive_hello(cookie=step.cookie()).opened


def test_a_session_rests_on_the_key_of_its_hello():
    step = Doorstep()
    old, new = KEY, Key(b"n" * 32)
    step.world.ring.replace(KeySet(new), step.now_ns)
    step.world.maintain(step.now_ns)
    for key in (old, new):
        step.world.open(step.cloud.greet(Kind.HELLO, bytes(codec.BODY_SIZES[Kind.HELLO]), key))
        for cookie in (NO_COOKIE, step.door._cookie(step.now_ns)):
            step.now_ns += CHALLENGE_NS
            (data,) = step.receive_hello(key.name.encode().ljust(16), cookie).datagrams
            assert key.verifies(data[:-16], data[-16:])
        assert step.world._key == key
        assert step.world._openers._kept[0][1] == key
        assert key.verifies(
            *(lambda told: (told[:-16], told[-16:]))(step.door.begin_next_epoch(step.now_ns))
        )
        step.now_ns += 2 * SECOND_NS


def test_the_first_acceptance_decides_the_key_of_the_session():
    step = Doorstep()
    old, new = KEY, Key(b"n" * 32)
    step.world.ring.replace(KeySet(new), step.now_ns)
    step.world.maintain(step.now_ns)
    for key in (old, new):  # while two are valid, a cloud says hello with each in turn
        step.world.open(step.cloud.greet(Kind.HELLO, bytes(codec.BODY_SIZES[Kind.HELLO]), key))
        (data,) = step.receive_hello(cookie=step.door._cookie(step.now_ns)).datagrams
        assert old.verifies(data[:-16], data[-16:])
    assert step.world._key == old


def test_a_repeated_acceptance_has_the_key_of_its_epoch():
    """World began a new epoch under another key, and its acceptance was lost."""
    step = Doorstep()
    step.receive_hello(cookie=step.cookie())
    keys = KeySet(new := Key(b"n" * 32))
    step.world.ring.replace(keys, step.now_ns)
    step.now_ns += round(keys.overlap * 1e9) + SECOND_NS
    step.world.maintain(step.now_ns)  # seals with the new key from here on
    step.world.accepted = (new, KEY)
    for epoch, epoch_key in ((1, KEY), (2, new)):
        for hello_key in (new, KEY):
            hello = bytes(codec.BODY_SIZES[Kind.HELLO])
            step.world.open(step.cloud.greet(Kind.HELLO, hello, hello_key))
            (data,) = step.receive_hello(cookie=step.door._cookie(step.now_ns)).datagrams
            assert codec.peek(data)[:2] == (Kind.ACCEPT, epoch)
            assert epoch_key.verifies(data[:-16], data[-16:])
        step.door.begin_next_epoch(step.now_ns)
    assert step.world._openers._kept[0][1] == new


@pytest.mark.parametrize(
    ("heard", "repeated", "opened"),
    [((), REPEATS_MAX, True), ((2,), 2 + REPEATS_MAX, True), (range(5), 5, False)],
    ids=["never heard", "heard before the third", "always heard"],
)
def test_a_cloud_without_the_key_of_its_epoch_gets_a_new_one(heard, repeated, opened):
    """World began an epoch under the old key, which cloud dropped before the acceptance came."""
    step = Doorstep()
    step.world.ring.replace(KeySet(new := Key(b"n" * 32)), step.now_ns)
    step.world.maintain(step.now_ns)
    step.world.open(step.cloud.greet(Kind.HELLO, bytes(codec.BODY_SIZES[Kind.HELLO]), KEY))
    assert step.receive_hello(cookie=step.door._cookie(step.now_ns)).opened
    told = []
    for n in range(repeated + 2 * opened):
        step.world.open(step.cloud.greet(Kind.HELLO, bytes(codec.BODY_SIZES[Kind.HELLO]), new))
        if n in heard:
            step.door.hear(step.now_ns)
        answer = step.receive_hello(cookie=step.door._cookie(step.now_ns))
        (data,) = answer.datagrams
        told.append((codec.peek(data)[1], answer.opened, new.verifies(data[:-16], data[-16:])))
    again = [(2, True, True), (2, False, True)]
    assert told == [(1, False, False)] * repeated + opened * again
    assert NONCE not in step.door._used


def test_answers_are_never_longer_than_the_hello(step):
    hello = codec.SIZES[Kind.HELLO]
    answers = [
        step.receive_hello(),
        step.receive_hello(cookie=step.cookie()),
        step.receive_hello(b"m" * 16, step.cookie()),
    ]
    kinds = [codec.peek(answer.datagrams[0])[0] for answer in answers]
    assert kinds == [Kind.CHALLENGE, Kind.ACCEPT, Kind.BUSY]
    assert all(len(answer.datagrams[0]) <= hello for answer in answers)


def test_world_knows_whether_the_clock_is_shared(step):
    step.receive_hello(cookie=step.cookie())
    assert step.door.shares_clock
    step.now_ns += 2 * SECOND_NS
    step.receive_hello(b"m" * 16, step.cookie(), clock=b"d" * 16)
    assert not step.door.shares_clock


def test_operator_and_alive_are_let_in_once(step):
    for kind in (Kind.OPERATOR, Kind.ALIVE):
        step.door.accept_once(kind, 5, step.now_ns)
        step.door.accept_once(kind, 4, step.now_ns)  # late, but new
        with pytest.raises(DecodeError, match=r"^repeated$"):
            step.door.accept_once(kind, 5, step.now_ns)
    with pytest.raises(DecodeError, match=r"^malformed$"):
        step.door.accept_once(Kind.TELEMETRY, 0, step.now_ns)


def test_a_repeat_does_not_count_as_a_sign_of_life(step):
    step.receive_hello(cookie=step.cookie())
    step.door.accept_once(Kind.ALIVE, 0, step.now_ns)
    step.now_ns += 200 * MS
    with pytest.raises(DecodeError):
        step.door.accept_once(Kind.ALIVE, 0, step.now_ns)
    step.now_ns += 100 * MS
    assert step.receive_hello(b"m" * 16, step.cookie()).opened


def test_a_silent_incumbent_that_asks_gets_a_new_epoch(step):
    """World cannot open its datagrams for some reason, so a new epoch loses nothing."""
    step.receive_hello(cookie=step.cookie())
    for counter in range(2 * REPEATS_MAX):
        step.now_ns += SECOND_NS // 5
        step.door.accept_once(Kind.ALIVE, counter, step.now_ns)
        assert not step.receive_hello(cookie=step.door._cookie(step.now_ns)).opened
    opened = []
    for _ in range(2 * REPEATS_MAX):
        step.now_ns += SECOND_NS // 2
        opened.append(step.receive_hello(cookie=step.door._cookie(step.now_ns)).opened)
    assert opened.index(True) == REPEATS_MAX - 1
    assert step.world.epoch == 2


def test_the_next_epoch_gives_its_cloud_time_to_be_heard(step):
    step.receive_hello(cookie=step.cookie())
    step.door.accept_once(Kind.OPERATOR, 0, step.now_ns)
    step.now_ns += 250 * MS
    step.door.begin_next_epoch(step.now_ns)
    step.now_ns += GRACE_NS
    assert step.receive_hello(b"another".ljust(16), step.cookie()).outcome == "busy"
    step.now_ns += 1
    assert step.receive_hello(b"another".ljust(16), step.cookie()).opened


def test_a_new_epoch_of_a_session_keeps_its_cloud(step):
    step.receive_hello(cookie=step.cookie())
    step.door.accept_once(Kind.OPERATOR, 0, step.now_ns)
    kind, epoch, _ = codec.peek(step.door.begin_next_epoch(step.now_ns))[0], step.world.epoch, None
    assert (kind, epoch) == (Kind.ACCEPT, 2)
    step.door.accept_once(Kind.OPERATOR, 0, step.now_ns)  # counters restart


def test_epochs_rise_from_the_last_one():
    step = Doorstep(last_epoch=41)
    step.receive_hello(cookie=step.cookie())
    assert step.world.epoch == 42


def test_epochs_may_come_from_a_file():
    step = Doorstep(next_epoch=iter([100]).__next__)
    step.receive_hello(cookie=step.cookie())
    assert step.world.epoch == 100


def test_after_the_last_epoch_comes_the_first():
    counting = epochs_after(EPOCH_MAX - 1)
    assert [next(counting) for _ in range(3)] == [EPOCH_MAX, 1, 2]
    codec.encode_header(Kind.ALIVE, 0, EPOCH_MAX, 0)
