"""Run `cloudrc link run`: the sidecar with its clock, sockets, programs and threads.

/link.json on the metrics port shows the state of the shaper. To build an answer, the process starts
tc and ip. Therefore an answer is cached for one second.
"""

from __future__ import annotations

import argparse
import random
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from cloudrc.cli.output import print_line
from cloudrc.cli.runtime import (
    ipv4_addresses,
    open_exporter,
    process_arguments,
    read_address,
    warn_if_exposed,
)

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.drivers.iproute2 import Programs
    from cloudrc.link.follow import Load, Profiles
    from cloudrc.link.sidecar import Machine, Near, Sidecar

EPILOG = ""
STATUS_PERIOD = 1.0
"""How long an answer of /link.json is cached [s]."""
EMPTY_STATUS = "{}\n"
"""Answer of /link.json before the shaper works."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the action's arguments."""
    process_arguments(parser)
    add = parser.add_argument
    file = "profile of the link; watched for changes"
    add("--profile", type=Path, required=True, metavar="FILE", help=file)
    way = "direction of the profile to shape"
    add("--direction", choices=("uplink", "downlink"), required=True, help=way)
    mode = "auto (default) takes netem if permissions and kernel allow it, else relay"
    add("--mode", choices=("auto", "netem", "relay"), default="auto", help=mode)
    peer = "address of the other tunnel end"
    add("--peer", type=read_address, required=True, metavar="HOST:PORT", help=peer)
    end = (
        "address from which this pod's tunnel end sends; the relay takes datagrams from no"
        " other (default: from any that reaches --listen)"
    )
    add("--end", type=read_address, metavar="HOST:PORT", help=end)
    listen, here = "where the relay receives datagrams (default: 127.0.0.1:7401)", "127.0.0.1"
    add("--listen", type=read_address, default=(here, 7401), metavar="HOST:PORT", help=listen)
    route = "write the address to which this pod's tunnel end must send, once ready"
    add("--route", type=Path, required=True, metavar="FILE", help=route)


def execute(options: argparse.Namespace) -> int:
    """Shape one direction of the link until SIGTERM."""
    from cloudrc.drivers.process import StopSignal

    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.drivers.iproute2 import Programs
    from cloudrc.link.follow import HANDED_FILE, Profiles
    from cloudrc.link.netem import write_tables
    from cloudrc.link.sidecar import Settings, Sidecar
    from cloudrc.link.state import STATE_FILE

    warn_if_exposed(options.listen)
    exporter = open_exporter(options, "link")
    metrics = Metrics(exporter, options.direction, options.mode) if exporter else None
    document, state = (options.route.with_name(name) for name in (HANDED_FILE, STATE_FILE))
    profiles = Profiles(options.profile, document, make_profile_loader(options.direction), log)
    profile = profiles.first()
    settings = Settings(options.mode, options.direction, options.route, state)
    with TemporaryDirectory(prefix="tc-", dir=options.route.parent) as tables:
        write_tables(Path(tables))
        programs = Programs(tables)
        sidecar = Sidecar(settings, _machine(options, programs, Path(tables)), profile, metrics)
        if exporter:
            exporter.tells(LinkStatusSource(sidecar).text)
        try:
            _start_watching(sidecar, profiles, options, metrics)
            sidecar.run(stop)
        finally:
            programs.close()
    return 0


def log(line: str) -> None:
    """Write one line to the log."""
    print_line(f"cloudrc link: {line}", sys.stderr)


def make_profile_loader(direction: str) -> Load:
    """Make the function that reads one direction of a profile file."""
    from cloudrc.assembly import link_profile
    from cloudrc.config.load import load_profile
    from cloudrc.link.follow import Loaded

    def load(path: Path) -> Loaded:
        profile = load_profile(path.absolute())  # absolute: never the name of a shipped profile
        values = profile.model_dump(mode="json", exclude_defaults=True)
        return Loaded(link_profile(getattr(profile, direction)), values)

    return load


