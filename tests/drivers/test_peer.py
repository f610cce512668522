"""An end's socket marks datagrams that are too long for the tunnel."""

from __future__ import annotations

import socket
from contextlib import closing

import pytest

from cloudrc.drivers.realtime import Peer
from cloudrc.tunnel.codec import DATAGRAM_MAX, DecodeError, Kind
from cloudrc.tunnel.session import pair


@pytest.mark.parametrize("size", [DATAGRAM_MAX + 1, 2048, 60_000])
def test_an_oversized_datagram_is_cut_to_what_no_end_takes(size: int) -> None:
    world, cloud = pair()
    peer = Peer.bind(("127.0.0.1", 0), ("127.0.0.1", 9))
    with closing(peer.socket), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        data = cloud.seal(Kind.COMMAND, b"")
        other.sendto(data.ljust(size, b"x"), peer.socket.getsockname())
        (received,) = peer.receive()
    assert len(received) == DATAGRAM_MAX + 1
    with pytest.raises(DecodeError, match=r"^malformed$"):
        world.open(received)


@pytest.mark.parametrize(("listen", "other"), [("::1", "::1"), ("::", "::1"), ("::", "127.0.0.1")])
def test_ends_meet_over_ipv6_and_at_both_families(listen: str, other: str) -> None:
    far = Peer.bind((other, 0), ("127.0.0.1", 9))
    own = Peer.bind((listen, 0), far.socket.getsockname()[:2])
    far.address = (other, own.socket.getsockname()[1])
    with closing(own.socket), closing(far.socket):
        own.send([b"there"])
        far.send([b"back"])
        assert (far.receive(), own.receive(), own.unsent) == ([b"there"], [b"back"], 0)


def test_the_longest_datagram_of_the_tunnel_is_received_whole() -> None:
    peer = Peer.bind(("127.0.0.1", 0), ("127.0.0.1", 9))
    with closing(peer.socket), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.sendto(bytes(DATAGRAM_MAX), peer.socket.getsockname())
        assert peer.receive() == [bytes(DATAGRAM_MAX)]
