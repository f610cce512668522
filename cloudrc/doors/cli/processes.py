# SPDX-License-Identifier: Apache-2.0

"""Flags that the processes of a flight have in common, and addresses."""

from __future__ import annotations

import argparse
import socket
from pathlib import Path

from cloudrc.doors.cli.parser import (
    Arguments,
    Parser,
    read_size,
    whole_number,
)
from cloudrc.flight.pod.realtime import Address, split_address


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


def end_arguments(parser: Parser) -> None:
    """Declare the flags that world and cloud have in common."""
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
