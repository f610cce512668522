# SPDX-License-Identifier: Apache-2.0

"""A session opens valid datagrams; nothing changes before a tag is verified."""

import pytest

from cloudrc.wire.messages import ZERO, Command, Fragment, RangeScan
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import DecodeError, Direction, Kind
from cloudrc.wire.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.wire.tunnel.session import NO_EPOCH, Session
from tests.conftest import nightly
from tests.wire.tunnel.conftest import pair

BODY = bytes(range(codec.BODY_SIZES[Kind.COMMAND]))
NONCES = b"cloud".ljust(16) + b"world".ljust(16)
HELLO = bytes(codec.BODY_SIZES[Kind.HELLO])
OLD, NEW = Key(b"p" * 32), Key(b"n" * 32)


def refuses(session, data, outcome="tag"):
    """Return whether a session refuses a datagram for this reason, with its state unchanged."""
    before = state(session)
    try:
        session.open(data)
    except DecodeError as error:
        return (str(error), state(session)) == (outcome, before)
    return False


def state(session):
    """Return all state that a datagram could change; a cipher is shown by its address."""
    return {name: repr(value) for name, value in vars(session).items()}


def test_an_end_opens_what_the_other_one_sends():
    world, cloud = pair()
    cloud.seal(Kind.COMMAND, BODY)
    data, hello = cloud.seal(Kind.COMMAND, BODY), cloud.sign(Kind.HELLO, HELLO)
    assert world.open(data) == (Kind.COMMAND, 1, 1, BODY)
    assert refuses(cloud, data, "direction")
    assert world.open(hello) == (Kind.HELLO, NO_EPOCH, 0, HELLO)
    assert refuses(world, cloud.sign(Kind.HELLO, HELLO, NEW))
    assert refuses(world, data[:16] + BODY + bytes(codec.TAG_SIZE)), "it is not sealed"
    world.begin(2)
    assert refuses(world, data, "old_epoch")


def test_without_a_session_only_the_handshake_is_opened():
    cloud = Session(Direction.DOWNLINK, KeyRing(KeySet(OLD)))
    world, _ = pair(NO_EPOCH)
    telemetry = world.seal(Kind.TELEMETRY, bytes(codec.BODY_SIZES[Kind.TELEMETRY]))
    assert refuses(cloud, telemetry, "old_epoch")
    challenge = codec.encode(Kind.CHALLENGE, b"c" * 13)
    assert cloud.open(world.sign(Kind.CHALLENGE, challenge))[-1] == challenge
    with pytest.raises(AssertionError, match=r"^the handshake comes first$"):
        cloud.begin(1)


def test_keys_depend_on_key_epoch_and_both_nonces():
    world, _ = pair()
    other = b"x" * 16
    for key, epoch, nonces in (
        *((NEW, 1, NONCES), (OLD, 2, NONCES)),
        *((OLD, 1, other + NONCES[16:]), (OLD, 1, NONCES[:16] + other)),
    ):
        cloud = Session(Direction.DOWNLINK, KeyRing(KeySet(key)))
        cloud.begin(epoch, nonces)
        cloud.epoch = 1  # as a forger would write it
        assert refuses(world, cloud.seal(Kind.COMMAND, BODY))


def test_each_kind_has_its_own_counter_in_each_epoch():
    """Therefore no nonce is used twice in an epoch."""
    _, cloud = pair()
    kinds = (Kind.COMMAND, Kind.OPERATOR, Kind.ALIVE)
    sealed = [cloud.seal(kind, bytes(codec.BODY_SIZES[kind])) for kind in kinds for _ in range(9)]
    told = {(kind, 1, counter) for kind in kinds for counter in range(9)}
    assert set(map(codec.peek, sealed)) == told
    assert cloud.next_counter(Kind.COMMAND) == 9
    cloud.begin(2)
    assert cloud.next_counter(Kind.COMMAND) == 0


