"""After a stall all waiting datagrams count as received before the wake."""

import socket
import time

import pytest

from cloudrc.drivers.realtime import (
    BACKLOG_MAX,
    DRAIN_MAX,
    STALL_AGAIN_NS,
    STALL_NS,
    Peer,
    bind,
    serve,
)

MANY = 300
MS = 1_000_000
LONG_NS = 10 * STALL_NS


class Late:
    """An end with a given lateness at each wake [ns]."""

    sealed = True

    def __init__(self, *late_ns):
        self._late_ns = list(late_ns)
        self.wakes = []
        self._heard = []

    def next_deadline_ns(self):
        return time.monotonic_ns() - self._late_ns[0]

    def receive_datagram(self, data, now_ns):
        self._heard.append(now_ns)

    def handle_deadline(self, now_ns):
        assert set(self._heard) <= {now_ns}
        self.wakes.append(len(self._heard))
        self._heard.clear()
        self._late_ns.pop(0)

    def take_datagrams(self):
        return []

    take_records = take_datagrams


@pytest.mark.parametrize(
    ("late_ns", "wakes"),
    [
        ((0, 0), [DRAIN_MAX, MANY - DRAIN_MAX]),
        ((LONG_NS, 0), [MANY, 0]),
        ((0, LONG_NS), [DRAIN_MAX, MANY - DRAIN_MAX]),
    ],
)
def test_what_waited_through_a_stall_is_taken_in_one_wake(late_ns, wakes):
    with bind(("127.0.0.1", 0)) as udp, socket.socket(type=socket.SOCK_DGRAM) as sender:
        for _ in range(MANY):
            sender.sendto(b"waits", udp.getsockname())
        end = Late(*late_ns)
        serve(end, Peer(udp, None), end="world", sink=list, stop=lambda: len(end.wakes) == 2)
        assert end.wakes == wakes


@pytest.mark.parametrize(
    ("late_ns", "wakes"),
    [
        ((LONG_NS, STALL_AGAIN_NS + MS, 0), [0, MANY, 0]),
        ((LONG_NS, STALL_AGAIN_NS - 100 * MS, 0), [0, DRAIN_MAX, MANY - DRAIN_MAX]),
    ],
)
def test_so_is_a_backlog_of_a_stall_after_a_late_wake(late_ns, wakes):
    """As on a busy processor, followed by a stall."""
    with bind(("127.0.0.1", 0)) as udp, socket.socket(type=socket.SOCK_DGRAM) as sender:
        end = Late(*late_ns)

        def over():
            if len(end.wakes) == 1:
                for _ in range(MANY):
                    sender.sendto(b"waits", udp.getsockname())
            return len(end.wakes) == 3

        serve(end, Peer(udp, None), end="world", sink=list, stop=over)
        assert end.wakes == wakes


class Flooded(Peer):
    """More datagrams wait than one wake takes."""

    def receive(self, most=DRAIN_MAX):
        return [b"flood"] * most


def test_a_flood_that_is_too_much_does_not_keep_the_loop_in_it():
    with bind(("127.0.0.1", 0)) as udp, socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.sendto(b"waits", udp.getsockname())
        end = Late(LONG_NS, LONG_NS, LONG_NS, LONG_NS)
        serve(end, Flooded(udp, None), end="world", sink=list, stop=lambda: len(end.wakes) == 4)
        assert end.wakes == [BACKLOG_MAX, DRAIN_MAX, BACKLOG_MAX, DRAIN_MAX]
