"""`cloudrc world`: the robot's process; flies until it is told to stop."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from cloudrc.cli.output import unread_is_fine
from cloudrc.cli.parser import read_from
from cloudrc.cli.runtime import end_arguments, open_end, suite


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)
    parser.add_argument(
        "--epochs",
        type=read_from,
        metavar="FILE",
        help="keeps the highest number of a session through a restart (default: not kept)",
    )


def execute(options: argparse.Namespace) -> int:
    """Fly."""
    from cloudrc.drivers.process import StopSignal

    stop = StopSignal()
    import os
    import time

    from cloudrc import assembly
    from cloudrc.world.endpoint import WorldIdentity

    opened = open_end(options, "world")
    identity = WorldIdentity(
        opened.clock,
        os.urandom(16),
        ring=opened.keys.ring,
        suite=suite(),
        next_epoch=_epochs(options.epochs) if options.epochs else None,
    )
    world = assembly.build_world(opened.experiment, identity, time.monotonic_ns)
    opened.fly(world, stop, lambda: world.robot.guard.armed, slip_ns=lambda: world.slip_ns)
    return 0


def _epochs(path: Path) -> Callable[[], int | None]:
    """Take epochs from a file; say so if they cannot be kept."""
    from cloudrc.drivers.epochs import EpochFile

    def say(trouble: str) -> None:
        with unread_is_fine(sys.stderr):
            print(f"cloudrc: warning: {trouble}", file=sys.stderr, flush=True)

    return EpochFile(path, say).take
