"""The codec: every message survives a round trip, and everything else is refused."""

import struct

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
from cloudrc.tunnel.codec import Accept, Busy, DecodeError, Hello, Kind

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


@given(telemetries)
@settings(max_examples=50, deadline=None)
def test_telemetry_comes_back_as_it_was(telemetry):
    assert codec.decode_telemetry(codec.encode_telemetry(telemetry)) == telemetry


@given(telemetries)
@settings(max_examples=20, deadline=None)
def test_the_stamps_of_telemetry_can_be_read_alone(telemetry):
    stamps_ns = codec.decode_stamps(codec.encode_telemetry(telemetry))
    assert stamps_ns == (telemetry.stamp_ns, telemetry.slip_ns)


@given(commands)
@settings(max_examples=50, deadline=None)
def test_a_command_comes_back_as_it_was(command):
    assert codec.decode_command(codec.encode_command(command)) == command


@given(requests)
@settings(max_examples=50, deadline=None)
def test_a_request_comes_back_as_it_was(request_):
    assert codec.decode_operator(codec.encode_operator(request_)) == request_


@given(requests, st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_the_epoch_of_a_request_is_not_in_its_body(request_, epoch):
    said = request_._replace(epoch=epoch)
    assert codec.encode_operator(said) == codec.encode_operator(request_)


def test_the_header_has_the_documented_layout():
    data = codec.encode_header(Kind.COMMAND, 1, 0x01020304, 0x1122334455667788, generation=9)
    assert data == bytes([5, 1, 4, 3, 2, 1, 9, 6]) + bytes.fromhex("8877665544332211")
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


@given(st.builds(Hello, *[st.binary(min_size=16, max_size=16)] * 3, st.integers(0, 255)))
@settings(max_examples=20, deadline=None)
def test_a_hello_comes_back_as_it_was(hello):
    assert codec.decode_hello(codec.encode_hello(hello)) == hello


@given(st.builds(Accept, *[st.binary(min_size=16, max_size=16)] * 3, st.integers(0, 255)))
@settings(max_examples=20, deadline=None)
def test_an_accept_comes_back_as_it_was(accept):
    assert codec.decode_accept(codec.encode_accept(accept)) == accept


def test_a_challenge_is_a_cookie_and_zeros():
    body = codec.encode_challenge(bytes(range(16)))
    assert body == bytes(range(16)) + bytes(33)
    assert codec.decode_challenge(body) == bytes(range(16))


@pytest.mark.parametrize("used", [False, True])
def test_a_refusal_comes_back_as_it_was(used):
    assert codec.decode_busy(codec.encode_busy(Busy(b"n" * 16, used))) == Busy(b"n" * 16, used)


def test_a_command_is_laid_out_as_documented():
    body = codec.encode_command(Command(1, 2, 3, (4.0, 5.0, 6.0), 7.0))
    assert body == struct.pack("<qqqdddd", 1, 2, 3, 4.0, 5.0, 6.0, 7.0)


@pytest.mark.parametrize("kind", list(Kind))
def test_every_wrong_length_is_refused(kind):
    whole = datagram(kind, bytes(codec.BODY_SIZES[kind]))
    codec.check(whole)
    for length in (*range(len(whole)), len(whole) + 1, 2048):
        with pytest.raises(DecodeError, match=r"^malformed$"):
            codec.check(whole[:length].ljust(length, b"\0"))


@pytest.mark.parametrize("version", sorted({*range(256)} - {codec.VERSION}))
def test_every_other_version_is_refused_by_name(version):
    data = bytearray(datagram(Kind.COMMAND, bytes(codec.BODY_SIZES[Kind.COMMAND])))
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


@pytest.mark.parametrize("size", range(codec.HEADER_SIZE))
def test_peek_refuses_a_datagram_shorter_than_a_header(size):
    with pytest.raises(DecodeError, match=r"^malformed$"):
        codec.peek(bytes(size))
