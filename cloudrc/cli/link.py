"""`cloudrc link ACTION`: the table of actions; the file of an action is `cli/link_<name>.py`."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

from cloudrc.cli.runtime import address, process_arguments
from cloudrc.errors import BadInputError

EPILOG = """\
examples:
  cloudrc link show satellite
  cloudrc link record runs/latest -o trace.csv
  cloudrc link verify paper-p3
  cloudrc link set downlink.delay_ms=120

All delays are one way. The chart starts 'cloudrc link run' in each pod, where
it shapes what the pod sends: the uplink in world's, the downlink in cloud's. It
follows its profile's file and its peer's name, and ends on SIGTERM."""
ACTIONS = {
    "show": "draw a profile, and print its numbers",
    "record": "turn measured delays into a trace that a profile can replay",
    "verify": "prove that a link is what was asked for",
    "set": "change the link of a flight under way",
    "run": "shape one direction until told to stop",
}
"""What there is, in the order of the help."""
MODES = ("auto", "netem", "relay")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions")
    for name, line in ACTIONS.items():
        module = None if name == "run" else importlib.import_module(f"cloudrc.cli.link_{name}")
        action = actions.add_parser(
            name,
            help=line,
            description=line[0].upper() + line[1:] + ".",
            epilog=getattr(module, "EPILOG", None),
            formatter_class=parser.formatter_class,
            allow_abbrev=False,
        )
        action.add_argument("--debug", action="store_true", default=argparse.SUPPRESS)
        (module.arguments if module else _run_arguments)(action)
        action.set_defaults(act=module.execute if module else _run)


def execute(options: argparse.Namespace) -> int:
    """Do what the action says."""
    if options.action is None:
        raise BadInputError("an action is missing; see 'cloudrc link --help'")
    code: int = options.act(options)
    return code


def _run(options: argparse.Namespace) -> int:
    from cloudrc.cli.link_run import run

    return run(options)


def _run_arguments(run: argparse.ArgumentParser) -> None:
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
