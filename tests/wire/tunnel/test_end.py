# SPDX-License-Identifier: Apache-2.0

"""Both ends send telemetry and commands as bytes, or pass them as objects."""

from collections import Counter

import pytest

from cloudrc.wire.messages import ZERO, Command, Passed
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import Direction, Kind
from cloudrc.wire.tunnel.end import Identity, TunnelEnd
from tests.flights.conftest import CLOCK, ring
from tests.support.told import told

COMMAND = Command(1, 2, 3, (0.5, -0.5, 0.25), 0.0)
PLANNED = COMMAND._replace(plan=(*codec.as_planned((0.1, 0.0, 0.5)), ZERO), planned_ns=7)
TELEMETRY = told(5).telemetry


def make_end(sends, keys, *, passes=False):
    """Make an end of a session."""
    end = TunnelEnd(Identity(CLOCK, bytes(16), keys, passes), sends, Counter(), newest_wins=True)
    end._session.begin(1, bytes(32))
    return end


@pytest.mark.parametrize(
    ("kind", "message", "decode"),
    [
        (Kind.COMMAND, COMMAND, codec.decode_command),
        (Kind.COMMAND, PLANNED, codec.decode_command),
        (Kind.TELEMETRY, TELEMETRY, codec.decode_telemetry),
        (Kind.TELEMETRY, TELEMETRY._replace(sensors=(0.5,)), codec.decode_telemetry),
        (Kind.TELEMETRY, TELEMETRY._replace(sensors=(0.5,) * 16), codec.decode_telemetry),
    ],
)
def test_a_message_arrives_the_same_with_and_without_bytes(kind, message, decode):
    keys = ring()
    peer = make_end(Direction.DOWNLINK, keys)
    sealed, passed = (make_end(Direction.UPLINK, keys, passes=each) for each in (False, True))
    for end in (sealed, passed):
        end._queue(end._make_datagram(kind, message))
        end.count_sent()
    ((data,), (same,)) = (end.take_datagrams() for end in (sealed, passed))
    assert (type(data), type(same)) == (bytes, Passed)
    assert decode(peer._session.open(data)[3]) == peer._session.open(same)[3] == message
    assert sealed.counts == passed.counts == {"sent": 1, "sent_bytes": len(data)}


def test_a_rare_message_is_sent_as_bytes_between_ends_that_pass():
    end = make_end(Direction.DOWNLINK, ring(), passes=True)
    end._send(Kind.OPERATOR, b"body")
    (data,) = end.take_datagrams()
    assert (type(data), end.epoch) == (bytes, 1)
    for _ in range(2):  # each datagram counts once
        end.count_sent()
        assert end.counts == {"sent": 1, "sent_bytes": len(data)}