def test_during_a_rotation_the_handshake_may_have_either_key():
    world, cloud = pair()
    world.ring.keys = KeySet(NEW, OLD)
    for key in (OLD, NEW):
        world.open(cloud.sign(Kind.HELLO, HELLO, key))
        assert world.handshake_key == key
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[1] == 1, "the session goes on"
    assert (world.epoch_key, world.is_outdated) == (OLD, True)
    world.begin(2, key=NEW)
    assert (world.epoch_key, world.is_outdated) == (NEW, False)


@pytest.mark.promise("old-keys-end")
def test_a_dropped_key_opens_nothing():
    world, cloud = pair()
    sealed, hello = cloud.seal(Kind.COMMAND, BODY), cloud.sign(Kind.HELLO, HELLO)
    world.ring.keys = KeySet(NEW, Key(b"m" * 32))
    with pytest.raises(DecodeError, match="old_epoch"):
        world.open(sealed)
    assert world.epoch == NO_EPOCH
    assert refuses(world, hello)
    world.ring.keys = KeySet(OLD)
    world.follow_keys()
    assert refuses(world, sealed, "old_epoch"), "nor when it comes back"


def datagrams(count):
    """Make datagrams of all kinds in both directions, each with the end that opens it."""
    world, cloud = pair()
    made = []
    for number in range(count):
        for end, other, kinds in (
            (world, cloud, (Kind.TELEMETRY, Kind.ALIVE, Kind.ACCEPT, Kind.CHALLENGE, Kind.BUSY)),
            (cloud, world, (Kind.COMMAND, Kind.OPERATOR, Kind.ALIVE, Kind.HELLO)),
        ):
            kind = kinds[number % len(kinds)]
            make = end.sign if kind <= codec.LAST_HANDSHAKE else end.seal
            made.append((make(kind, bytes([number % 256]) * codec.BODY_SIZES[kind]), other))
    return made


@pytest.mark.promise("forged-datagrams-do-nothing")
@pytest.mark.parametrize("count", [50, *nightly(1000)])
def test_no_bit_of_any_datagram_can_be_flipped(count):
    """All kinds are among ten datagrams."""
    accepted = flips = 0
    for data, opener in datagrams(count // 2):
        opener.open(data)
        before = state(opener)
        for position in range(8 * len(data)):
            flipped = bytearray(data)
            flipped[position // 8] ^= 1 << position % 8
            flips += 1
            try:
                opener.open(bytes(flipped))
                accepted += 1
            except DecodeError:
                pass
        assert state(opener) == before
    assert accepted == 0
    assert flips > 500 * count


def test_a_counter_that_no_recording_can_hold_is_refused():
    world, cloud = pair()
    cloud._counters[Kind.COMMAND] = 2**63 - 1
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[2] == 2**63 - 1
    assert refuses(world, cloud.seal(Kind.COMMAND, BODY), "malformed")


def test_a_passed_message_has_the_counter_of_its_datagram():
    world, cloud = pair()
    cloud.seal(Kind.COMMAND, BODY)
    message = Command(1, 2, 3, ZERO, 0.0)
    passed = cloud.pass_on(Kind.COMMAND, message)
    assert codec.peek(passed) == (Kind.COMMAND, 1, 1)
    assert world.open(passed)[3] is message
    assert codec.peek(cloud.seal(Kind.COMMAND, BODY)) == (Kind.COMMAND, 1, 2)
    world.begin(2)
    assert refuses(world, passed, "old_epoch")
    assert refuses(Session(Direction.UPLINK, world.ring), passed, "old_epoch")


@pytest.mark.parametrize(
    ("kind", "message", "encode"),
    [
        (Kind.COMMAND, Command(1, 2, 3, ZERO, 0.0, (ZERO, ZERO)), codec.encode_command),
        (Kind.SCAN, RangeScan(1, (0, 300, 20)), codec.encode_scan),
        (Kind.FRAME, Fragment(1, 2, 0, 1, True, b"jpeg"), codec.encode_fragment),
    ],
)
def test_a_passed_message_is_as_long_as_its_datagram(kind, message, encode):
    _, end = pair()
    assert end.pass_on(kind, message).size == len(end.seal(kind, encode(message)))
