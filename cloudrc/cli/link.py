"""Parse `cloudrc link ACTION` and run the action; each action is in `cli/link_<name>.py`."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

from cloudrc.cli.processes import process_arguments, read_address
from cloudrc.errors import BadInputError

EPILOG = """\
examples:
  cloudrc link show satellite
  cloudrc link record runs/latest -o trace.csv
  cloudrc link verify paper-p3
  cloudrc link set downlink.delay_ms=120

All delays are one way. The chart starts 'cloudrc link run' in each pod. It
shapes what the pod sends: the uplink in the world pod, the downlink in the
cloud pod. It watches its profile file and the address of its peer, and ends on
SIGTERM."""
ACTIONS = {
    "show": "draw a profile and print its delay and loss statistics",
    "record": "turn measured delays into a trace that a profile can replay",
    "verify": "check by measurement that a link does what its profile says",
    "set": "change the link during a flight",
    "run": "shape one direction of the link until SIGTERM",
}
"""Help line of each action, in the order of the help."""
DEBUG = "show the traceback of an error"
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
        action.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=DEBUG)
        (module.arguments if module else _run_arguments)(action)
        action.set_defaults(act=module.execute if module else _run)


def execute(options: argparse.Namespace) -> int:
    """Run the chosen action."""
    if options.action is None:
        raise BadInputError("an action is missing; see 'cloudrc link --help'")
    code: int = options.act(options)
    return code


def _run(options: argparse.Namespace) -> int:
    from cloudrc.cli.link_run import run

    return run(options)


def _run_arguments(parser: argparse.ArgumentParser) -> None:
    process_arguments(parser)
    parser.add_argument(
        "--profile",
        type=Path,
        required=True,
        metavar="FILE",
        help="profile of the link; watched for changes",
    )
    parser.add_argument(
        "--direction",
        choices=("uplink", "downlink"),
        required=True,
        help="direction of the profile to shape",
    )
    parser.add_argument(
        "--mode",
        choices=MODES,
        default="auto",
        help="auto (default) takes netem if permissions and kernel allow it, else relay",
    )
    parser.add_argument(
        "--peer",
        type=read_address,
        required=True,
        metavar="HOST:PORT",
        help="address of the other tunnel end",
    )
    parser.add_argument(
        "--end",
        type=read_address,
        metavar="HOST:PORT",
        help="address from which this pod's tunnel end sends; the relay takes datagrams from no"
        " other (default: from any that reaches --listen)",
    )
    parser.add_argument(
        "--listen",
        type=read_address,
        default=("127.0.0.1", 7401),
        metavar="HOST:PORT",
        help="where the relay receives datagrams (default: 127.0.0.1:7401)",
    )
    parser.add_argument(
        "--route",
        type=Path,
        required=True,
        metavar="FILE",
        help="write the address to which this pod's tunnel end must send, once ready",
    )
