"""Run `cloudrc link run`: the process that shapes one direction of the link of a pod or local run.

GET /link.json on the metrics port returns the state of the shaper and the netem qdiscs of this pod
or machine. The process calls tc and ip for this answer, at most once a second.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from cloudrc.cli.output import print_line
from cloudrc.cli.processes import (
    ipv4_addresses,
    listening,
    open_exporter,
    process_arguments,
    read_address,
)
from cloudrc.drivers.process import Feed, StopSignal
from cloudrc.drivers.programs import Programs, run_tool
from cloudrc.records import Counted

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.follow import Load
    from cloudrc.link.netem import Netem
    from cloudrc.link.sidecar import Machine, Sidecar
    from cloudrc.link.state import LinkState

EPILOG = ""
RELEASED_PERIOD = 1.0  # time between two updates of the file with the lateness of datagrams [s]


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
        "address from which the own tunnel end sends; the relay takes datagrams from no"
        " other (default: from any that reaches --listen)"
    )
    add("--end", type=read_address, metavar="HOST:PORT", help=end)
    listen, here = "where the relay receives datagrams (default: 127.0.0.1:7401)", "127.0.0.1"
    add("--listen", type=read_address, default=(here, 7401), metavar="HOST:PORT", help=listen)
    route = "write the address to which the own tunnel end must send, once ready"
    add("--route", type=Path, required=True, metavar="FILE", help=route)
    origin = "start of the time line, monotonic clock [ns] (default: when the link comes up)"
    add("--origin", type=int, default=0, metavar="NS", help=origin)


def execute(options: argparse.Namespace) -> int:
    """Shape one direction of the link until SIGTERM."""
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.config.load import read_experiment
    from cloudrc.link.follow import HANDED_FILE, PEER_PAUSE, PROFILE_PERIOD, PeerName, Profiles
    from cloudrc.link.sidecar import Sidecar

    feed = Feed.on_stdout(watched=options.feed)
    experiment = read_experiment(str(options.config))
    exporter = open_exporter(options, "link", experiment)
    document = options.route.with_name(HANDED_FILE)
    profiles = Profiles(options.profile, document, make_profile_loader(options.direction), log)
    profile, peer = profiles.first(), PeerName(options.peer, ipv4_addresses, log)
    with TemporaryDirectory(prefix="tc-", dir=options.route.parent) as tables:
        programs = Programs(tables)
        sidecar = Sidecar(
            _machine(options, experiment.seed, programs, Path(tables)),
            profile,
            mode=options.mode,
            direction=options.direction,
            route=options.route,
            origin_ns=options.origin,
            tell=partial(export_state, exporter),
            count=partial(export_counts, exporter),
        )

        def poll_profile() -> None:
            sidecar.profile = profiles.poll() or sidecar.profile

        def resolve_peer() -> None:
            sidecar.peer = peer.poll() or sidecar.peer
            if exporter:
                exporter.unresolved(peer.failures)

        if exporter:
            exporter.link.tell = lambda: status_page(sidecar)
        try:
            _repeat(poll_profile, PROFILE_PERIOD, PROFILE_PERIOD)
            _repeat(resolve_peer, *PEER_PAUSE)
            _repeat(sidecar.publish_released, RELEASED_PERIOD, RELEASED_PERIOD)
            alive = feed.alive_while(stop)
            sidecar.run(lambda: alive() if sidecar.state else stop())
        finally:
            programs.close()
    return 0


def log(line: str) -> None:
    """Write a line to stderr, the log of the process."""
    print_line(f"cloudrc link: {line}", sys.stderr)


def make_profile_loader(direction: str) -> Load:
    """Return a function that reads one direction of a link profile from a file."""
    from cloudrc.config.load import load_profile
    from cloudrc.link.follow import Loaded
    from cloudrc.link.traces import link_profile

    def load(path: Path) -> Loaded:
        profile = load_profile(path.absolute())  # absolute: not a shipped name
        values = profile.model_dump(mode="json", exclude_defaults=True)
        return Loaded(link_profile(getattr(profile, direction)), values)

    return load


def _machine(options: argparse.Namespace, seed: int, programs: Programs, tables: Path) -> Machine:
    from cloudrc.link.model import LinkDirection
    from cloudrc.link.profile import DirectionProfile
    from cloudrc.link.relay import Relay, ask_for_fifo, settle
    from cloudrc.link.sidecar import Machine
    from cloudrc.tunnel.codec import peek

    clock, wait = time.monotonic_ns, time.sleep

    def relay(profile: DirectionProfile, origin_ns: int) -> Relay:
        settle()
        if ask_for_fifo():  # refused in most pods, which do not need it
            log("the relay runs under SCHED_FIFO")
        direction = LinkDirection(profile, seed, options.direction == "uplink", origin_ns)
        with listening("--listen", options.listen):
            return Relay(options.listen, direction, peek, options.end)

    def netem(profile: DirectionProfile, origin_ns: int) -> Netem:
        from cloudrc.link.netem import Netem

        return Netem(
            programs, profile, origin_ns=origin_ns, clock=clock, wait=wait, tables=tables, log=log
        )

    return Machine(relay, netem, clock, wait, log)


def _repeat(action: Callable[[], None], shortest: float, longest: float) -> None:
    def work() -> None:
        while True:
            action()
            time.sleep(random.uniform(shortest, longest))

    threading.Thread(target=work, daemon=True).start()


def export_state(exporter: Exporter | None, state: LinkState) -> None:
    """Export the state of one direction as metrics."""
    if exporter:
        delay = state.asked["delay"] or 0.0
        exporter.link.shaped(state.shaper, state.direction, state.mode, delay)
        exporter.ready(True)


def export_counts(exporter: Exporter | None, counts: dict[str, int]) -> None:
    """Export the counters of a shaper as metrics; `counts`: name of the counter -> value."""
    if exporter:
        exporter.see([Counted(0, "link", name, number) for name, number in counts.items()])


def status_page(sidecar: Sidecar) -> str:
    """Return the state of a sidecar as JSON. Any thread may call this function."""
    peer, state = sidecar.peer, sidecar.state
    netems = _find_netems(peer[0], int(time.monotonic())) if peer else {}
    return json.dumps((asdict(state) if state else {}) | netems) + "\n"


@lru_cache(maxsize=1)
def _find_netems(host: str, second: int) -> dict[str, Any]:
    """Find the netem qdiscs of this pod.

    `second` is the present time [s]. It is an argument so that the cache searches once per second.
    """
    from cloudrc.link.netem import find_netems

    return find_netems(run_tool, host)
