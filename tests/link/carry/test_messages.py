# SPDX-License-Identifier: Apache-2.0

"""Messages of any size over one direction of the link, as a relay of topics carries them."""

import pytest

from cloudrc.link.carry.engine import Engine, LinkWay
from cloudrc.link.carry.messages import MessageWay
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.carry.tcp.stream import run_due
from cloudrc.link.library import OneWay
from cloudrc.link.model import HEADER_BYTES, LinkDirection
from tests.link.profiles import profile_of

MS = 1_000_000
LOSSY = profile_of(0.030, loss=0.02)


class Topic:
    """A topic whose messages cross the link; `took` has the number and the time [ms] of each."""

    def __init__(self, *, repairs):
        self.took, self.numbers = [], []
        self.way = LinkWay(LinkDirection(LOSSY, 1, True), self.publish)
        self.engine = Engine(None, (self.way,), None)
        ways = ((LOSSY, True), (LOSSY, False))
        media = tuple(Medium(one, 1, up, 0, headers=HEADER_BYTES) for one, up in ways)
        self.carried = MessageWay(self.engine, self.way, media if repairs else None)

    def publish(self, data):
        self.took.append(int.from_bytes(data[:4], "big"))
        return True

    def send(self, sizes, period_ms=50):
        """Send messages; return when each is due [ms], by its number."""
        for number, size in enumerate(sizes):
            now_ns = number * period_ms * MS
            run_due(self.engine.queue, now_ns)
            data = number.to_bytes(4, "big") + bytes(size - 4)
            if packet := self.carried.take(data, now_ns):
                self.way.received += 1
                arrivals = self.way.link.send(*packet.header[1::-1], packet.header[2], size, now_ns)
                self.way.log.enter(now_ns, size, arrivals)
                self.engine.queue.put(self.engine.leave, arrivals, (self.way, number, data))
        run_due(self.engine.queue, 1 << 62)
        due = self.way.log.due
        return {n: due[n] / MS - n * period_ms for n in range(len(due)) if due[n] > 0}


def test_a_large_message_of_datagrams_is_lost_with_any_of_its_packets():
    topic, up = Topic(repairs=False), OneWay(LOSSY, 1, True)
    found = topic.send([12_000] * 300)
    whole = {n for n in range(300) if up.send_message(1, n, 12_000, n * 50 * MS)}
    assert found.keys() == whole == set(topic.took)
    assert set(found.values()) == {30.0}


def test_a_large_message_of_a_stream_is_late_and_in_order():
    topic = Topic(repairs=True)
    found = topic.send([12_000] * 300)
    assert topic.took == list(range(300))
    late = sum(each > 30.0 for each in found.values())
    assert late >= 300 * (1 - 0.98**10) / 2
    assert min(found.values()) == 30.0


@pytest.mark.parametrize("repairs", [False, True])
def test_small_messages_are_packets_as_ever(repairs):
    topic, up = Topic(repairs=repairs), OneWay(LOSSY, 1, True)
    topic.send([1200] * 300)
    assert topic.took == [n for n in range(300) if up.send(1, n, 1200, n * 50 * MS)]
