"""The packets in flight: order of arrivals, copies, losses, damage and a full queue."""

from cloudrc.link.model import LinkDirection
from cloudrc.link.queue import NOTHING_NS, PacketQueue
from tests.link.profiles import profile_of

MS = 1_000_000


def direction(delay, *, uplink=True, **others):
    return LinkDirection(profile_of(delay, **others), 1, uplink)


def send(queue, link, counter, now_ns=0, data=b"data"):
    queue.send(link, (3, 1, counter), len(data), data, now_ns)


def arrivals(queue):
    found = []
    while queue.next_ns != NOTHING_NS:
        found.append(queue.pop())
    return found


def test_packets_of_both_directions_arrive_in_the_order_of_their_times():
    queue, slow, fast = PacketQueue(), direction(0.030), direction(0.010, uplink=False)
    send(queue, slow, 0)
    send(queue, fast, 0, 5 * MS)
    assert queue.next_ns == 15 * MS
    assert arrivals(queue) == [(15 * MS, fast, b"data"), (30 * MS, slow, b"data")]


def test_packets_that_arrive_together_keep_the_order_of_sending():
    queue, link = PacketQueue(), direction(0.010)
    for counter in range(5):
        send(queue, link, counter, data=b"%d" % counter)
    assert [data for _, _, data in arrivals(queue)] == [b"0", b"1", b"2", b"3", b"4"]


def test_a_lost_packet_never_arrives_and_a_copied_one_arrives_twice():
    queue = PacketQueue()
    send(queue, direction(0.010, loss=1.0), 0)
    assert (queue.lost, queue.next_ns) == (1, NOTHING_NS)
    send(queue, direction(0.010, duplicate=1.0), 0)
    assert [data for _, _, data in arrivals(queue)] == [b"data"] * 2


def test_a_full_queue_drops_and_counts_what_does_not_fit():
    queue, link = PacketQueue(capacity=2), direction(0.010)
    for counter in range(5):
        send(queue, link, counter)
    assert (len(arrivals(queue)), queue.overflow, queue.lost) == (2, 3, 0)
