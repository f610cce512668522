# SPDX-License-Identifier: Apache-2.0

"""Run the processes `cloudrc world` and `cloudrc cloud` of a local run or a pod."""

from __future__ import annotations

import argparse
import socket
from pathlib import Path
from types import SimpleNamespace

from cloudrc.doors.cli.parser import (
    Arguments,
    Options,
    Parser,
    read_size,
    settings_from,
    whole_number,
)
from cloudrc.flight.drivers.process import StopSignal
from cloudrc.flight.drivers.realtime import Address, split_address


def process_arguments(parser: Parser) -> None:
    """Declare the flags that world, cloud, link and teleop have in common."""
    status_arguments(parser)
    number_argument(parser)


def number_argument(parser: Arguments) -> None:
    """Declare the flag of processes that work for one robot of a fleet."""
    about = "number in the experiment's fleet (default: no fleet)"
    parser.add_argument("--robot", type=whole_number(0, 999), metavar="K", help=about)


def status_arguments(parser: Parser) -> None:
    """Declare the flags that all processes have in common."""
    parser.add_argument(
        "--config", type=Path, required=True, metavar="FILE", help="experiment file (YAML)"
    )
    about = "write status for a supervisor to stdout (default: events only)"
    parser.add_argument("--feed", action="store_true", help=about)
    about = "serve metrics and health checks here (default: off)"
    parser.add_argument("--metrics", type=read_address, metavar="HOST:PORT", help=about)


def _end_arguments(parser: Parser) -> None:
    process_arguments(parser)
    about = "MCAP file to record to; an existing one becomes NAME.before.mcap"
    parser.add_argument("--record", type=Path, required=True, metavar="FILE", help=about)
    about = "no periodic records while the robot does not fly"
    parser.add_argument("--record-flights", action="store_true", help=about)
    about = "limit of both files, such as 500M or 1Gi; at 45 %% the recording begins anew"
    parser.add_argument("--record-max", type=read_size, metavar="SIZE", help=about)
    about = "address to receive at"
    parser.add_argument(
        "--listen", type=read_address, required=True, metavar="HOST:PORT", help=about
    )
    about = "the tunnel's key ('cloudrc key new FILE')"
    parser.add_argument("--key", type=Path, required=True, metavar="FILE", help=about)
    about = "the link's file with the address to send to; the link's state is beside it"
    parser.add_argument("--route", type=Path, required=True, metavar="FILE", help=about)
    about = "where to send without a link process; to robot 0's PORT, the number is added"
    parser.add_argument("--peer", type=read_address, metavar="HOST:PORT", help=about)


def _cloud_arguments(parser: Parser) -> None:
    _end_arguments(parser)
    about = "folder of the sockets of 'cloudrc teleop --socket DIR'"
    parser.add_argument("--teleop", type=Path, required=True, metavar="DIR", help=about)
    about = "folder of the sockets of programs that read cloud's records (default: that of teleop)"
    parser.add_argument("--records", type=Path, metavar="DIR", help=about)


def read_address(text: str) -> Address:
    """Parse HOST:PORT for argparse; an IPv6 address is in brackets.

    The host [::] means all addresses of this machine; without IPv6 it becomes 0.0.0.0.
    """
    try:
        host, port = split_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return "0.0.0.0" if host == "::" and not _has_ipv6() else host, port


def _has_ipv6() -> bool:
    try:
        socket.socket(socket.AF_INET6, socket.SOCK_DGRAM).close()
    except OSError:
        return False
    return True


def _run_world(options: Options) -> None:
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.flight.processes.ends import EndSettings, run_world

    run_world(settings_from(options, EndSettings), stop)


def _run_cloud(options: Options) -> None:
    stop = StopSignal()
    from cloudrc.flight.processes.ends import EndSettings, run_cloud

    run_cloud(settings_from(options, EndSettings), options.teleop, options.records, stop)


world = SimpleNamespace(arguments=_end_arguments, execute=_run_world)
cloud = SimpleNamespace(arguments=_cloud_arguments, execute=_run_cloud)
