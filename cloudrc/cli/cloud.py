"""`cloudrc cloud`: the remote controller's process; ends when its mission is over."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.runtime import end_arguments, open_end, suite

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
    from cloudrc.drivers.process import StopSignal

    stop = StopSignal()
    import os
    import time

    from cloudrc import assembly
    from cloudrc.cloud.endpoint import CloudIdentity
    from cloudrc.drivers.teleop import LastWord
    from cloudrc.messages import GuardState

    opened = open_end(options, "cloud")
    identity = CloudIdentity(opened.clock, os.urandom(16), opened.keys.ring, suite())
    teleop = _join(options.teleop) if options.teleop else None
    cloud = assembly.build_cloud(opened.experiment, identity, time.monotonic_ns, teleop)

    def flies() -> bool:
        return cloud.guard is GuardState.TRACK

    ends = LastWord(stop, flies) if teleop else stop
    opened.fly(cloud, ends, flies, over=lambda: cloud.mission_over)
    return 0


def _join(folder: Path) -> Operator:
    """Join the process of teleop, which may come and go."""
    import time

    from cloudrc.drivers.teleop import RemoteTeleop, UnixPeer
    from cloudrc.teleop import wire

    peer = UnixPeer(folder / "cloud.sock", folder / "teleop.sock")
    return RemoteTeleop(peer, wire.encode, wire.decode, time.monotonic_ns())
