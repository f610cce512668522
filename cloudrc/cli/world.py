"""`cloudrc world`: the robot's process; flies until it is told to stop."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

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


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)
    parser.add_argument(
        "--epochs",
        type=Path,
        metavar="FILE",
        help="keeps the number of the last session through a restart (default: not kept)",
    )


def execute(options: argparse.Namespace) -> int:
    """Fly."""
    from cloudrc.drivers.process import StopSignal, run_end

    stop = StopSignal()
    import os
    import time

    from cloudrc import assembly
    from cloudrc.config.load import load_experiment
    from cloudrc.drivers.machine import clock_id
    from cloudrc.world.endpoint import WorldIdentity

    exporter = open_exporter(options, "world")
    experiment, clock = load_experiment(str(options.config)), clock_id()
    recorder = open_recorder(options, "world", clock)
    keys = open_keys(options)
    peer = open_peer(options)
    identity = WorldIdentity(
        clock,
        os.urandom(16),
        ring=keys.ring,
        suite=suite(),
        next_epoch=_epochs(options.epochs) if options.epochs else None,
    )
    world = assembly.build_world(experiment, identity, time.monotonic_ns)
    run_end(
        world,
        peer,
        recorder,
        end="world",
        stop=stop,
        slip_ns=lambda: world.slip_ns,
        exporter=exporter,
        watched=options.feed,
        choose=chosen(options, lambda: world.robot.guard.armed),
        link=link_state(options),
        check=standing_check(options, experiment, uplink=False),
        keys=keys,
    )
    return 0


def _epochs(path: Path) -> Callable[[], int]:
    """Take epochs from a file; say so if they cannot be kept."""
    from cloudrc.drivers.epochs import EpochFile

    epochs = EpochFile(path)
    if epochs.trouble:
        print(f"cloudrc: warning: {epochs.trouble}", file=sys.stderr)
    return epochs.take
