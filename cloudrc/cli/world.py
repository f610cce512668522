"""`cloudrc world`: the robot's process; flies until it is told to stop."""

from __future__ import annotations

import argparse

from cloudrc.cli.ends import EPILOG as EPILOG
from cloudrc.cli.ends import end_arguments, listening, open_recorder, warn_if_exposed


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)


def execute(options: argparse.Namespace) -> int:
    """Fly."""
    import os
    import time

    from cloudrc import assembly
    from cloudrc.config.load import load_experiment
    from cloudrc.drivers.machine import clock_id
    from cloudrc.drivers.process import run_end
    from cloudrc.drivers.realtime import Peer
    from cloudrc.world.endpoint import WorldIdentity

    warn_if_exposed(options.listen)
    experiment, clock = load_experiment(str(options.config)), clock_id()
    recorder = open_recorder(options.record, "world", clock)
    with listening("--listen", options.listen):
        peer = Peer.bind(options.listen, options.peer)
    identity = WorldIdentity(clock, os.urandom(16))
    world = assembly.build_world(experiment, identity, time.monotonic_ns)
    run_end(world, peer, recorder, end="world", slip_ns=lambda: world.slip_ns)
    return 0
