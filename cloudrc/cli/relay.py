"""`cloudrc relay`: the emulated link's process, between world and cloud.

The relay of local mode follows what `cloudrc link set` leaves in a folder, and tells its state.

    DIR/profile.json, change.json    what is asked for; not there before the first change
    DIR/uplink.json, downlink.json   what is in force (`cloudrc/link/state.py`)
    DIR/uplink.released...           how late its datagrams left so far, every other second

Files are read and written by a thread of its own; the relay's loop only swaps the conditions.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.link_run import loader
from cloudrc.cli.output import say
from cloudrc.cli.runtime import (
    address,
    listening,
    open_exporter,
    process_arguments,
    resolve_address,
    warn_if_exposed,
)
from cloudrc.link.follow import PROFILE_PERIOD, Loaded, ProfileFile
from cloudrc.link.model import LinkDirection
from cloudrc.link.state import RELEASED_SUFFIX, LinkState, publish, summary, to_text

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.relay import Relay


COUNT_PERIOD_NS = 1_000_000_000
WAYS = ("uplink", "downlink")

ADDRESSES = {
    "--world-side": "where to receive from world",
    "--cloud-side": "where to receive from cloud",
    "--world": "where world receives; a name is resolved once",
    "--cloud": "where cloud receives; likewise",
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    process_arguments(parser)
    for flag, text in ADDRESSES.items():
        parser.add_argument(flag, type=address, required=True, metavar="HOST:PORT", help=text)
    parser.add_argument(
        "--link",
        type=Path,
        metavar="DIR",
        help="tell the link's state here, and follow what 'cloudrc link set' leaves (default: not)",
    )
    parser.add_argument(
        "--fifo",
        action="store_true",
        help="run before ordinary processes (SCHED_FIFO) if this user may: a shorter tail",
    )


def execute(options: argparse.Namespace) -> int:
    """Forward."""
    from cloudrc import assembly
    from cloudrc.config.load import fingerprint, read_experiment
    from cloudrc.drivers.feed import Feed
    from cloudrc.drivers.process import StopSignal
    from cloudrc.link.relay import Relay, settle
    from cloudrc.tunnel.codec import peek

    stop, exporter = StopSignal(), open_exporter(options, "link")
    experiment = read_experiment(str(options.config))
    uplink, downlink = assembly.build_links(experiment)
    world, cloud = (
        resolve_address("--world", options.world),
        resolve_address("--cloud", options.cloud),
    )
    settle()
    if options.fifo:  # before the relay is made, which looks whether it has it
        _run_first()
    relay = Relay(
        uplink,
        downlink,
        peek,
        world_side=_side("--world-side", options.world_side),
        cloud_side=_side("--cloud-side", options.cloud_side),
        world_peer=world,
        cloud_peer=cloud,
    )
    ask: Callable[[], bool] = stop
    if options.link:
        ask = controlled(stop, options.link, experiment, (uplink, downlink), exporter, relay)
    Feed.on_stdout().ready()
    if exporter is None:
        relay.run(ask)
    else:
        if not options.link:  # else whoever follows it has told
            show_asked(exporter, experiment)
        for way in WAYS:
            exporter.shaped("relay", way, "relay")
        exporter.runs(fingerprint(experiment))
        exporter.ready(True)
        relay.run(_counting(ask, relay, exporter))
    counts = ", ".join(f"{name} {count:g}" for name, count in relay.counts().items())
    print(f"cloudrc relay: {counts}", file=sys.stderr)
    return 0


def show_asked(exporter: Exporter, experiment: ResolvedExperiment) -> None:
    """Show the mean delay that each direction is asked to have at its beginning."""
    from cloudrc.assembly import link_profile
    from cloudrc.link.state import summary

    for way in WAYS:
        asked = summary(link_profile(getattr(experiment, way)))
        exporter.asked(way, asked["delay"] or 0.0)


def _side(flag: str, listen: tuple[str, int]) -> socket.socket:
    """Open the socket of one side."""
    from cloudrc.drivers.realtime import bind

    warn_if_exposed(listen)
    with listening(flag, listen):
        return bind(listen)


def _run_first() -> None:
    """Ask for SCHED_FIFO, and say what came of it."""
    from cloudrc.link.relay import ask_for_fifo

    refused = ask_for_fifo()
    said = f"runs at normal priority: {refused}" if refused else "runs under SCHED_FIFO"
    print(f"cloudrc relay: {said}", file=sys.stderr, flush=True)


def _counting(stop: Callable[[], bool], relay: Relay, exporter: Exporter) -> Callable[[], bool]:
    """Ask `stop`, and once a second tell the exporter what the relay has counted."""
    import time

    from cloudrc.records import Counted

    due_ns = 0

    def ask() -> bool:
        nonlocal due_ns
        now_ns = time.monotonic_ns()
        if now_ns >= due_ns:
            due_ns = now_ns + COUNT_PERIOD_NS
            counts = relay.outcomes() | relay.recent()
            exporter.see([Counted(now_ns, "link", name, n) for name, n in counts.items()])
        return stop()

    return ask


PROFILE_FILE = "profile.json"
RELEASED_PERIOD = 2.0
"""Between two tellings of how late datagrams left [s]: as often as an end notes it."""


def controlled(
    stop: Callable[[], bool],
    folder: Path,
    experiment: ResolvedExperiment,
    links: tuple[LinkDirection, LinkDirection],
    exporter: Exporter | None,
    relay: Relay,
) -> Callable[[], bool]:
    """Make of `stop`, which a relay asks all the time, one that follows a folder as well.

    Args:
        stop: Whether to end.
        folder: Where to look, and to tell.
        experiment: What the relay began with.
        links: Its uplink and downlink.
        exporter: Shows what is asked for; None if nobody does.
        relay: Takes in what has come before it changes, and says how late it is.
    """
    from cloudrc.assembly import link_profile

    ways = {"uplink": experiment.uplink, "downlink": experiment.downlink}
    values = {way: d.model_dump(mode="json", exclude_defaults=True) for way, d in ways.items()}
    control = RelayControl(
        folder,
        dict(zip(ways, links, strict=True)),
        {way: Loaded(link_profile(direction), values) for way, direction in ways.items()},
        exporter.asked if exporter else lambda direction, delay: None,
        relay.take_in,
        relay.released,
    )
    control.start()
    return control.stop_after(stop)


class RelayControl:
    """Both directions of a relay, and the folder from which they are set."""

    def __init__(
        self,
        folder: Path,
        links: dict[str, LinkDirection],
        first: dict[str, Loaded],
        asked: Callable[[str, float], None] = lambda direction, delay: None,
        take_in: Callable[[], None] = lambda: None,
        released: Callable[[str], dict[str, int]] = lambda way: {},
    ) -> None:
        """Tell what is in force from the start.

        Args:
            folder: Made if it is not there.
            links: "uplink" and "downlink".
            first: What they were made with.
            asked: Learns the mean delay [s] that a direction is asked to have from now on.
            take_in: Puts on the link what has come, before it changes.
            released: Says how late the datagrams of a direction left so far.
        """
        self._folder, self._links, self._asked, self._take_in = folder, links, asked, take_in
        self._released, self._told = released, 0.0
        folder.mkdir(exist_ok=True)
        file = folder / PROFILE_FILE
        self._files = {way: ProfileFile(file, loader(way), _log) for way in links}
        self._wanted: deque[tuple[str, Loaded]] = deque()
        self._done: deque[tuple[str, Loaded, int]] = deque()
        self._changes = dict.fromkeys(links, -1)
        for way, loaded in first.items():
            self._tell(way, loaded, time.monotonic_ns())

    def start(self) -> None:
        """Begin to follow the folder."""
        threading.Thread(target=self._follow, name="link control", daemon=True).start()

    def swap(self) -> None:
        """Put what is asked for in force; the relay's loop calls it between datagrams."""
        self._take_in()
        while self._wanted:
            way, loaded = self._wanted.popleft()
            self._links[way].replace_profile(loaded.direction, restart=loaded.change.restart)
            self._done.append((way, loaded, time.monotonic_ns()))

    def stop_after(self, stop: Callable[[], bool]) -> Callable[[], bool]:
        """Make of `stop`, which the relay asks all the time, one that swaps as well."""

        def ask() -> bool:
            if self._wanted:
                self.swap()
            return stop()

        return ask

    def look(self) -> None:
        """Look once for a change, and tell of those that are in force."""
        for way, file in self._files.items():
            if (loaded := file.poll()) is not None:
                self._wanted.append((way, loaded))
        with suppress(OSError):  # a full disk: what is not told is told at the next look
            self._tell_all()

    def _tell_all(self) -> None:
        while self._done:
            self._tell(*self._done[0])
            self._done.popleft()
        if time.monotonic() - self._told >= RELEASED_PERIOD:
            self._told = time.monotonic()
            for way in self._links:
                if released := self._released(way):
                    publish(self._folder / f"{way}{RELEASED_SUFFIX}", json.dumps(released))

    def _follow(self) -> None:
        while True:
            self.look()
            time.sleep(PROFILE_PERIOD / 2 if self._wanted else PROFILE_PERIOD)

    def _tell(self, way: str, loaded: Loaded, since_ns: int) -> None:
        changes = self._changes[way] + 1
        values: dict[str, Any] = loaded.values
        asked = summary(loaded.direction)
        state = LinkState(
            shaper="relay",
            reason="local mode",
            mode="relay",
            direction=way,
            profile=values,
            since=datetime.now(UTC).isoformat(timespec="seconds"),
            since_ns=since_ns,
            changes=changes,
            change=loaded.change.number,
            cause=loaded.change.cause if changes else "",
            asked=asked,
            # A time line that came up with the link counts from its first datagram.
            origin_ns=since_ns if changes and loaded.change.restart else None,
        )
        self._asked(way, asked["delay"] or 0.0)
        publish(self._folder / f"{way}.json", to_text(state))
        self._changes[way] = changes


def _log(line: str) -> None:
    say(f"cloudrc relay: {line}", sys.stderr)
