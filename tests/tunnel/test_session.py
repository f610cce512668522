"""Sessions: which datagrams are opened, and that nothing changes before a tag is verified."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import DecodeError, Direction, Kind
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import (
    AES_256_GCM,
    CHACHA20_POLY1305,
    NO_EPOCH,
    Agreement,
    Session,
    UnsealedSession,
    make_session,
    pair,
)

BODY = bytes(range(codec.BODY_SIZES[Kind.COMMAND]))
AGREEMENT = Agreement(b"cloud".ljust(16), b"world".ljust(16))
HELLO = bytes(codec.BODY_SIZES[Kind.HELLO])


def a_session(sends=Direction.DOWNLINK, secret=bytes(32)):
    return Session(sends, KeyRing(KeySet(Key(secret))))


def state(session):
    """Return all state that a datagram could change; ciphers by their addresses."""
    known = {} if session._openers is None else vars(session._openers)
    known = {name: value for name, value in known.items() if name not in ("_derived", "_far_tries")}
    return {name: repr(value) for name, value in (vars(session) | known).items()}


def unsealed():
    ends = UnsealedSession(Direction.UPLINK), UnsealedSession(Direction.DOWNLINK)
    for end in ends:
        end.begin(1, AGREEMENT)
    return ends


@pytest.mark.parametrize("ends", [pair, unsealed, lambda: pair(suite=CHACHA20_POLY1305)])
def test_the_other_end_opens_what_one_end_seals(ends):
    world, cloud = ends()
    cloud.seal(Kind.COMMAND, BODY)
    datagram = world.open(cloud.seal(Kind.COMMAND, BODY))
    assert datagram == (Kind.COMMAND, Direction.DOWNLINK, 1, 1, BODY)


def test_a_sealed_datagram_hides_its_body():
    _, cloud = pair(epoch=7)
    data = cloud.seal(Kind.COMMAND, BODY)
    assert codec.peek(data) == (Kind.COMMAND, 7, 0)
    assert len(data) == codec.SIZES[Kind.COMMAND]
    assert all(BODY[i : i + 4] not in data for i in range(len(BODY) - 3))


def test_no_sealed_end_opens_an_unsealed_datagram():
    world, _ = pair()
    data = unsealed()[1].seal(Kind.COMMAND, BODY)
    assert len(data) == codec.SIZES[Kind.COMMAND]
    with pytest.raises(DecodeError, match=r"^tag$"):
        world.open(data)


def test_a_malformed_datagram_costs_no_cryptography(monkeypatch):
    world, cloud = pair()
    data = cloud.seal(Kind.COMMAND, BODY)
    longest = codec.DATAGRAM_MAX + 1  # size that an end reads of a longer one
    other = bytes([data[0] ^ 1]) + data[1:]

    def tried(*given):
        raise AssertionError("cryptography")

    monkeypatch.setattr(world._openers, "open", tried)
    monkeypatch.setattr(world, "_open_greeting", tried)
    cut = [data[:size] for size in range(len(data))]
    grown = [data.ljust(size, b"x") for size in range(len(data) + 1, longest + 1)]
    for each in (*cut, *grown, bytes(longest), other):
        with pytest.raises(DecodeError, match=r"^(malformed|version)$"):
            world.open(each)
    with pytest.raises(AssertionError, match="cryptography"):
        world.open(data)


def test_an_end_without_keys_is_not_sealed():
    assert not make_session(Direction.UPLINK, None).sealed
    assert make_session(Direction.UPLINK, KeyRing(KeySet(Key(bytes(32))))).sealed
    assert unsealed()[0].maintain(10**12) == []


@pytest.mark.parametrize("ends", [pair, unsealed])
def test_an_end_does_not_open_its_own_datagrams(ends):
    _, cloud = ends()
    with pytest.raises(DecodeError, match=r"^direction$"):
        cloud.open(cloud.seal(Kind.COMMAND, BODY))


@pytest.mark.parametrize("ends", [pair, unsealed])
def test_another_epoch_is_refused(ends):
    world, cloud = ends()
    old = cloud.seal(Kind.COMMAND, BODY)
    world.begin(2)
    with pytest.raises(DecodeError, match=r"^old_epoch$"):
        world.open(old)


@pytest.mark.parametrize("make", [a_session, lambda: UnsealedSession(Direction.DOWNLINK)])
def test_without_a_session_only_greetings_are_opened(make):
    cloud, (world, _) = make(), pair(epoch=NO_EPOCH)
    with pytest.raises(DecodeError, match=r"^old_epoch$"):
        cloud.open(world.seal(Kind.TELEMETRY, bytes(codec.BODY_SIZES[Kind.TELEMETRY])))
    assert cloud.maintain(0) == []
    challenge = codec.encode_challenge(b"c" * 16)
    assert cloud.open(world.greet(Kind.CHALLENGE, challenge))[4] == challenge


FLAWS = {
    "key": {"secret": b"x" * 32},
    "epoch": {"epoch": 2},
    "suite": {"suite": CHACHA20_POLY1305},
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_keys_depend_on_key_epoch_and_suite(flaw):
    world, _ = pair()
    _, cloud = pair(**FLAWS[flaw])
    cloud.epoch = 1  # as a forger would write it
    with pytest.raises(DecodeError, match=r"^tag$"):
        world.open(cloud.seal(Kind.COMMAND, BODY))


@pytest.mark.parametrize("nonces", [(b"x" * 16, b"w" * 16), (b"c" * 16, b"x" * 16)])
def test_keys_depend_on_both_nonces(nonces):
    world, cloud = a_session(Direction.UPLINK), a_session()
    world.begin(1, Agreement(b"c" * 16, b"w" * 16))
    cloud.begin(1, Agreement(*nonces))
    with pytest.raises(DecodeError, match=r"^tag$"):
        world.open(cloud.seal(Kind.COMMAND, BODY))


def test_each_direction_has_its_own_key():
    world, cloud = pair()
    data = bytearray(world.seal(Kind.ALIVE, b""))
    data[1] = Direction.DOWNLINK
    with pytest.raises(DecodeError, match=r"^tag$"):
        world.open(bytes(data))
    assert cloud.seal(Kind.ALIVE, b"")[16:] != world.seal(Kind.ALIVE, b"")[16:]


def test_no_nonce_is_used_twice_in_an_epoch():
    _, cloud = pair()
    kinds = [Kind.COMMAND, Kind.OPERATOR, Kind.ALIVE]
    nonces = [
        cloud.seal(kind, bytes(codec.BODY_SIZES[kind]))[4:16] for kind in kinds for _ in range(50)
    ]
    assert len(set(nonces)) == 150


def test_an_end_cannot_begin_without_a_handshake():
    with pytest.raises(AssertionError, match=r"^the handshake comes first$"):
        a_session().begin(1)


def test_each_kind_has_its_own_counter_in_each_epoch():
    _, session = pair()
    session.seal(Kind.COMMAND, BODY)
    assert session.next_counter(Kind.COMMAND) == 1
    assert session.next_counter(Kind.OPERATOR) == 0
    session.begin(2)
    assert session.next_counter(Kind.COMMAND) == 0


@pytest.mark.parametrize("kind", [Kind.HELLO, Kind.CHALLENGE, Kind.BUSY])
def test_counters_of_greetings_continue_across_epochs(kind):
    _, session = pair()
    session.greet(kind, b"")
    session.begin(5)
    assert codec.peek(session.greet(kind, b"")) == (kind, NO_EPOCH, 1)


@pytest.mark.parametrize("ends", [pair, unsealed])
def test_greetings_of_both_kinds_of_session_need_their_tag(ends):
    world, cloud = ends()
    for kind in (Kind.HELLO, Kind.BUSY):
        end, other = (world, cloud) if kind == Kind.BUSY else (cloud, world)
        data = end.greet(kind, bytes(codec.BODY_SIZES[kind]))
        other.open(data)
        with pytest.raises(DecodeError, match=r"^tag$"):
            other.open(data[:-1] + bytes([data[-1] ^ 1]))


def test_a_session_is_made_at_a_moment_of_its_clock():
    ring = KeyRing(KeySet(Key(b"a" * 32), Key(b"b" * 32), 10.0))
    late = make_session(Direction.UPLINK, ring, 10_000_000_000)
    assert (len(late.accepted), late._sends) == (1, Direction.UPLINK)
    assert len(make_session(Direction.UPLINK, ring, 9_999_999_999).accepted) == 2


def test_an_acceptance_belongs_to_the_epoch_that_it_opens():
    session, _ = pair(epoch=4)
    session.greet(Kind.ACCEPT, b"")
    session.begin(5)
    assert codec.peek(session.greet(Kind.ACCEPT, b"")) == (Kind.ACCEPT, 5, 0)


def test_a_greeting_with_another_key_is_refused():
    world, stranger = a_session(Direction.UPLINK), a_session(secret=b"x" * 32)
    with pytest.raises(DecodeError, match=r"^tag$"):
        world.open(stranger.greet(Kind.HELLO, HELLO))
    ours = a_session()
    assert world.open(ours.greet(Kind.HELLO, HELLO))[4] == HELLO
    assert world.greeting_key == ours.ring.current


def datagrams(count):
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


def flip_every_bit(made):
    """Flip each bit of each datagram; return how many copies were opened, and their number."""
    accepted = flips = 0
    for data, opener in made:
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
    return accepted, flips


@pytest.mark.promise("forged-datagrams-do-nothing")
def test_no_bit_of_a_thousand_datagrams_can_be_flipped(figure):
    accepted, flips = flip_every_bit(datagrams(500))
    figure("bit flips of 1,000 datagrams: accepted", accepted, "==", 0, count=flips)
    assert accepted == 0
    assert flips > 500_000


@given(st.sampled_from(datagrams(5)), st.data())
@settings(max_examples=200, deadline=None)
def test_a_refused_datagram_changes_nothing(made, data):
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


def test_the_default_suite_is_aes():
    assert AGREEMENT.suite == AES_256_GCM


def test_a_counter_that_no_recording_can_hold_is_refused():
    world, cloud = pair()
    cloud._counters[Kind.COMMAND] = 2**63 - 1
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[3] == 2**63 - 1
    before = state(world)
    with pytest.raises(DecodeError, match=r"^malformed$"):
        world.open(cloud.seal(Kind.COMMAND, BODY))
    assert state(world) == before
