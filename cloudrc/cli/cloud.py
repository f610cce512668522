"""`cloudrc cloud`: the remote controller's process; ends when its mission is over."""

from __future__ import annotations

import argparse

from cloudrc.cli.ends import EPILOG as EPILOG
from cloudrc.cli.ends import end_arguments, listening, open_recorder, warn_if_exposed


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)


def execute(options: argparse.Namespace) -> int:
    """Control."""
    import os
    import time

    from cloudrc import assembly
    from cloudrc.cloud.endpoint import CloudIdentity
    from cloudrc.config.load import load_experiment
    from cloudrc.drivers.machine import clock_id
    from cloudrc.drivers.process import run_end
    from cloudrc.drivers.realtime import Peer

    warn_if_exposed(options.listen)
    experiment, clock = load_experiment(str(options.config)), clock_id()
    recorder = open_recorder(options.record, "cloud", clock)
    with listening("--listen", options.listen):
        peer = Peer.bind(options.listen, options.peer)
    identity = CloudIdentity(clock, os.urandom(16))
    cloud = assembly.build_cloud(experiment, identity, time.monotonic_ns)
    run_end(cloud, peer, recorder, end="cloud", over=lambda: cloud.mission_over)
    return 0
