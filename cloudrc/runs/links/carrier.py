"""A link that a command runs between programs, connections or topics, and judges at the end."""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cloudrc.config.link_edit import edit_profile
from cloudrc.drivers.local import LINK, announced, socket_folder
from cloudrc.link.carry.engine import Engine, LinkWay
from cloudrc.link.carry.punctual import ask_for_fifo, settle
from cloudrc.link.carry.tun import IN_FLIGHT_MAX, TunPort, write_packet
from cloudrc.link.follow import Loaded
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DIRECTIONS
from cloudrc.link.queue import NOTHING_NS
from cloudrc.link.verify.packets import Period
from cloudrc.outside.document import Document
from cloudrc.runs.folder import new_folder
from cloudrc.runs.links.live import Changed, Check, LiveLink

STEP = 0.05  # longest time until the engine reacts to a change or a signal [s]
DRAIN_LIMIT = 1.0  # for the packets in flight at the end [s]
FLOWS = {"uplink": ("client", "server"), "downlink": ("server", "client")}
"""Direction -> the end that sends, and the end that receives."""
Tell = Callable[[str], None]
"""Function that shows a line to the user."""


@dataclass(frozen=True)
class CarrySettings:
    """What a command asks of its link; a field is the flag of this name."""

    link: str  # name or file of a profile
    settings: Sequence[str]  # changes of the profile: KEY=VALUE
    seed: int


def open_live(
    asked: CarrySettings,
    command: str,
    tell: Tell,
    stack: contextlib.ExitStack,
    *,
    output: Path | None = None,
    flag: str = "-o",
    check: Check = lambda profile, name: None,
) -> LiveLink:
    """Read the profile of a command's link, and make the folder of its state.

    `output` is a new folder for the link's state, given by `flag`; without it, the state is in a
    temporary folder. `check` is that of `LiveLink`.

    Raises:
        CloudrcError: If the profile or a setting cannot be used.
    """
    edit = edit_profile(Document({}), asked.link, asked.settings, command)
    for note in edit.notes:
        tell(f"note: {note}")
    base = tempfile.TemporaryDirectory(prefix="cloudrc-", dir=socket_folder())
    sockets = Path(stack.enter_context(base))
    folder = sockets if output is None else new_folder(output, "", flag=flag)
    url = f"unix:{sockets}/api.sock"  # as of a run, though nothing listens there
    stack.enter_context(announced(folder, url, LINK))
    live = LiveLink(edit, folder, url, f"cloudrc {command}", check)
    stack.callback(live.close)
    return live


class CarriedLink:
    """A link whose packets an engine carries.

    Attributes:
        live: The profile in force, which `cloudrc link set` changes.
        ways: Direction -> what happened to its packets; empty before `begin`.
        engine: Carries the packets; None before `begin`.
        unread: Direction -> number of packets that were dropped before the engine has read them.
    """

    def __init__(self, live: LiveLink, seed: int, stream: str = "") -> None:
        """Prepare a link; `stream` is its name, as in `cloudrc.link.open`."""
        self.live, self.seed, self._stream = live, seed, stream
        self.ways = dict[str, LinkWay]()
        self.engine: Engine | None = None
        self.unread = dict[str, int]()

    def begin(self, gives: Mapping[str, Callable[[Any], bool]], changed: Changed) -> None:
        """Begin the time line; `gives`: direction -> function that hands its packets on."""
        self.live.serve(self._queue, self._follow, changed)
        for name, give in gives.items():
            profile, origin_ns = self.live.profiles[name], self.live.origins_ns[name]
            up = name == "uplink"
            link = LinkDirection(profile, self.seed, up, origin_ns, stream=self._stream)
            self.ways[name] = LinkWay(link, give)

    def _queue(self, change: Callable[[], None]) -> None:
        assert self.engine is not None
        self.engine.changes.append(change)

    def _follow(self, name: str, loaded: Loaded, now_ns: int) -> None:
        """Use another profile from the next packet on."""
        if way := self.ways.get(name):
            way.link.replace_profile(loaded.direction, restart=loaded.change.restart)
            way.first = way.received

    def period(self, name: str) -> Period:
        """Return which packets of a direction followed its present profile."""
        profile, origin_ns = self.live.profiles[name], self.live.origins_ns[name]
        return Period(profile, self.seed, name == "uplink", self.ways[name].first, origin_ns)

    def counts(self) -> dict[str, int]:
        """Return the number of packets by outcome, and their lateness [ns]."""
        if self.engine is None:
            return {}
        errors = self.engine.errors.in_ns()
        errors.pop("released", None)
        return {**self.engine.counts(), "unread": sum(self.unread.values()), **errors}


class ExecLink(CarriedLink):
    """The link between two programs. A thread of its own carries the packets.

    Attributes:
        failure: Why the engine has stopped; "" while it works.
    """

    def __init__(self, live: LiveLink, seed: int) -> None:
        """Prepare a link."""
        super().__init__(live, seed)
        self.failure = ""
        self.unread = dict.fromkeys(DIRECTIONS, 0)
        self._stopping = False
        self._thread: threading.Thread | None = None
        self._devices: list[int] = []

    def start(self, devices: Mapping[str, int], changed: Changed) -> None:
        """Carry packets between the `devices` of "client" and "server", which this link closes.

        The time line of the profile begins.
        """
        self._devices = list(devices.values())
        flows = FLOWS.items()
        self.begin({name: partial(write_packet, devices[to]) for name, (_, to) in flows}, changed)
        port = TunPort({devices[sender]: self.ways[name] for name, (sender, _) in flows})
        engine = self.engine = Engine(port, list(self.ways.values()), IN_FLIGHT_MAX)
        port.drain()
        self._thread = threading.Thread(target=self._work, args=(engine,), daemon=True)
        self._thread.start()

    def wait_until_empty(self) -> None:
        """Wait until the packets in flight have arrived, at most `DRAIN_LIMIT`."""
        deadline = time.monotonic() + DRAIN_LIMIT
        while self.engine and self.engine.queue.next_ns != NOTHING_NS:
            if time.monotonic() > deadline:
                return
            time.sleep(0.005)

    def close(self) -> None:
        """Stop the engine; packets in flight are lost."""
        self._stopping = True
        self.live.close()
        if self._thread:
            self._thread.join()
        for device in self._devices:
            os.close(device)

    def _work(self, engine: Engine) -> None:
        settle()
        ask_for_fifo()
        try:
            while not self._stopping:
                engine.step(STEP)
        except Exception as error:
            self.failure = f"{type(error).__name__}: {error}"
