"""`cloudrc world`: run the robot's process until it is stopped."""

from __future__ import annotations

import argparse
import sys

from cloudrc.cli.runtime import end_arguments, open_end


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)
    parser.add_argument("--epochs", metavar="FILE", help="ignored: cloud keeps the session number")


def execute(options: argparse.Namespace) -> int:
    """Run world."""
    from cloudrc.drivers.process import StopSignal

    stop = StopSignal()
    import os
    import time

    from cloudrc import assembly
    from cloudrc.world.endpoint import WorldIdentity

    if options.epochs:
        print("cloudrc: --epochs is ignored: cloud keeps the session number", file=sys.stderr)
    runtime = open_end(options, "world")
    identity = WorldIdentity(runtime.clock, os.urandom(16), runtime.keys.ring)
    world = assembly.build_world(runtime.experiment, identity, time.monotonic_ns)
    runtime.fly(world, stop, lambda: world.robot.guard.armed, slip_ns=lambda: world.slip_ns)
    return 0
