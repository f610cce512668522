# SPDX-License-Identifier: Apache-2.0

"""The packets in flight: copies, losses and a full queue. Simulated loops notice a wrong order."""

from cloudrc.link.model import LinkDirection
from cloudrc.link.queue import NOTHING_NS, PacketQueue
from tests.link.profiles import profile_of


def filled(count, capacity=None, **profile):
    """Return a queue after `count` packets that a link with a profile gets at once."""
    queue, link = PacketQueue(capacity), LinkDirection(profile_of(0.010, **profile), 1, True)
    for counter in range(count):
        queue.send(link, (3, 1, counter), 4, b"%d" % counter, 0)
    return queue


def arrivals(queue):
    found = []
    while queue.next_ns != NOTHING_NS:
        found.append(queue.pop()[-1])
    return found


def test_packets_that_arrive_together_keep_the_order_of_sending():
    assert arrivals(filled(5)) == [b"0", b"1", b"2", b"3", b"4"]


def test_a_lost_packet_never_arrives_and_a_copied_one_arrives_twice():
    lost = filled(1, loss=1.0)
    assert (lost.lost, lost.next_ns) == (1, NOTHING_NS)
    assert arrivals(filled(1, duplicate=1.0)) == [b"0"] * 2


def test_a_full_queue_drops_and_counts_what_does_not_fit():
    queue = filled(5, capacity=2)
    assert (len(arrivals(queue)), queue.overflow, queue.lost) == (2, 3, 0)
