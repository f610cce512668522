# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link run`: the process that shapes one direction of a link."""

from __future__ import annotations

from pathlib import Path

from cloudrc.doors.cli.parser import Options, Parser, settings_from, whole_number
from cloudrc.doors.cli.processes import process_arguments, read_address
from cloudrc.flight.pod.process import StopSignal

EPILOG = ""


def arguments(parser: Parser) -> None:
    """Declare the action's arguments."""
    process_arguments(parser)
    about = "profile of the link; watched for changes"
    parser.add_argument("--profile", type=Path, required=True, metavar="FILE", help=about)
    about = "direction of the profile to shape"
    parser.add_argument("--direction", choices=("uplink", "downlink"), required=True, help=about)
    about = "auto (default) takes netem if permissions and kernel allow it, else relay"
    parser.add_argument("--mode", choices=("auto", "netem", "relay"), default="auto", help=about)
    about = "address of the other tunnel end"
    parser.add_argument("--peer", type=read_address, required=True, metavar="HOST:PORT", help=about)
    about = (
        "address from which the own tunnel end sends; the relay takes datagrams from no"
        " other (default: from any that reaches --listen)"
    )
    parser.add_argument("--end", type=read_address, metavar="HOST:PORT", help=about)
    here = ("127.0.0.1", 7401)
    about = "where the relay receives datagrams (default: 127.0.0.1:7401)"
    parser.add_argument(
        "--listen", type=read_address, default=here, metavar="HOST:PORT", help=about
    )
    about = "write the address to which the own tunnel end must send, once ready"
    parser.add_argument("--route", type=Path, required=True, metavar="FILE", help=about)
    about = "answer PUT /link on this Unix socket, which changes the link"
    parser.add_argument("--control", type=Path, metavar="FILE", help=about)
    about = "start of the schedule, monotonic clock [ns] (default: when the link comes up)"
    parser.add_argument(
        "--origin", type=whole_number(0, 2**63 - 1), default=0, metavar="NS", help=about
    )


def execute(options: Options) -> None:
    """Shape one direction of the link until SIGTERM."""
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.flight.pod.link import LinkSettings, run_link

    run_link(settings_from(options, LinkSettings), stop)
