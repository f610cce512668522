# SPDX-License-Identifier: Apache-2.0

"""A direction of a TCP connection over the link, in virtual time."""

import hashlib
import random

import pytest

from cloudrc.link.carry.tcp.medium import SEGMENT, Medium
from cloudrc.link.carry.tcp.stream import LinkStream, run_due
from cloudrc.link.queue import NOTHING_NS, PacketQueue
from tests.link.profiles import blackout, changed, in_bursts, profile_of

MS = 1_000_000
PLAIN = profile_of(0.040)


class Far:
    """The far end of a stream, which takes all bytes at once."""

    def __init__(self, profile):
        self.agenda, self.bytes, self.times, self.end_ns = PacketQueue(), bytearray(), [], None
        ways = Medium(profile, 1, True, 0), Medium(profile, 1, False, 0)
        self.stream = LinkStream(self.agenda, ways, 1, self.deliver)
        self.stream.open(0)

    def deliver(self, data, now_ns):
        assert self.end_ns is None
        if not data:
            self.end_ns = now_ns
            return
        self.bytes += data
        self.times.append(now_ns)
        self.agenda.put(self.stream.taken, (now_ns,), (len(data),))

    def send(self, data, now_ns=0):
        """Send bytes as the stream takes them; return when the last one arrives [ms]."""
        began, sent = now_ns, 0
        wanted = len(self.bytes) + len(data)
        while True:
            if sent < len(data) and (room := self.stream.room):
                self.stream.write(data[sent : sent + room], now_ns)
                sent += room
            elif self.agenda.next_ns != NOTHING_NS and len(self.bytes) < wanted:
                now_ns = self.agenda.next_ns
                run_due(self.agenda, now_ns)
            else:
                return (self.times[-1] - began) / MS


@pytest.mark.parametrize("size", [200, 10 * SEGMENT, 1_400_000])
def test_without_a_rate_all_bytes_cross_in_the_delay(size):
    assert Far(PLAIN).send(bytes(size)) == pytest.approx(40)


def test_a_bottleneck_hands_on_one_segment_after_the_other():
    """100 segments of 1500 bytes at 12 Mbit/s, also if the queue has room for 3."""
    for queue in (3, 1000):
        far = Far(profile_of(0.040, rate=12e6, queue_packets=queue))
        assert far.send(bytes(100 * SEGMENT)) == pytest.approx(40 + 100)


@pytest.mark.parametrize(
    "profile",
    [
        profile_of(0.040, 0.020, loss=0.05),
        profile_of(0.010, loss=in_bursts(0.02, 0.3)),
        profile_of(0.005, rate=2_000_000.0, queue_packets=10),
        profile_of(0.020, blackouts=(blackout(0.05, 0.7),)),
    ],
)
def test_all_bytes_arrive_once_and_in_order(profile):
    data = random.Random(1).randbytes(700_000)
    far = Far(profile)
    far.send(data)
    far.stream.write(b"", 60_000 * MS)
    run_due(far.agenda, 90_000 * MS)
    assert hashlib.sha256(far.bytes).digest() == hashlib.sha256(data).digest()
    assert far.end_ns is not None


def test_a_lost_segment_costs_one_round_trip_if_a_later_one_arrives():
    far = Far(changed(PLAIN, blackouts=(blackout(0.0, 0.0005),)))
    far.stream.write(bytes(SEGMENT), 0)
    run_due(far.agenda, 1 * MS)
    far.stream.write(bytes(8 * SEGMENT), 1 * MS)
    run_due(far.agenda, 5_000 * MS)
    assert far.times == [(1 + 80 + 40) * MS]  # it held up those behind it


def test_a_lost_segment_waits_for_a_time_out_if_nothing_shows_the_loss():
    far = Far(changed(PLAIN, blackouts=(blackout(1.0, 0.01),)))
    far.send(b"x")
    run_due(far.agenda, 1_000 * MS)
    assert far.send(b"y", 1_000 * MS) == pytest.approx(80 + 200 + 40)


def test_a_link_that_keeps_the_order_holds_up_all_connections():
    medium = Medium(profile_of(0.040, 0.020, keep_order=True), 1, True, 0)
    times = [medium.cross(number % 3, number, 1, 100, 0) for number in range(100)]
    assert times == sorted(times)
    assert times[-1] > 55 * MS


def test_connections_share_one_bottleneck():
    medium = Medium(profile_of(0.0, rate=1_200_000.0), 1, True, 0)
    first, second = (medium.cross(number, 0, 1, 1448, 0) for number in (1, 2))
    assert (first, second) == (10 * MS, 20 * MS)
