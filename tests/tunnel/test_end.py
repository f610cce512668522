"""Both ends send telemetry and commands as bytes, or pass them as objects."""

from collections import Counter

import pytest

from cloudrc.messages import UPRIGHT, ZERO, Command, GuardState, Odometry, Passed, Telemetry
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Direction, Kind
from cloudrc.tunnel.end import Identity, TunnelEnd
from tests.flights.conftest import CLOCK, ring

COMMAND = Command(1, 2, 3, (0.5, -0.5, 0.25), 0.0)
PLANNED = COMMAND._replace(plan=((1.0, 0.0, 0.5), ZERO), planned_ns=7)
TELEMETRY = Telemetry(
    5, Odometry(5, ZERO, UPRIGHT, ZERO, ZERO), (0.5,), 1, 2, 0, 0, GuardState.TRACK, touch_speed=0.0
)


def make_end(identity, sends):
    return TunnelEnd(identity, sends, Counter(), newest_wins=True)


def peer_bytes(kind, message):
    """Encode a message as an end without a peer in the same process does."""
    end = make_end(Identity(CLOCK, bytes(16), ring()), Direction.UPLINK)
    end._session.begin(1, bytes(32))
    return end._make_datagram(kind, message)


@pytest.mark.parametrize(
    ("kind", "message", "decode"),
    [
        (Kind.COMMAND, COMMAND, codec.decode_command),
        (Kind.COMMAND, PLANNED, codec.decode_command),
        (Kind.TELEMETRY, TELEMETRY, codec.decode_telemetry),
        (Kind.TELEMETRY, TELEMETRY._replace(sensors=()), codec.decode_telemetry),
        (Kind.TELEMETRY, TELEMETRY._replace(sensors=(0.5,) * 16), codec.decode_telemetry),
    ],
)
def test_a_message_arrives_the_same_with_and_without_bytes(kind, message, decode):
    bodies, keys = [], ring()
    for passes in (False, True):
        end = make_end(Identity(CLOCK, bytes(16), keys, passes), Direction.UPLINK)
        peer = make_end(Identity(CLOCK, bytes(16), keys), Direction.DOWNLINK)
        for each in (end, peer):
            each._session.begin(1, bytes(32))
        end._queue(end._make_datagram(kind, message))
        (data,) = end.take_datagrams()
        assert isinstance(data, Passed) is passes
        body = peer._session.open(data)[3]
        bodies.append(body if passes else decode(body))
        assert end.counts == {"sent": 1, "sent_bytes": len(peer_bytes(kind, message))}
    assert bodies == [message, message]


def test_a_rare_message_is_sent_as_bytes_between_ends_that_pass():
    end = make_end(Identity(CLOCK, bytes(16), ring(), passes=True), Direction.DOWNLINK)
    end._session.begin(1, bytes(32))
    end._send(Kind.OPERATOR, b"body")
    (data,) = end.take_datagrams()
    assert isinstance(data, bytes)
    assert end.counts == {"sent": 1, "sent_bytes": len(data)}
