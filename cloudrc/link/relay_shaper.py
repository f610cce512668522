"""The relay of a pod's sidecar: what the pod sends comes in, delayed as asked it goes to the peer.

tunnel end > [listen]  RelayShaper  [any port] > the other pod's tunnel end
"""

from __future__ import annotations

import socket

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay_lane import Address, Lane, Peek, Side
from cloudrc.link.relay_lanes import Lanes
from cloudrc.link.relay_wait import tighten_slack


class RelayShaper:
    """One direction of the link in userspace; a `Shaper`."""

    name = "relay"

    def __init__(self, listen: Address, direction: LinkDirection, peek: Peek) -> None:
        """Open the two sockets.

        Args:
            listen: Where this pod's tunnel end sends to; port 0 lets the kernel choose.
            direction: The link, its origin on the machine's monotonic clock.
            peek: Reads kind, epoch and counter of a datagram.

        Raises:
            OSError: If `listen` is taken.
        """
        self._inside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._inside.bind(listen)
        except OSError:
            self._inside.close()
            raise
        # The kernel refuses to send from a socket bound to 127.0.0.1 to another machine.
        self._outside = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._lane = Lane(Side(self._inside), Side(self._outside), direction, peek)
        self._lanes = Lanes((self._lane,), origin_ns=0)
        tighten_slack()

    def follow_peer(self, peer: Address) -> Address:
        """Send to this peer from now on; what is in flight goes there, too."""
        self._lane.target.peer = peer
        host, port = self._inside.getsockname()
        return host, port

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        """Shape by this profile from now on; what is in flight keeps the delay that it drew.

        Args:
            profile: Conditions.
            restart: Whether their time line counts from now; else from when the old one did.
        """
        self._lanes.take_in()  # what has come until now is of before
        self._lane.direction.replace_profile(profile, restart=restart)

    def step(self, timeout: float) -> None:
        """Forward for a moment, at most `timeout` [s]."""
        self._lanes.run(timeout)

    def counts(self) -> dict[str, int]:
        """Say how many datagrams met which outcome so far, and how late they left of late.

        As `Lanes.outcomes` and `Lanes.recent` do.
        """
        return self._lanes.outcomes() | self._lanes.recent()

    def released(self) -> dict[str, int]:
        """Say how late datagrams left since the beginning, as `Lane.released` does."""
        return self._lane.released()

    def close(self) -> None:
        """Close the sockets; what is in flight is lost."""
        self._lanes.close()
        self._inside.close()
        self._outside.close()
