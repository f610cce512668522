"""`cloudrc relay`: the emulated link's process, between world and cloud."""

from __future__ import annotations

import argparse
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.ends import EPILOG as EPILOG
from cloudrc.cli.ends import (
    address,
    listening,
    open_exporter,
    process_arguments,
    resolved,
    warn_if_exposed,
)

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
    world, cloud = resolved("--world", options.world), resolved("--cloud", options.cloud)
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
        from cloudrc.cli.relay_control import controlled

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
