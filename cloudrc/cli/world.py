"""`cloudrc world`: run the robot's process until it is stopped."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from cloudrc.cli.output import ignore_closed_pipe
from cloudrc.cli.parser import input_file
from cloudrc.cli.runtime import end_arguments, fast_suite, open_end


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)
    parser.add_argument(
        "--epochs",
        type=input_file,
        metavar="FILE",
        help="file that keeps the session number across restarts (default: none)",
    )


def execute(options: argparse.Namespace) -> int:
    """Run world."""
    from cloudrc.drivers.process import StopSignal

    stop = StopSignal()
    import os
    import time

    from cloudrc import assembly
    from cloudrc.world.endpoint import WorldIdentity

    runtime = open_end(options, "world")
    identity = WorldIdentity(
        runtime.clock,
        os.urandom(16),
        ring=runtime.keys.ring,
        suite=fast_suite(),
        next_epoch=_epochs(options.epochs) if options.epochs else None,
    )
    world = assembly.build_world(runtime.experiment, identity, time.monotonic_ns)
    runtime.fly(world, stop, lambda: world.robot.guard.armed, slip_ns=lambda: world.slip_ns)
    return 0


def _epochs(path: Path) -> Callable[[], int | None]:
    """Give the function that takes epochs from a file; warn if the file cannot be written."""
    from cloudrc.drivers.epochs import EpochFile

    def warn(problem: str) -> None:
        with ignore_closed_pipe(sys.stderr):
            print(f"cloudrc: warning: {problem}", file=sys.stderr, flush=True)

    return EpochFile(path, warn).take
