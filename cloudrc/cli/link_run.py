"""Run `cloudrc link run`: the process that shapes one direction of a link."""

from __future__ import annotations

import argparse
from pathlib import Path

from cloudrc.cli.parser import settings_from, whole_number
from cloudrc.cli.processes import process_arguments, read_address
from cloudrc.drivers.process import StopSignal

EPILOG = ""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the action's arguments."""
    process_arguments(parser)
    add = parser.add_argument
    file = "profile of the link; watched for changes"
    add("--profile", type=Path, required=True, metavar="FILE", help=file)
    way = "direction of the profile to shape"
    add("--direction", choices=("uplink", "downlink"), required=True, help=way)
    mode = "auto (default) takes netem if permissions and kernel allow it, else relay"
    add("--mode", choices=("auto", "netem", "relay"), default="auto", help=mode)
    peer = "address of the other tunnel end"
    add("--peer", type=read_address, required=True, metavar="HOST:PORT", help=peer)
    end = (
        "address from which the own tunnel end sends; the relay takes datagrams from no"
        " other (default: from any that reaches --listen)"
    )
    add("--end", type=read_address, metavar="HOST:PORT", help=end)
    listen, here = "where the relay receives datagrams (default: 127.0.0.1:7401)", "127.0.0.1"
    add("--listen", type=read_address, default=(here, 7401), metavar="HOST:PORT", help=listen)
    route = "write the address to which the own tunnel end must send, once ready"
    add("--route", type=Path, required=True, metavar="FILE", help=route)
    control = "answer PUT /link on this Unix socket, which changes the link"
    add("--control", type=Path, metavar="FILE", help=control)
    origin = "start of the time line, monotonic clock [ns] (default: when the link comes up)"
    add("--origin", type=whole_number(0, 2**63 - 1), default=0, metavar="NS", help=origin)


def execute(options: argparse.Namespace) -> int:
    """Shape one direction of the link until SIGTERM."""
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.processes.link import LinkSettings, run_link

    run_link(settings_from(options, LinkSettings), stop)
    return 0
