"""`cloudrc link run`: the container that shapes what one pod sends to the other."""

from __future__ import annotations

import argparse
from pathlib import Path

from cloudrc.cli.ends import address, process_arguments
from cloudrc.errors import BadInputError

EPILOG = """\
The chart starts 'cloudrc link run' in each pod, where it shapes what the pod
sends: the uplink in world's, the downlink in cloud's. It follows its profile's
file and its peer's name, and ends on SIGTERM."""
MODES = ("auto", "netem", "relay")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions")
    text = "shape one direction until told to stop"
    run = actions.add_parser("run", help=text, description=text[0].upper() + text[1:] + ".")
    process_arguments(run)
    run.add_argument("--profile", type=Path, required=True, metavar="FILE", help="is followed")
    run.add_argument(
        "--direction",
        choices=("uplink", "downlink"),
        required=True,
        help="which of the profile's two to shape",
    )
    run.add_argument(
        "--mode",
        choices=MODES,
        default="auto",
        help="auto (default) takes netem where this container may and the kernel can",
    )
    run.add_argument(
        "--peer", type=address, required=True, metavar="HOST:PORT", help="the other tunnel end"
    )
    run.add_argument(
        "--listen",
        type=address,
        default=("127.0.0.1", 7401),
        metavar="HOST:PORT",
        help="where the relay takes in (default: 127.0.0.1:7401)",
    )
    run.add_argument(
        "--route",
        type=Path,
        required=True,
        metavar="FILE",
        help="written when ready: where this pod's tunnel end sends to",
    )


def execute(options: argparse.Namespace) -> int:
    """Do what the action says."""
    if options.action is None:
        raise BadInputError("an action is missing: run; see 'cloudrc link --help'")
    from cloudrc.cli.link_run import run

    return run(options)
