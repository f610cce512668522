"""The link between two programs while they run: the relay and its thread."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping

from cloudrc.config.profile import DIRECTIONS
from cloudrc.link.exec.relay import TunRelay, TunWay
from cloudrc.link.exec.verdict import Period
from cloudrc.link.follow import Loaded
from cloudrc.link.model import LinkDirection
from cloudrc.link.relay import ask_for_fifo, settle, tighten_slack
from cloudrc.runs.links.live import Changed, LiveLink

STEP = 0.05  # longest time until the relay reacts to a change [s]
DRAIN_LIMIT = 1.0  # for the packets in flight at the end [s]
FLOWS = {"uplink": ("client", "server"), "downlink": ("server", "client")}
"""Direction -> the end that sends, and the end that receives."""


class ExecLink:
    """The link between two programs. A thread of its own carries the packets.

    Attributes:
        live: The profile in force, which `cloudrc link set` changes.
        relay: Carries the packets; None before `start`.
        failure: Why the relay has stopped; "" while it works.
        unread: Direction -> number of packets that the sender's device has dropped.
    """

    def __init__(self, live: LiveLink, seed: int) -> None:
        """Prepare a link."""
        self.live, self.seed = live, seed
        self.relay: TunRelay | None = None
        self.failure = ""
        self.unread = dict.fromkeys(DIRECTIONS, 0)
        self._first = dict.fromkeys(DIRECTIONS, 0)
        self._changes = deque[Callable[[], None]]()
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._devices: list[int] = []

    def start(self, devices: Mapping[str, int], changed: Changed) -> None:
        """Carry packets between the `devices` of "client" and "server", which this link closes.

        The time line of the profile begins.
        """
        self._devices = list(devices.values())
        self.live.serve(self._changes.append, self._follow, changed)
        ways = {}
        for name, (sender, receiver) in FLOWS.items():
            profile, origin_ns = self.live.profiles[name], self.live.origins_ns[name]
            link = LinkDirection(profile, self.seed, name == "uplink", origin_ns)
            ways[name] = TunWay(link, devices[sender], devices[receiver])
        relay = self.relay = TunRelay(ways)
        relay.drain()
        self._thread = threading.Thread(target=self._work, args=(relay,), daemon=True)
        self._thread.start()

    @property
    def ways(self) -> Mapping[str, TunWay]:
        """Direction -> what happened to its packets; empty before `start`."""
        return self.relay.ways if self.relay else {}

    def period(self, name: str) -> Period:
        """Return which packets of a direction followed its present profile."""
        profile, origin_ns = self.live.profiles[name], self.live.origins_ns[name]
        return Period(profile, self.seed, name == "uplink", self._first[name], origin_ns)

    def wait_until_empty(self) -> None:
        """Wait until the packets in flight have arrived, at most `DRAIN_LIMIT`."""
        deadline = time.monotonic() + DRAIN_LIMIT
        while self.relay and self.relay.in_flight and time.monotonic() < deadline:
            time.sleep(0.005)

    def close(self) -> None:
        """Stop the relay; packets in flight are lost."""
        self._stopping = True
        self.live.close()
        if self._thread:
            self._thread.join()
        for device in self._devices:
            os.close(device)

    def counts(self) -> dict[str, int]:
        """Return the number of packets of both directions by outcome, and their lateness [ns]."""
        if self.relay is None:
            return {}
        names = ("received", "forwarded", "lost", "overflow", "unsent")
        ways = self.relay.ways.values()
        found = {name: sum(getattr(way, name) for way in ways) for name in names}
        found["unread"] = sum(self.unread.values())
        errors = self.relay.errors.in_ns()
        errors.pop("released", None)
        return found | errors

    def _follow(self, name: str, loaded: Loaded, now_ns: int) -> None:
        """Use another profile from the next packet on."""
        assert self.relay is not None
        way = self.relay.ways[name]
        way.link.replace_profile(loaded.direction, restart=loaded.change.restart)
        self._first[name] = way.received

    def _work(self, relay: TunRelay) -> None:
        settle()
        tighten_slack()
        ask_for_fifo()
        try:
            while not self._stopping:
                while self._changes:
                    self._changes.popleft()()
                relay.step(STEP)
        except Exception as error:
            self.failure = f"{type(error).__name__}: {error}"
