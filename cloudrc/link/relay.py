"""The link in real time, both ways: datagrams come in and go out when the model says so.

    world <-> [world side]  Relay  [cloud side] <-> cloud

Local mode runs it; in a pod each direction has a sidecar of its own (`relay_shaper`).
"""

from __future__ import annotations

import socket
from collections.abc import Callable

from cloudrc.link.model import LinkDirection
from cloudrc.link.relay_lane import IN_FLIGHT_MAX, Address, Lane, Peek, Side
from cloudrc.link.relay_lanes import Lanes
from cloudrc.link.relay_wait import tighten_slack

LOOPBACK = "127.0.0.1"

_STOP_PERIOD = 0.1
"""How often `stop` is asked at least [s]."""


def bind_loopback(port: int = 0) -> socket.socket:
    """Open a UDP socket on 127.0.0.1; port 0 lets the kernel choose."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.bind((LOOPBACK, port))
    return bound


class Relay:
    """Forwards datagrams between world and cloud through the two directions of a link."""

    def __init__(
        self,
        uplink: LinkDirection,
        downlink: LinkDirection,
        peek: Peek,
        *,
        world_side: socket.socket,
        cloud_side: socket.socket,
        world_peer: Address | None = None,
        cloud_peer: Address | None = None,
        in_flight_max: int = IN_FLIGHT_MAX,
    ) -> None:
        """Set up; the sockets stay the caller's to close.

        Args:
            uplink: World to cloud. Its time begins with 0 at the first datagram, as in virtual
                time, whatever the processes take to start: leave its origin at 0.
            downlink: Cloud to world, likewise.
            peek: Reads kind, epoch and counter of a datagram.
            world_side: Bound UDP socket that world sends to.
            cloud_side: Bound UDP socket that cloud sends to.
            world_peer: Where world listens; None takes the source of its first valid datagram.
            cloud_peer: Where cloud listens; None likewise.
            in_flight_max: Datagrams held at once in each direction; what comes on top is dropped
                and counted.
        """
        self._world = Side(world_side, world_peer)
        self._cloud = Side(cloud_side, cloud_peer)
        self._ways = {
            "uplink": Lane(self._world, self._cloud, uplink, peek, in_flight_max),
            "downlink": Lane(self._cloud, self._world, downlink, peek, in_flight_max),
        }
        self._lanes = Lanes(tuple(self._ways.values()), origin_ns=None)

    def run(self, stop: Callable[[], bool]) -> None:
        """Forward, once, until `stop` says True; it is asked at least every 0.1 s."""
        tighten_slack()
        try:
            while not stop():
                self._lanes.run(_STOP_PERIOD)
        finally:
            self._lanes.close()

    def take_in(self) -> None:
        """Put on the link whatever has come: to be called before a direction's profile changes."""
        self._lanes.take_in()

    def released(self, way: str) -> dict[str, int]:
        """Say how late datagrams of "uplink" or "downlink" left so far, as `Lane.released` does."""
        return self._ways[way].released()

    def outcomes(self) -> dict[str, int]:
        """Count datagrams by what became of them, both ways together, as `Lanes.outcomes` does."""
        return self._lanes.outcomes()

    def recent(self) -> dict[str, int]:
        """Say how late datagrams left of late, both ways together, as `Lanes.recent` does."""
        return self._lanes.recent()

    def counts(self) -> dict[str, float]:
        """Say what has happened so far, both ways together, as `Lanes.counts` does."""
        return self._lanes.counts()
