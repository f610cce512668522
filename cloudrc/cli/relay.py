"""`cloudrc relay`: the emulated link's process, between world and cloud."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.cli.ends import EPILOG as EPILOG
from cloudrc.cli.ends import (
    address,
    listening,
    open_exporter,
    process_arguments,
    warn_if_exposed,
)

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.relay import Relay

COUNT_PERIOD_NS = 1_000_000_000

ADDRESSES = {
    "--world-side": "where to receive from world",
    "--cloud-side": "where to receive from cloud",
    "--world": "where world receives",
    "--cloud": "where cloud receives",
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    process_arguments(parser)
    for flag, text in ADDRESSES.items():
        parser.add_argument(flag, type=address, required=True, metavar="HOST:PORT", help=text)


def execute(options: argparse.Namespace) -> int:
    """Forward."""
    from cloudrc import assembly
    from cloudrc.config.load import load_experiment
    from cloudrc.drivers.feed import Feed
    from cloudrc.drivers.process import StopSignal
    from cloudrc.drivers.realtime import bind
    from cloudrc.link.relay import Relay
    from cloudrc.tunnel.codec import peek

    stop, exporter = StopSignal(), open_exporter(options, "link")
    experiment = load_experiment(str(options.config))
    uplink, downlink = assembly.build_links(experiment)
    sides = []
    for flag, listen in (
        ("--world-side", options.world_side),
        ("--cloud-side", options.cloud_side),
    ):
        warn_if_exposed(listen)
        with listening(flag, listen):
            sides.append(bind(listen))
    relay = Relay(
        uplink,
        downlink,
        peek,
        world_side=sides[0],
        cloud_side=sides[1],
        world_peer=options.world,
        cloud_peer=options.cloud,
    )
    Feed.on_stdout().ready()
    if exporter is None:
        relay.run(stop)
    else:
        for way, asked in (("uplink", experiment.uplink), ("downlink", experiment.downlink)):
            exporter.shaped("relay", way, "relay")
            exporter.asked(way, asked.delay_ms * 1e-3)
        exporter.ready(True)
        relay.run(_counting(stop, relay, exporter))
    counts = ", ".join(f"{name} {count:g}" for name, count in relay.counts().items())
    print(f"cloudrc relay: {counts}", file=sys.stderr)
    return 0


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
            outcomes = relay.outcomes().items()
            exporter.see([Counted(now_ns, "link", name, total) for name, total in outcomes])
        return stop()

    return ask
