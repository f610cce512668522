"""`cloudrc relay`: run the emulated link between world and cloud.

With `--link DIR` the relay follows the changes of `cloudrc link set` and publishes its state:

    DIR/profile.json, change.json            requested profile; missing before the first change
    DIR/uplink.json, downlink.json           state in force (`cloudrc/link/state.py`)
    DIR/uplink.released, downlink.released   how late datagrams left so far, written every 2 s

A separate thread reads and writes these files; the relay's loop only replaces the profiles.
"""

from __future__ import annotations

import argparse
import json
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.link_run import make_profile_loader
from cloudrc.cli.output import print_line
from cloudrc.cli.runtime import (
    listening,
    open_exporter,
    process_arguments,
    read_address,
    resolve_address,
    warn_if_exposed,
)
from cloudrc.errors import BadInputError
from cloudrc.link.follow import PROFILE_PERIOD, Loaded, ProfileFile
from cloudrc.link.model import LinkDirection
from cloudrc.link.state import PROFILE_FILE, RELEASED_SUFFIX, LinkState, publish, summary, to_text

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.relay import Relay


COUNT_PERIOD_NS = 1_000_000_000
"""Time between two updates of the relay's counts in the exporter [ns]."""
WAYS = ("uplink", "downlink")

ADDRESSES = {
    "--world-side": "address to receive from world at",
    "--cloud-side": "address to receive from cloud at",
    "--world": "address at which world receives; a name is resolved once",
    "--cloud": "address at which cloud receives; a name is resolved once",
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    process_arguments(parser)
    for flag, text in ADDRESSES.items():
        parser.add_argument(flag, type=read_address, required=True, metavar="HOST:PORT", help=text)
    parser.add_argument(
        "--link",
        type=Path,
        metavar="DIR",
        help="folder to write the link's state to and to read changes of 'cloudrc link set' from",
    )
    parser.add_argument(
        "--fifo",
        action="store_true",
        help="use real-time priority (SCHED_FIFO), if permitted: less timing error",
    )


def execute(options: argparse.Namespace) -> int:
    """Forward datagrams until stopped."""
    from cloudrc import assembly
    from cloudrc.config.load import fingerprint, read_experiment
    from cloudrc.drivers.feed import Feed
    from cloudrc.drivers.process import StopSignal
    from cloudrc.link.relay import ask_for_fifo, settle

    stop, exporter = StopSignal(), open_exporter(options, "link")
    experiment = read_experiment(str(options.config))
    uplink, downlink = assembly.build_links(experiment)
    settle()
    if options.fifo:
        refused = ask_for_fifo()
        result = f"runs at normal priority: {refused}" if refused else "runs under SCHED_FIFO"
        print(f"cloudrc relay: {result}", file=sys.stderr, flush=True)
    relay = open_relay(options, uplink, downlink)
    first = read_profiles(experiment)
    asked: Callable[[str, float], object] = exporter.asked if exporter else lambda way, delay: None
    should_stop: Callable[[], bool] = stop
    if options.link:
        links = {"uplink": uplink, "downlink": downlink}
        control = RelayControl(options.link, links, first, asked, relay)
        control.start()
        should_stop = control.stop_after(stop)
    feed = Feed.on_stdout(watched=options.feed)
    feed.ready()
    should_stop = feed.alive_while(should_stop)
    if exporter is not None:
        for way, loaded in first.items():
            asked(way, summary(loaded.direction)["delay"] or 0.0)
            exporter.shaped("relay", way, "relay")
        exporter.runs(fingerprint(experiment))
        exporter.ready(True)
        should_stop = _counting(should_stop, relay, exporter)
    relay.run(should_stop)
    counts = ", ".join(f"{name} {count:g}" for name, count in relay.counts().items())
    print(f"cloudrc relay: {counts}", file=sys.stderr)
    return 0


def open_relay(
    options: argparse.Namespace, uplink: LinkDirection, downlink: LinkDirection
) -> Relay:
    """Make the relay between the addresses of the command line.

    Raises:
        BadInputError: If an address is not usable; the text names the flags.
    """
    from cloudrc.link.relay import Relay
    from cloudrc.tunnel.codec import peek

    peers = {
        "world_peer": resolve_address("--world", options.world),
        "cloud_peer": resolve_address("--cloud", options.cloud),
    }
    with ExitStack() as opened:
        sides = {
            "world_side": opened.enter_context(_bind_side("--world-side", options.world_side)),
            "cloud_side": opened.enter_context(_bind_side("--cloud-side", options.cloud_side)),
        }
        try:
            relay = Relay(uplink, downlink, peek, **sides, **peers)  # type: ignore[arg-type]
        except OSError as error:
            raise BadInputError(
                "the relay cannot reach --world from --world-side, or --cloud from --cloud-side "
                f"({error.strerror or error}); give each side an address that reaches its end"
            ) from error
        opened.pop_all()  # they stay open until this process ends
        return relay


def _bind_side(flag: str, listen: tuple[str, int]) -> socket.socket:
    """Bind the socket of one side."""
    from cloudrc.drivers.realtime import bind

    warn_if_exposed(listen)
    with listening(flag, listen):
        return bind(listen)


def read_profiles(experiment: ResolvedExperiment) -> dict[str, Loaded]:
    """Return the profiles that the relay starts with, by direction."""
    from cloudrc.assembly import link_profile

    ways = {way: getattr(experiment, way) for way in WAYS}
    values = {way: d.model_dump(mode="json", exclude_defaults=True) for way, d in ways.items()}
    return {way: Loaded(link_profile(direction), values) for way, direction in ways.items()}


def _counting(stop: Callable[[], bool], relay: Relay, exporter: Exporter) -> Callable[[], bool]:
    """Wrap `stop` in a function that also exports the relay's counts once a second."""
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


RELEASED_PERIOD = 2.0
"""Time between two publications of the lateness of datagrams [s]; an end reads with this period."""


class RelayControl:
    """Apply the changes of the profile file in a folder to both directions of a relay."""

    def __init__(
        self,
        folder: Path,
        links: Mapping[str, LinkDirection],
        first: Mapping[str, Loaded],
        asked: Callable[[str, float], object],
        relay: Relay,
    ) -> None:
        """Publish the initial state.

        Args:
            folder: Folder of the profile and of the link's state; created if missing.
            links: The links "uplink" and "downlink".
            first: The profiles that the links have started with.
            asked: Called with a direction and its newly requested mean delay [s].
            relay: The relay. Before a change it takes in the datagrams that have arrived.
        """
        self._folder, self._links, self._asked, self._relay = folder, links, asked, relay
        self._released_at = 0.0
        folder.mkdir(exist_ok=True)
        file = folder / PROFILE_FILE
        self._files = {way: ProfileFile(file, make_profile_loader(way), _log) for way in links}
        self._pending: deque[tuple[str, Loaded]] = deque()
        self._applied: deque[tuple[str, Loaded, int]] = deque()
        self._changes = dict.fromkeys(links, -1)
        for way, loaded in first.items():
            self._publish(way, loaded, time.monotonic_ns())

    def start(self) -> None:
        """Start the thread that follows the folder."""
        threading.Thread(target=self._follow, name="link control", daemon=True).start()

    def swap(self) -> None:
        """Apply the pending profiles; the relay's loop calls this between datagrams."""
        self._relay.take_in()
        while self._pending:
            way, loaded = self._pending.popleft()
            self._links[way].replace_profile(loaded.direction, restart=loaded.change.restart)
            self._applied.append((way, loaded, time.monotonic_ns()))

    def stop_after(self, stop: Callable[[], bool]) -> Callable[[], bool]:
        """Return a function for the relay's loop: apply pending changes, then call `stop`."""

        def ask() -> bool:
            if self._pending:
                self.swap()
            return stop()

        return ask

    def look(self) -> None:
        """Check once for a requested change; publish the changes that are applied."""
        for way, file in self._files.items():
            if (loaded := file.poll()) is not None:
                self._pending.append((way, loaded))
        with suppress(OSError):  # such as a full disk: the next check tries again
            self._publish_all()

    def _publish_all(self) -> None:
        while self._applied:
            self._publish(*self._applied[0])
            self._applied.popleft()
        if time.monotonic() - self._released_at >= RELEASED_PERIOD:
            self._released_at = time.monotonic()
            for way in self._links:
                if released := self._relay.released(way):
                    publish(self._folder / f"{way}{RELEASED_SUFFIX}", json.dumps(released))

    def _follow(self) -> None:
        while True:
            self.look()
            time.sleep(PROFILE_PERIOD / 2 if self._pending else PROFILE_PERIOD)

    def _publish(self, way: str, loaded: Loaded, since_ns: int) -> None:
        changes = self._changes[way] + 1
        values: dict[str, Any] = loaded.values
        requested = summary(loaded.direction)
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
            asked=requested,
            # The time line of an initial profile starts with the first datagram.
            origin_ns=since_ns if changes and loaded.change.restart else None,
        )
        self._asked(way, requested["delay"] or 0.0)
        publish(self._folder / f"{way}.json", to_text(state))
        self._changes[way] = changes


def _log(line: str) -> None:
    print_line(f"cloudrc relay: {line}", sys.stderr)
