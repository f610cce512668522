"""Sessions: which datagrams are opened, and that nothing changes before a tag is verified."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import DecodeError, Direction, Kind
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import NO_EPOCH, Session, UnsealedSession, make_session, pair

BODY = bytes(range(codec.BODY_SIZES[Kind.COMMAND]))
NONCES = b"cloud".ljust(16) + b"world".ljust(16)
HELLO = bytes(codec.BODY_SIZES[Kind.HELLO])
OLD, NEW = Key(b"p" * 32), Key(b"n" * 32)
Ends = Callable[[], tuple[Session, Session]]


def a_session(sends: Direction = Direction.DOWNLINK, key: Key = OLD) -> Session:
    return Session(sends, KeyRing(KeySet(key)))


def unsealed() -> tuple[Session, Session]:
    ends = UnsealedSession(Direction.UPLINK), UnsealedSession(Direction.DOWNLINK)
    for end in ends:
        end.begin(1, NONCES)
    return ends


def refuses(session: Session, data: bytes, outcome: str = "tag") -> bool:
    try:
        session.open(data)
    except DecodeError as error:
        return str(error) == outcome
    return False


def state(session: Session) -> dict[str, str]:
    """Return all state that a datagram could change; ciphers by their addresses."""
    return {name: repr(value) for name, value in vars(session).items()}


@pytest.mark.parametrize("ends", [pair, unsealed])
def test_the_other_end_opens_what_one_end_seals(ends: Ends) -> None:
    world, cloud = ends()
    cloud.seal(Kind.COMMAND, BODY)
    data = cloud.seal(Kind.COMMAND, BODY)
    assert world.open(data) == (Kind.COMMAND, Direction.DOWNLINK, 1, 1, BODY)
    assert len(data) == codec.SIZES[Kind.COMMAND]
    assert refuses(cloud, data, "direction")
    world.begin(2)
    assert refuses(world, data, "old_epoch")


def test_no_sealed_end_opens_an_unsealed_datagram() -> None:
    assert refuses(pair()[0], unsealed()[1].seal(Kind.COMMAND, BODY))
    assert not make_session(Direction.UPLINK, None).sealed
    assert make_session(Direction.UPLINK, KeyRing(KeySet(OLD))).sealed


def test_a_malformed_datagram_costs_no_cryptography(monkeypatch: pytest.MonkeyPatch) -> None:
    world, cloud = pair()
    data = cloud.seal(Kind.COMMAND, BODY)
    longest = codec.DATAGRAM_MAX + 1  # size that an end reads of a longer one
    other = bytes([data[0] ^ 1]) + data[1:]
    monkeypatch.setattr(world, "_opening", None)
    monkeypatch.setattr(world, "_open_greeting", None)
    cut = [data[:size] for size in range(len(data))]
    grown = [data.ljust(size, b"x") for size in range(len(data) + 1, longest + 1)]
    for each in (*cut, *grown, bytes(longest), other):
        assert refuses(world, each, "malformed") or refuses(world, each, "version")


@pytest.mark.parametrize("make", [a_session, lambda: UnsealedSession(Direction.DOWNLINK)])
def test_without_a_session_only_greetings_are_opened(make: Callable[[], Session]) -> None:
    cloud, (world, _) = make(), pair(epoch=NO_EPOCH)
    telemetry = world.seal(Kind.TELEMETRY, bytes(codec.BODY_SIZES[Kind.TELEMETRY]))
    assert refuses(cloud, telemetry, "old_epoch")
    greeter = type(cloud)(Direction.UPLINK, cloud.ring) if cloud.sealed else unsealed()[0]
    challenge = codec.encode_challenge(b"c" * 16)
    assert cloud.open(greeter.greet(Kind.CHALLENGE, challenge))[4] == challenge


@pytest.mark.parametrize(
    ("key", "epoch", "nonces"),
    [
        (NEW, 1, NONCES),
        (OLD, 2, NONCES),
        (OLD, 1, b"x" * 16 + NONCES[16:]),
        (OLD, 1, NONCES[:16] + b"x" * 16),
    ],
)
def test_keys_depend_on_key_epoch_and_both_nonces(key: Key, epoch: int, nonces: bytes) -> None:
    world, cloud = a_session(Direction.UPLINK), a_session(key=key)
    world.begin(1, NONCES)
    cloud.begin(epoch, nonces)
    cloud.epoch = 1  # as a forger would write it
    assert refuses(world, cloud.seal(Kind.COMMAND, BODY))


def test_each_direction_has_its_own_key() -> None:
    world, cloud = pair()
    data = bytearray(world.seal(Kind.ALIVE, b""))
    data[1] = Direction.DOWNLINK
    assert refuses(world, bytes(data))
    assert cloud.seal(Kind.ALIVE, b"")[16:] != world.seal(Kind.ALIVE, b"")[16:]


def test_no_nonce_is_used_twice_in_an_epoch() -> None:
    _, cloud = pair()
    kinds = [Kind.COMMAND, Kind.OPERATOR, Kind.ALIVE]
    nonces = [
        cloud.seal(kind, bytes(codec.BODY_SIZES[kind]))[4:16] for kind in kinds for _ in range(50)
    ]
    assert len(set(nonces)) == 150


def test_an_end_cannot_begin_without_a_handshake() -> None:
    with pytest.raises(AssertionError, match=r"^the handshake comes first$"):
        a_session().begin(1)


def test_each_kind_has_its_own_counter_in_each_epoch() -> None:
    _, session = pair()
    session.seal(Kind.COMMAND, BODY)
    assert session.next_counter(Kind.COMMAND) == 1
    assert session.next_counter(Kind.OPERATOR) == 0
    session.begin(2)
    assert session.next_counter(Kind.COMMAND) == 0


@pytest.mark.parametrize(
    ("kind", "told"),
    [(Kind.HELLO, (0, 1)), (Kind.CHALLENGE, (0, 1)), (Kind.BUSY, (0, 1)), (Kind.ACCEPT, (5, 0))],
)
def test_only_an_acceptance_belongs_to_an_epoch(kind: Kind, told: tuple[int, int]) -> None:
    _, session = pair()
    session.greet(kind, b"")
    session.begin(5)
    assert codec.peek(session.greet(kind, b"")) == (kind, *told)


@pytest.mark.parametrize("ends", [pair, unsealed])
def test_greetings_of_both_kinds_of_session_need_their_tag(ends: Ends) -> None:
    world, cloud = ends()
    data = cloud.greet(Kind.HELLO, HELLO)
    assert world.open(data)[4] == HELLO
    assert refuses(world, data[:-1] + bytes([data[-1] ^ 1]))
    assert refuses(world, cloud.greet(Kind.HELLO, HELLO, NEW))


def test_while_two_keys_are_accepted_greetings_may_have_either() -> None:
    world, cloud = pair()
    world.ring.keys = KeySet(NEW, OLD)
    for key in (OLD, NEW):
        world.open(cloud.greet(Kind.HELLO, HELLO, key))
        assert world.greeting_key == key
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[2] == 1, "the session goes on"
    assert (world.epoch_key, world.is_outdated) == (OLD, True)
    world.begin(2, key=NEW)
    assert (world.epoch_key, world.is_outdated) == (NEW, False)


@pytest.mark.promise("old-keys-end")
def test_a_dropped_key_opens_nothing() -> None:
    world, cloud = pair()
    sealed, hello = cloud.seal(Kind.COMMAND, BODY), cloud.greet(Kind.HELLO, HELLO)
    world.ring.keys = KeySet(NEW, Key(b"m" * 32))
    assert refuses(world, sealed, "old_epoch")
    assert refuses(world, hello)
    assert world.epoch == NO_EPOCH
    world.ring.keys = KeySet(OLD)
    assert refuses(world, sealed, "old_epoch"), "nor when it comes back"


def datagrams(count: int) -> list[tuple[bytes, Session]]:
    """Make datagrams of every kind in both directions, each with the end that opens it."""
    world, cloud = pair()
    made = []
    for number in range(count):
        for end, other, kinds in (
            (world, cloud, (Kind.TELEMETRY, Kind.ALIVE, Kind.ACCEPT, Kind.CHALLENGE, Kind.BUSY)),
            (cloud, world, (Kind.COMMAND, Kind.OPERATOR, Kind.ALIVE, Kind.HELLO)),
        ):
            kind = kinds[number % len(kinds)]
            make = end.greet if kind <= codec.LAST_GREETING else end.seal
            made.append((make(kind, bytes([number % 256]) * codec.BODY_SIZES[kind]), other))
    return made


@pytest.mark.promise("forged-datagrams-do-nothing")
def test_no_bit_of_a_thousand_datagrams_can_be_flipped(figure: Callable[..., None]) -> None:
    accepted = flips = 0
    for data, opener in datagrams(500):
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
    figure("bit flips of 1,000 datagrams: accepted", accepted, "==", 0, count=flips)
    assert accepted == 0
    assert flips > 500_000


@given(st.sampled_from(datagrams(5)), st.data())
@settings(max_examples=200, deadline=None)
def test_a_refused_datagram_changes_nothing(
    made: tuple[bytes, Session], data: st.DataObject
) -> None:
    good, opener = made
    cut = data.draw(st.integers(0, len(good)))
    spoiled = good[:cut] + data.draw(st.binary(max_size=len(good) - cut + 3))
    before = state(opener)
    try:
        opener.open(spoiled)
    except DecodeError:
        assert state(opener) == before
    else:
        assert spoiled == good


def test_a_counter_that_no_recording_can_hold_is_refused() -> None:
    world, cloud = pair()
    cloud._counters[Kind.COMMAND] = 2**63 - 1
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[3] == 2**63 - 1
    assert refuses(world, cloud.seal(Kind.COMMAND, BODY), "malformed")
