"""`cloudrc relay`: the emulated link's process, between world and cloud."""

from __future__ import annotations

import argparse
import sys

from cloudrc.cli.ends import EPILOG as EPILOG
from cloudrc.cli.ends import address, listening, process_arguments, warn_if_exposed

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

    uplink, downlink = assembly.build_links(load_experiment(str(options.config)))
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
    relay.run(StopSignal())
    counts = ", ".join(f"{name} {count:g}" for name, count in relay.counts().items())
    print(f"cloudrc relay: {counts}", file=sys.stderr)
    return 0
