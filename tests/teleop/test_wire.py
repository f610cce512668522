"""Datagrams between cloud and teleop: every message comes back as it was, nothing else does."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.messages import MISSION_OVER, GuardState, OperatorRequest, Request, Setpoint, Start
from cloudrc.records import Fault, MissionEvent
from cloudrc.teleop.wire import RobotStatus, decode, encode

numbers = st.floats(allow_nan=False)
vectors = st.tuples(numbers, numbers, numbers)
counts = st.integers(0, 2**62)
messages = st.one_of(
    st.builds(
        RobotStatus,
        epoch=counts,
        position=vectors,
        guard=st.sampled_from(GuardState),
        mission=counts,
        world=st.text(max_size=40),
        pipe_contacts=counts,
        touch_speed=numbers,
        slip_ns=counts,
        horizon=numbers,
        rtt=numbers,
        loop_delay=numbers,
        mission_id=counts,
        reached=counts,
    ),
    st.builds(Setpoint, vectors, numbers, st.integers(-1, 9999), counts),
    st.builds(
        OperatorRequest,
        number=counts,
        request=st.sampled_from(Request),
        start=st.sampled_from(Start),
        mission_id=counts,
        reached=st.integers(0, MISSION_OVER),
        basis_stamp_ns=counts,
        epoch=counts,
    ),
    st.builds(MissionEvent, counts, st.text(max_size=20), st.integers(-1, 9999), st.text()),
)


@settings(max_examples=200, deadline=None)
@given(messages)
def test_a_message_comes_back_as_it_was(message):
    back = decode(encode(message))
    assert back == message
    assert type(back) is type(message)
    assert [type(value) for value in back] == [type(value) for value in message]


def test_what_is_not_known_comes_back_unknown():
    back = decode(encode(RobotStatus(1, (0.0, 0.0, 1.0), GuardState.TRACK, 1)))
    assert math.isnan(back.touch_speed)
    assert math.isnan(back.rtt)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"{}",
        b'"Seen"',
        b'["Nobody", []]',
        b'["Seen", [1, [0, 0, 1], 7, 1]]',
        b'["Setpoint", [["a", 0, 0], 0, 0]]',
        b'["Setpoint", [[0, 0], 0, 0]]',
        b'["OperatorRequest", [1, 9, 0]]',
        b"[" * 5000,
        b"\xff\xfe",
        encode(Fault(0, "x", "y")),
        *(bytes([n]) * 9 for n in range(0, 256, 25)),
    ],
)
def test_what_is_no_message_is_refused(data):
    with pytest.raises(ValueError, match="not a message"):
        decode(data)
