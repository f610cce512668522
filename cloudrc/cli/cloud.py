"""`cloudrc cloud`: run the remote controller's process until its mission is over."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.runtime import end_arguments, open_end

if TYPE_CHECKING:
    from cloudrc.cloud.operator import Operator


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)
    parser.add_argument(
        "--teleop",
        type=Path,
        metavar="DIR",
        help="take missions from 'cloudrc teleop --socket DIR' (default: fly the experiment's)",
    )


def execute(options: argparse.Namespace) -> int:
    """Run cloud."""
    from cloudrc.drivers.process import StopSignal

    stop = StopSignal()
    import os
    import time

    from cloudrc import assembly
    from cloudrc.cloud.endpoint import CloudIdentity
    from cloudrc.drivers.teleop import LastWord
    from cloudrc.messages import GuardState

    runtime = open_end(options, "cloud")
    identity = CloudIdentity(runtime.clock, os.urandom(16), runtime.keys.ring)
    teleop = _connect_teleop(options.teleop) if options.teleop else None
    cloud = assembly.build_cloud(runtime.experiment, identity, time.monotonic_ns, teleop)

    def flies() -> bool:
        return cloud.guard is GuardState.TRACK

    should_stop = LastWord(stop, flies) if teleop else stop
    runtime.fly(cloud, should_stop, flies, over=lambda: cloud.mission_over)
    return 0


def _connect_teleop(folder: Path) -> Operator:
    """Open the connection to the teleop process, which may restart at any time."""
    import time

    from cloudrc.drivers.teleop import RemoteTeleop, UnixPeer
    from cloudrc.teleop import wire

    peer = UnixPeer(folder / "cloud.sock", folder / "teleop.sock")
    return RemoteTeleop(peer, wire.encode, wire.decode, time.monotonic_ns())