def _machine(options: argparse.Namespace, programs: Programs, tables: Path) -> Machine:
    from cloudrc.config.load import read_experiment
    from cloudrc.link.model import LinkDirection
    from cloudrc.link.netem import Netem, may_shape
    from cloudrc.link.profile import DirectionProfile
    from cloudrc.link.relay import RelayShaper, ask_for_fifo, settle
    from cloudrc.link.sidecar import Machine
    from cloudrc.tunnel.codec import peek

    seed, clock, wait = read_experiment(str(options.config)).seed, time.monotonic_ns, time.sleep

    def relay(profile: DirectionProfile, origin_ns: int) -> RelayShaper:
        settle()
        if not ask_for_fifo():  # most pods lack the permission and do not need it
            log("the relay runs under SCHED_FIFO")
        direction = LinkDirection(profile, seed, options.direction == "uplink", origin_ns)
        return RelayShaper(options.listen, direction, peek, options.end)

    def netem(profile: DirectionProfile, origin_ns: int) -> Netem:
        return Netem(
            *(programs, profile),
            origin_ns=origin_ns,
            clock=clock,
            wait=wait,
            tables=tables,
            log=log,
        )

    return Machine(
        relay=relay,
        netem=netem,
        may_shape=may_shape(Path("/proc/self/status").read_text(encoding="ascii")),
        clock=clock,
        today=lambda: datetime.now(UTC).isoformat(timespec="seconds"),
        wait=wait,
        log=log,
    )


def _start_watching(
    sidecar: Sidecar, profiles: Profiles, options: argparse.Namespace, metrics: Metrics | None
) -> None:
    """Start the threads that watch the profile and resolve the peer's name."""
    from cloudrc.link.follow import PEER_PAUSE, PROFILE_PERIOD, PeerName

    name = PeerName(options.peer, ipv4_addresses, log)

    def poll_profile() -> None:
        sidecar.profile = profiles.poll() or sidecar.profile

    def resolve_peer() -> None:
        sidecar.peer = name.poll() or sidecar.peer
        if metrics is not None:
            metrics.unresolved(name.failures)

    def repeat(action: Callable[[], None], shortest: float, longest: float) -> None:
        while True:
            action()
            time.sleep(random.uniform(shortest, longest))

    steady = (PROFILE_PERIOD, PROFILE_PERIOD)
    for action, pause in ((poll_profile, steady), (resolve_peer, PEER_PAUSE)):
        threading.Thread(target=repeat, args=(action, *pause), daemon=True).start()


class Metrics:
    """Export the metrics of a sidecar; implement `Watcher`."""

    def __init__(self, exporter: Exporter, direction: str, mode: str) -> None:
        self._exporter, self._direction, self._mode = exporter, direction, mode
        self.unresolved = exporter.unresolved

    def shapes(self, shaper: str) -> None:
        """Export which shaper is in use, and report ready."""
        self._exporter.shaped(shaper, self._direction, self._mode)
        self._exporter.ready(True)

    def asked(self, delay: float) -> None:
        """Export the mean `delay` [s] that the profile requests."""
        self._exporter.asked(self._direction, delay)

    def counted(self, stamp_ns: int, counts: dict[str, int]) -> None:
        """Export the counters of datagrams."""
        from cloudrc.records import Counted

        self._exporter.see([Counted(stamp_ns, "link", name, n) for name, n in counts.items()])


def inspect_network(host: str) -> Near | None:
    """Find the netem qdiscs of this thread's network namespace and its route to an IPv4 address."""
    from cloudrc.drivers.iproute2 import Programs
    from cloudrc.link.sidecar import look_near

    programs = Programs()
    try:
        return look_near(programs, host)
    finally:
        programs.close()


class LinkStatusSource:
    """Describe the state of a sidecar as JSON; any thread may call the methods."""

    def __init__(
        self,
        sidecar: Sidecar,
        look: Callable[[str], Near | None] = inspect_network,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._sidecar, self._look, self._clock = sidecar, look, clock
        self._lock, self._text, self._valid_until = threading.Lock(), EMPTY_STATUS, -STATUS_PERIOD

    def text(self) -> str:
        """Return the state as JSON; return the previous answer if tc or ip hangs."""
        from cloudrc.link.sidecar import write_told

        if not self._lock.acquire(timeout=STATUS_PERIOD):
            return self._text
        try:
            if self._clock() >= self._valid_until:
                status, peer = self._sidecar.told(), self._sidecar.peer
                self._text = EMPTY_STATUS
                if status is not None and peer is not None:
                    self._text = write_told(replace(status, near=self._look(peer[0])))
                self._valid_until = self._clock() + STATUS_PERIOD
            return self._text
        finally:
            self._lock.release()
