"""`cloudrc cloud`: the remote controller's process; ends when its mission is over."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.ends import EPILOG as EPILOG
from cloudrc.cli.ends import (
    chosen,
    end_arguments,
    link_state,
    open_exporter,
    open_keys,
    open_peer,
    open_recorder,
    standing_check,
    suite,
)

if TYPE_CHECKING:
    from cloudrc.cloud.endpoint import Operator


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)
    parser.add_argument(
        "--teleop",
        type=Path,
        metavar="DIR",
        help="missions come from 'cloudrc teleop --socket DIR' (default: the experiment's, here)",
    )


def execute(options: argparse.Namespace) -> int:
    """Control."""
    from cloudrc.drivers.process import StopSignal, run_end

    stop = StopSignal()
    import os
    import time

    from cloudrc import assembly
    from cloudrc.cloud.endpoint import CloudIdentity
    from cloudrc.config.load import load_experiment
    from cloudrc.drivers.machine import clock_id
    from cloudrc.messages import GuardState

    exporter = open_exporter(options, "cloud")
    experiment, clock = load_experiment(str(options.config)), clock_id()
    recorder = open_recorder(options, "cloud", clock)
    keys = open_keys(options)
    peer = open_peer(options)
    identity = CloudIdentity(clock, os.urandom(16), keys.ring, suite())
    teleop = _join(options.teleop) if options.teleop else None
    cloud = assembly.build_cloud(experiment, identity, time.monotonic_ns, teleop)
    run_end(
        cloud,
        peer,
        recorder,
        end="cloud",
        stop=stop,
        over=lambda: cloud.mission_over,
        exporter=exporter,
        watched=options.feed,
        choose=chosen(options, lambda: cloud.guard is GuardState.TRACK),
        link=link_state(options),
        check=standing_check(options, experiment, uplink=True),
        keys=keys,
    )
    return 0


def _join(folder: Path) -> Operator:
    """Join the process of teleop, which may come and go."""
    import time

    from cloudrc.cloud.teleop import wire
    from cloudrc.drivers.teleop import RemoteTeleop
    from cloudrc.drivers.unix import UnixPeer

    peer = UnixPeer(folder / "cloud.sock", folder / "teleop.sock")
    return RemoteTeleop(peer, wire.encode, wire.decode, time.monotonic_ns())
