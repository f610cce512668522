"""The link between two programs while they run: its relay, its changes and its state."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from cloudrc.config.document import write_yaml
from cloudrc.config.load import DIRECTIONS, Edit, load_profile
from cloudrc.drivers.link_control import ControlServer
from cloudrc.drivers.local import LINK_FOLDER, link_socket
from cloudrc.files import write_atomically
from cloudrc.link.exec.relay import TunRelay, TunWay
from cloudrc.link.exec.verdict import Period
from cloudrc.link.follow import PROFILE, Loaded, Profiles
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile, summary
from cloudrc.link.relay import ask_for_fifo, settle, tighten_slack
from cloudrc.link.state import STATE_FILE, LinkState, to_text
from cloudrc.link.traces import link_profile

STEP = 0.05  # longest time until the relay reacts to a change [s]
DRAIN_LIMIT = 1.0  # for the packets in flight at the end [s]
FLOWS = {"uplink": ("client", "server"), "downlink": ("server", "client")}
"""Direction -> the end that sends, and the end that receives."""


class _Direction:
    """One direction of the link, whose profile can change."""

    def __init__(self, name: str, loaded: Loaded, seed: int) -> None:
        self.name, self.loaded, self._seed = name, loaded, seed
        self.way: TunWay | None = None
        self.state: LinkState | None = None
        self.unread = 0  # packets that the sender's device dropped
        self._period = Period(loaded.direction, seed, name == "uplink", 0, 0)

    @property
    def period(self) -> Period:
        """The packets since the last change."""
        return self._period

    def start(self, source: int, target: int, now_ns: int) -> None:
        """Carry packets between two devices from now on."""
        profile = self.loaded.direction
        link = LinkDirection(profile, self._seed, self.name == "uplink", now_ns)
        self.way = TunWay(link, source, target)
        self._period = replace(self._period, origin_ns=now_ns)
        self._renew(now_ns)

    def follow(self, loaded: Loaded) -> None:
        """Use another profile from the next packet on."""
        assert self.way is not None
        now_ns, restart = time.monotonic_ns(), loaded.change.restart
        self.loaded = loaded
        self.way.link.replace_profile(loaded.direction, restart=restart)
        origin_ns = now_ns if restart else self._period.origin_ns
        self._period = Period(
            loaded.direction, self._seed, self.name == "uplink", self.way.received, origin_ns
        )
        self._renew(now_ns)

    def _renew(self, now_ns: int) -> None:
        before, change = self.state, self.loaded.change
        self.state = LinkState(
            shaper="relay",
            reason="cloudrc link exec",
            mode="relay",
            direction=self.name,
            profile=self.loaded.values,
            since=datetime.now(UTC).isoformat(timespec="seconds"),
            since_ns=now_ns,
            changes=before.changes + 1 if before else 0,
            change=change.number,
            cause=change.cause if before else "",
            asked=summary(self.loaded.direction),
            origin_ns=self._period.origin_ns,
        )


class ExecLink:
    """The link between two programs. A thread of its own carries the packets.

    Attributes:
        relay: Carries the packets; None before `start`.
        failure: Why the relay has stopped; "" while it works.
    """

    def __init__(self, edit: Edit, seed: int, folder: Path, url: str) -> None:
        """Prepare a link with the profile `edit.values`.

        `folder` gets the state of the link, for `cloudrc link set`, which changes it through the
        sockets beside `url`.
        """
        self.cause, self.seed = edit.cause, seed
        self._folder, self._url = folder / LINK_FOLDER, url
        for way in DIRECTIONS:
            (self._folder / way).mkdir(parents=True)
        file = self._folder / PROFILE
        file.write_text(write_yaml(edit.values), encoding="utf-8")
        self._profiles = {
            way: Profiles(file, partial(_load, way), lambda _: None) for way in DIRECTIONS
        }
        self.directions = {
            way: _Direction(way, profiles.first(), seed) for way, profiles in self._profiles.items()
        }
        self.relay: TunRelay | None = None
        self.failure = ""
        self._changes = deque[Callable[[], None]]()
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._devices: list[int] = []
        self._servers: list[ControlServer] = []

    def start(self, devices: Mapping[str, int], changed: Callable[[LinkState], None]) -> None:
        """Carry packets between the `devices` of "client" and "server", which this link closes.

        The time line of the profile begins. `changed` gets each new state of a direction.
        """
        self._devices, now_ns = list(devices.values()), time.monotonic_ns()
        self._changed = changed
        ways = {}
        for name, one in self.directions.items():
            source, target = (devices[end] for end in FLOWS[name])
            one.start(source, target, now_ns)
            assert one.way is not None
            ways[name] = one.way
            self._publish(one)
            take = partial(self._take, one)
            socket = link_socket(self._url, name)
            self._servers.append(ControlServer(socket, take, partial(getattr, one, "state")))
        self.relay = TunRelay(ways)
        self.relay.drain()
        self._thread = threading.Thread(target=self._work, args=(self.relay,), daemon=True)
        self._thread.start()

    def wait_until_empty(self) -> None:
        """Wait until the packets in flight have arrived, at most `DRAIN_LIMIT`."""
        deadline = time.monotonic() + DRAIN_LIMIT
        while self.relay and self.relay.in_flight and time.monotonic() < deadline:
            time.sleep(0.005)

    def close(self) -> None:
        """Stop the relay; packets in flight are lost."""
        self._stopping = True
        for server in self._servers:
            server.shutdown()
            server.server_close()
        if self._thread:
            self._thread.join()
        for device in self._devices:
            os.close(device)
        shutil.rmtree(self._folder, ignore_errors=True)

    def counts(self) -> dict[str, int]:
        """Return the number of packets of both directions by outcome, and their lateness [ns]."""
        ways = [one.way for one in self.directions.values() if one.way]
        names = ("received", "forwarded", "lost", "overflow", "unsent")
        found = {name: sum(getattr(way, name) for way in ways) for name in names}
        found["unread"] = sum(one.unread for one in self.directions.values())
        errors = self.relay.errors.in_ns() if self.relay else {}
        errors.pop("released", None)
        return found | errors

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

    def _take(self, one: _Direction, document: bytes) -> str:
        """Take a change from `cloudrc link set`; return its number."""
        loaded = self._profiles[one.name].take(document, self._folder)

        def change() -> None:
            one.follow(loaded)
            self._publish(one)

        self._changes.append(change)
        return loaded.change.number

    def _publish(self, one: _Direction) -> None:
        assert one.state is not None
        with suppress(OSError):  # the link works even if the disk is full
            write_atomically(self._folder / one.name / STATE_FILE, to_text(one.state).encode())
        self._changed(one.state)

    def status_page(self) -> str:
        """Return the states of both directions as JSON. Any thread may call this method."""
        states = {name: asdict(one.state) for name, one in self.directions.items() if one.state}
        return json.dumps(states) + "\n"


def _load(way: str, path: Path) -> Loaded:
    """Read one direction of a profile's file."""
    profile = load_profile(path)
    values = profile.model_dump(mode="json", exclude_defaults=True)
    direction: DirectionProfile = link_profile(getattr(profile, way))
    return Loaded(direction, values)
