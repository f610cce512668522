# SPDX-License-Identifier: Apache-2.0

"""The codec: every message survives a round trip, and everything else is refused."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.link.verify.probe import PROBE
from cloudrc.wire.messages import (
    FRAGMENT_MAX,
    RAYS_MAX,
    SENSORS_MAX,
    Cause,
    Command,
    Fragment,
    GuardState,
    Odometry,
    OperatorRequest,
    RangeScan,
    Request,
    Start,
    Telemetry,
)
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import DecodeError, Kind

stamps = st.integers(-(2**63), 2**63 - 1)
floats = st.floats(allow_nan=False)
vectors = st.tuples(floats, floats, floats)
odometries = st.builds(Odometry, stamps, vectors, st.tuples(*[floats] * 4), vectors, vectors)
unsigned = {bits: st.integers(0, 2**bits - 1) for bits in (16, 32, 63, 64)}
sensors = st.lists(floats, max_size=SENSORS_MAX).map(tuple)
telemetries = st.builds(
    Telemetry,
    *(stamps, odometries, sensors, stamps, stamps, stamps, unsigned[32]),
    *(st.sampled_from(GuardState), unsigned[32], floats, unsigned[64], unsigned[16]),
    st.sampled_from(Cause),
).map(lambda t: t._replace(odometry=t.odometry._replace(stamp_ns=t.stamp_ns)))
singles = st.floats(allow_nan=False, width=32)
plans = st.lists(st.tuples(singles, singles, singles), min_size=1, max_size=codec.PLAN_MAX)
commands = st.one_of(
    st.builds(Command, stamps, stamps, stamps, vectors, floats, st.just(()), st.just(-1)),
    st.builds(Command, stamps, stamps, stamps, vectors, floats, plans.map(tuple), stamps),
)
requests = st.builds(
    OperatorRequest,
    *(unsigned[32], st.sampled_from(Request), st.sampled_from(Start), unsigned[63], unsigned[16]),
    *(st.integers(-1, 2**63 - 1), st.just(0)),  # the epoch is in the header
    st.text(max_size=16),
)
distances = st.lists(unsigned[16], max_size=RAYS_MAX).map(tuple)
scans = st.builds(RangeScan, stamps, distances)
fragments = st.integers(1, 2**16 - 1).flatmap(
    lambda count: st.builds(
        Fragment,
        *(stamps, unsigned[32], st.integers(0, count - 1), st.just(count), st.booleans()),
        st.binary(min_size=1, max_size=FRAGMENT_MAX),
    )
)


COME_BACK = {
    "telemetry": telemetries,
    "command": commands,
    "operator": requests,
    "scan": scans,
    "fragment": fragments,
}


@pytest.mark.parametrize("name", COME_BACK)
@given(st.data())
@settings(max_examples=50, deadline=None)
def test_every_body_survives_a_round_trip(name, data):
    encode, decode = (getattr(codec, f"{way}code_{name}") for way in ("en", "de"))
    message = data.draw(COME_BACK[name])
    assert decode(encode(message)) == message


def test_no_answer_is_longer_than_its_hello():
    answers = (Kind.CHALLENGE, Kind.ACCEPT, Kind.BUSY)
    assert all(codec.SIZES[kind] <= codec.SIZES[Kind.HELLO] for kind in answers)
    assert codec.SIZES[Kind.HELLO] <= codec.SIZES[Kind.CHALLENGE]
    assert max(codec.SIZES.values()) <= codec.DATAGRAM_MAX


def outcome(read, data):
    try:
        read(bytes(data))
    except DecodeError as error:
        return str(error)
    return "fine"


@pytest.mark.parametrize("kind", list(Kind))
def test_every_wrong_length_direction_and_version_is_refused(kind):
    smallest = kind is Kind.FRAME  # at least a byte of the picture
    body = bytes(codec.BODY_SIZES[kind] + codec.TAG_SIZE + smallest)
    whole = codec.encode_header(kind, 0, 1, 2) + body
    assert outcome(codec.check, whole) == "fine"
    longer = {
        Kind.COMMAND: {len(whole) + 8 + 12 * n for n in range(1, 81)},
        Kind.OPERATOR: {len(whole) + n for n in range(1, 65)},
        Kind.TELEMETRY: {len(whole) + 8 * n for n in range(1, 17)},
        Kind.SCAN: {len(whole) + 2 * n for n in range(1, 542)},
        Kind.FRAME: {len(whole) + n for n in range(1, FRAGMENT_MAX)},
    }.get(kind, set())
    assert max(longer, default=0) <= codec.DATAGRAM_MAX <= 1200
    for length in {*range(1300), 2048} - longer - {len(whole)}:
        assert outcome(codec.check, whole[:length].ljust(length, b"\0")) == "malformed"
    for length in longer:
        assert outcome(codec.check, whole.ljust(length, b"\0")) == "fine"
    assert outcome(codec.check, bytes([whole[0], 2]) + whole[2:]) == "malformed"
    for version in {*range(256)} - {codec.VERSION}:
        assert outcome(codec.check, bytes([version]) + whole[1:]) == "version"
    for size in range(codec.HEADER_SIZE + 1):
        assert outcome(codec.peek, whole[:size]) == ("malformed" if size < 16 else "fine")


def test_an_unknown_kind_is_refused_at_every_length():
    """For example, a probe of `link verify` has the header of a tunnel's datagram."""
    for kind in (0, 11, PROBE):
        for size in sorted({codec.HEADER_SIZE, *codec.SIZES.values(), codec.DATAGRAM_MAX}):
            data = codec.encode_header(kind, 1, 1, 2).ljust(size, b"\0")
            assert outcome(codec.check, data) == "malformed"
            assert codec.peek(data)[0] == kind, "the link tells them apart"


LARGEST = codec.encode_operator(OperatorRequest(1, Request.PROGRESS, Start.HERE, 2**63 - 1))
FRAGMENT = codec.encode_fragment(Fragment(1, 2, 0, 2, False, b"."))
TELEMETRY = bytes(codec.BODY_SIZES[Kind.TELEMETRY])


@pytest.mark.parametrize(
    ("decode", "body", "offset", "largest"),
    [
        (codec.decode_operator, LARGEST, 4, max(Request)),
        (codec.decode_operator, LARGEST, 5, max(Start)),
        (codec.decode_operator, LARGEST, 13, 0x7F),  # a mission that no recording can name
        (codec.decode_fragment, FRAGMENT, 12, 1),  # of two
        (codec.decode_fragment, FRAGMENT, 16, True),
        (codec.decode_telemetry, TELEMETRY, -2, max(GuardState)),
        (codec.decode_telemetry, TELEMETRY, -1, max(Cause)),
    ],
)
def test_an_undefined_value_is_refused(decode, body, offset, largest):
    changed = bytearray(body)
    for value, said in ((largest, "fine"), (largest + 1, "malformed"), (255, "malformed")):
        changed[offset] = value
        assert outcome(decode, changed) == said


def test_a_name_of_a_body_that_is_no_text_is_refused():
    assert outcome(codec.decode_operator, LARGEST + b"\xff") == "malformed"
