"""`cloudrc world`: the robot's process; flies until it is told to stop."""

from __future__ import annotations

import argparse

from cloudrc.cli.ends import EPILOG as EPILOG
from cloudrc.cli.ends import chosen, end_arguments, open_exporter, open_peer, open_recorder


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)


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
    peer = open_peer(options)
    identity = WorldIdentity(clock, os.urandom(16))
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
    )
    return 0
