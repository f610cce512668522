# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link run`: the process that shapes one direction of a link."""

from __future__ import annotations

from cloudrc.cli.parser import Options, Parser, flags, settings_from, whole_number
from cloudrc.cli.processes import process_arguments, read_address
from cloudrc.drivers.process import StopSignal

EPILOG = ""


def arguments(parser: Parser) -> None:
    """Declare the action's arguments."""
    process_arguments(parser)
    add = flags(parser)
    add("--profile", "FILE", "profile of the link; watched for changes", required=True)
    way = "direction of the profile to shape"
    add("--direction", None, way, choices=("uplink", "downlink"), required=True)
    mode = "auto (default) takes netem if permissions and kernel allow it, else relay"
    add("--mode", None, mode, "auto", choices=("auto", "netem", "relay"))
    add("--peer", "HOST:PORT", "address of the other tunnel end", read=read_address, required=True)
    end = (
        "address from which the own tunnel end sends; the relay takes datagrams from no"
        " other (default: from any that reaches --listen)"
    )
    add("--end", "HOST:PORT", end, read=read_address)
    listen, here = "where the relay receives datagrams (default: 127.0.0.1:7401)", "127.0.0.1"
    add("--listen", "HOST:PORT", listen, (here, 7401), read_address)
    route = "write the address to which the own tunnel end must send, once ready"
    add("--route", "FILE", route, required=True)
    add("--control", "FILE", "answer PUT /link on this Unix socket, which changes the link")
    origin = "start of the time line, monotonic clock [ns] (default: when the link comes up)"
    add("--origin", "NS", origin, 0, whole_number(0, 2**63 - 1))


def execute(options: Options) -> None:
    """Shape one direction of the link until SIGTERM."""
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.processes.link import LinkSettings, run_link

    run_link(settings_from(options, LinkSettings), stop)
