"""The codec: every message survives a round trip, and everything else is refused."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.messages import (
    Cause,
    Command,
    GuardState,
    Odometry,
    OperatorRequest,
    Request,
    Start,
    Telemetry,
)
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Accept, DecodeError, Hello, Kind

stamps = st.integers(-(2**63), 2**63 - 1)
floats = st.floats(allow_nan=False)
vectors = st.tuples(floats, floats, floats)
telemetries = st.builds(
    lambda stamp, rest, position, orientation, velocity, rate: Telemetry(
        stamp, Odometry(stamp, position, orientation, velocity, rate), *rest
    ),
    stamps,
    st.tuples(
        floats,
        *[stamps] * 3,
        st.integers(0, 2**32 - 1),
        st.sampled_from(GuardState),
        st.integers(0, 2**32 - 1),
        floats,
        st.integers(0, 2**64 - 1),
        st.integers(0, 2**16 - 1),
        st.sampled_from(Cause),
    ),
    vectors,
    st.tuples(floats, floats, floats, floats),
    vectors,
    vectors,
)
commands = st.builds(Command, stamps, stamps, stamps, vectors, floats)
requests = st.builds(
    OperatorRequest,
    st.integers(0, 2**32 - 1),
    st.sampled_from(Request),
    st.sampled_from(Start),
    st.integers(0, 2**63 - 1),
    st.integers(0, 2**16 - 1),
    st.integers(-1, 2**63 - 1),
    epoch=st.just(0),  # not in the datagram's body
)


def datagram(kind: Kind, body: bytes) -> bytes:
    return codec.encode_header(kind, 0, 1, 2) + body + bytes(codec.TAG_SIZE)


names, cookies = (st.binary(min_size=size, max_size=size) for size in (16, codec.COOKIE_SIZE))
COME_BACK = {
    "telemetry": (telemetries, codec.encode_telemetry, codec.decode_telemetry),
    "command": (commands, codec.encode_command, codec.decode_command),
    "request": (requests, codec.encode_operator, codec.decode_operator),
    "hello": (
        st.builds(Hello, names, names, cookies, st.integers(0, 2**32 - 1)),
        codec.encode_hello,
        codec.decode_hello,
    ),
    "accept": (st.builds(Accept, names, names, names), codec.encode_accept, codec.decode_accept),
    "challenge": (cookies, codec.encode_challenge, codec.decode_challenge),
    "busy": (names, codec.encode_busy, codec.decode_busy),
}


@pytest.mark.parametrize("name", COME_BACK)
@given(st.data())
@settings(max_examples=50, deadline=None)
def test_every_body_comes_back_as_it_was(name, data):
    strategy, encode, decode = COME_BACK[name]
    message = data.draw(strategy)
    assert decode(encode(message)) == message


@given(telemetries)
@settings(max_examples=20, deadline=None)
def test_the_stamps_of_telemetry_can_be_read_alone(telemetry):
    stamps_ns = codec.decode_stamps(codec.encode_telemetry(telemetry))
    assert stamps_ns == (telemetry.stamp_ns, telemetry.slip_ns)


def test_the_epoch_of_a_request_is_not_in_its_body():
    said = OperatorRequest(1, Request.END)
    assert codec.encode_operator(said._replace(epoch=7)) == codec.encode_operator(said)


def test_the_header_has_the_documented_layout():
    data = codec.encode_header(Kind.COMMAND, 1, 0x01020304, 0x1122334455667788)
    assert data == bytes([6, 1, 4, 3, 2, 1, 0, 6]) + bytes.fromhex("8877665544332211")
    assert codec.peek(data) == (Kind.COMMAND, 0x01020304, 0x1122334455667788)


def test_a_direction_that_does_not_exist_is_refused():
    data = bytearray(datagram(Kind.ALIVE, b""))
    data[1] = 2
    with pytest.raises(DecodeError, match=r"^malformed$"):
        codec.check(bytes(data))


def test_no_answer_is_longer_than_its_hello():
    answers = (Kind.CHALLENGE, Kind.ACCEPT, Kind.BUSY)
    assert all(codec.SIZES[kind] <= codec.SIZES[Kind.HELLO] for kind in answers)
    assert codec.SIZES[Kind.HELLO] <= codec.SIZES[Kind.CHALLENGE]
    assert max(codec.SIZES.values()) <= codec.DATAGRAM_MAX


@pytest.mark.parametrize("kind", list(Kind))
def test_every_wrong_length_is_refused(kind):
    whole = datagram(kind, bytes(codec.BODY_SIZES[kind]))
    codec.check(whole)
    for length in (*range(len(whole)), len(whole) + 1, 2048):
        with pytest.raises(DecodeError, match=r"^malformed$"):
            codec.check(whole[:length].ljust(length, b"\0"))


def test_every_other_version_is_refused_by_name():
    data = bytearray(datagram(Kind.COMMAND, bytes(codec.BODY_SIZES[Kind.COMMAND])))
    for version in {*range(256)} - {codec.VERSION}:
        data[0] = version
        with pytest.raises(DecodeError, match=r"^version$"):
            codec.check(bytes(data))


@given(st.binary(max_size=400))
@settings(max_examples=100, deadline=None)
def test_garbage_raises_nothing_but_decode_errors(data):
    for read in (codec.check, codec.peek):
        try:
            read(data)
        except DecodeError:
            pass


@pytest.mark.parametrize(("offset", "value"), [(4, 9), (5, 9)])
def test_a_request_that_does_not_exist_is_refused(offset, value):
    body = bytearray(codec.encode_operator(OperatorRequest(1, Request.START, Start.HERE)))
    body[offset] = value
    with pytest.raises(DecodeError, match=r"^malformed$"):
        codec.decode_operator(bytes(body))


def test_a_mission_that_no_recording_can_name_is_refused():
    largest = OperatorRequest(1, Request.START, Start.HERE, mission_id=2**63 - 1)
    assert codec.decode_operator(codec.encode_operator(largest)) == largest
    for mission_id in (2**63, 2**64 - 1):
        with pytest.raises(DecodeError, match=r"^malformed$"):
            codec.decode_operator(codec.encode_operator(largest._replace(mission_id=mission_id)))


@pytest.mark.parametrize(("place", "field", "kind"), [(-2, 7, GuardState), (-1, -1, Cause)])
def test_an_unknown_state_or_cause_of_the_guard_is_refused(place, field, kind):
    body = bytearray(codec.BODY_SIZES[Kind.TELEMETRY])
    body[place] = max(kind)
    assert codec.decode_telemetry(bytes(body))[field] is max(kind)
    for wrong in (max(kind) + 1, 200):
        body[place] = wrong
        with pytest.raises(DecodeError, match=r"^malformed$"):
            codec.decode_telemetry(bytes(body))


def test_peek_refuses_a_datagram_shorter_than_a_header():
    for size in range(codec.HEADER_SIZE):
        with pytest.raises(DecodeError, match=r"^malformed$"):
            codec.peek(bytes(size))
