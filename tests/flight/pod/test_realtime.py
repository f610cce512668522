# SPDX-License-Identifier: Apache-2.0

"""The real-time driver: addresses and routes, sockets, stalls and floods."""

import os
import socket
import time
from contextlib import closing
from pathlib import Path

import pytest

from cloudrc.flight.pod.realtime import (
    DRAIN_MAX,
    ROUTE_PERIOD_NS,
    STALL_AGAIN_NS,
    STALL_NS,
    Peer,
    bind,
    serve,
    show_address,
)
from tests.conftest import needs_ipv6

MANY = 300
MS = 1_000_000
LONG_NS = 10 * STALL_NS


def write(path, text, moment_ns):
    path.write_text(text)
    os.utime(path, ns=(moment_ns, moment_ns))


def test_a_peer_follows_its_route_twice_a_second(tmp_path):
    path = tmp_path / "route"
    peer = Peer(bind(("127.0.0.1", 0)), path)
    with peer.socket, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
        there.bind(("127.0.0.1", 0))
        there.settimeout(5)
        peer.follow(0)
        peer.send([b"to nobody"])
        write(path, f"127.0.0.1:{there.getsockname()[1]}\n", 1)
        peer.follow(1)
        peer.send([b"hello"])
        assert there.recv(100) == b"hello"
        write(path, "10.1.2.3:7400", 2)
        peer.follow(ROUTE_PERIOD_NS)
        assert peer.address == there.getsockname()
        peer.follow(ROUTE_PERIOD_NS + 1)
        write(path, "name:7400", 3)  # a query of the name would block the loop
        peer.follow(2 * ROUTE_PERIOD_NS + 1)
        assert peer.address == ("10.1.2.3", 7400)


@needs_ipv6
@pytest.mark.parametrize("other", ["::1", "127.0.0.1"])
def test_ends_meet_over_ipv6_and_at_both_families(other, tmp_path):
    routes = tmp_path / "far", tmp_path / "own"
    far, own = Peer(bind((other, 0)), routes[0]), Peer(bind(("::", 0)), routes[1])
    with closing(own.socket), closing(far.socket):
        for peer, to, route in zip((far, own), (own, far), routes, strict=True):
            route.write_text(show_address((other, to.socket.getsockname()[1])))
            peer.follow(0)
        own.send([b"there"])
        far.send([b"back"])
        assert (far.receive(), own.receive()) == ([b"there"], [b"back"])


class Late:
    """An end with a given lateness at each wake [ns]."""

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
    ("late_ns", "arrive", "wakes"),
    [
        ((0, LONG_NS), 0, [DRAIN_MAX, MANY - DRAIN_MAX]),
        # A stall that follows a late wake, as on a busy processor:
        ((LONG_NS, STALL_AGAIN_NS + MS, 0), 1, [0, MANY, 0]),
    ],
)
@pytest.mark.fault(
    39,
    "world-paused",
    injects="a process stops for a moment",
    expects="what has arrived meanwhile is taken in one wake",
)
def test_what_waited_through_a_stall_is_taken_in_one_wake(late_ns, arrive, wakes):
    with bind(("127.0.0.1", 0)) as udp, socket.socket(type=socket.SOCK_DGRAM) as sender:
        end, sent = Late(*late_ns), []

        def over():
            if len(end.wakes) == arrive and not sent:
                sent.extend(sender.sendto(b"waits", udp.getsockname()) for _ in range(MANY))
            return len(end.wakes) == len(wakes)

        serve(end, Peer(udp, Path("absent")), end="world", sink=list, stop=over)
        assert end.wakes == wakes
