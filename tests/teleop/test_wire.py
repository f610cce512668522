# SPDX-License-Identifier: Apache-2.0

"""Datagrams between cloud and teleop: every message comes back as it was, nothing else does."""

import json
from math import nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.teleop.wire import RobotStatus, decode, encode, read_line, write_line
from cloudrc.wire.messages import Cause, GuardState, OperatorRequest, Setpoint
from cloudrc.wire.records import MissionEvent
from tests.doors.console.conftest import control

messages = st.one_of(*map(st.from_type, (RobotStatus, Setpoint, OperatorRequest, MissionEvent)))


@settings(max_examples=60, deadline=None)
@given(messages)
def test_a_message_comes_back_as_it_was(message):
    back = decode(encode(message))
    assert repr(back) == repr(message)  # NaN is not equal to itself
    assert [type(value) for value in (back, *back)] == [
        type(value) for value in (message, *message)
    ]


@pytest.mark.parametrize("known", [None, control(0.1)])
def test_a_status_comes_back_from_its_line(known):
    status = RobotStatus(
        1,
        (0.0, 0.0, 1.0),
        GuardState.TRACK,
        7,
        cause=Cause.COMMAND,
        control=known,
        sensors=(11.9, nan),
    )
    line = write_line(status)
    assert repr(read_line(line)) == repr(status)
    tree = json.loads(line, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    assert (tree["touch_speed"], tree["position"]) == (None, [0.0, 0.0, 1.0])
    assert tree["sensors"] == [11.9, None]
    assert read_line(write_line(None)) is None
