# SPDX-License-Identifier: Apache-2.0

"""Run the processes `cloudrc world` and `cloudrc cloud` of a local run or a pod."""

from __future__ import annotations

import argparse
import socket
from types import SimpleNamespace

from cloudrc.cli.parser import (
    Arguments,
    Options,
    Parser,
    flags,
    read_size,
    settings_from,
    whole_number,
)
from cloudrc.drivers.process import StopSignal
from cloudrc.drivers.realtime import Address, split_address


def process_arguments(parser: Parser) -> None:
    """Declare the flags that world, cloud, link and teleop have in common."""
    status_arguments(parser)
    number_argument(parser)


def number_argument(parser: Arguments) -> None:
    """Declare the flag of processes that work for one robot of a fleet."""
    about = "number in the experiment's fleet (default: no fleet)"
    flags(parser)("--robot", "K", about, read=whole_number(0, 999))


def status_arguments(parser: Parser) -> None:
    """Declare the flags that all processes have in common."""
    add = flags(parser)
    add("--config", "FILE", "experiment file (YAML)", required=True)
    add("--feed", "", "write status for a supervisor to stdout (default: events only)")
    about = "serve metrics and health checks here (default: off)"
    add("--metrics", "HOST:PORT", about, read=read_address)


def _end_arguments(parser: Parser) -> None:
    process_arguments(parser)
    add = flags(parser)
    file = "MCAP file to record to; an existing one becomes NAME.before.mcap"
    add("--record", "FILE", file, required=True)
    add("--record-flights", "", "no periodic records while the robot does not fly")
    size = "limit of both files, such as 500M or 1Gi; at 45 %% the recording begins anew"
    add("--record-max", "SIZE", size, read=read_size)
    add("--listen", "HOST:PORT", "address to receive at", read=read_address, required=True)
    add("--key", "FILE", "the tunnel's key ('cloudrc key new FILE')", required=True)
    route = "the link's file with the address to send to; the link's state is beside it"
    add("--route", "FILE", route, required=True)
    peer = "where to send without a link process; to robot 0's PORT, the number is added"
    add("--peer", "HOST:PORT", peer, read=read_address)


def _cloud_arguments(parser: Parser) -> None:
    _end_arguments(parser)
    add = flags(parser)
    add("--teleop", "DIR", "folder of the sockets of 'cloudrc teleop --socket DIR'", required=True)
    text = "folder of the sockets of programs that read cloud's records (default: that of teleop)"
    add("--records", "DIR", text)


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
    from cloudrc.processes.ends import EndSettings, run_world

    run_world(settings_from(options, EndSettings), stop)


def _run_cloud(options: Options) -> None:
    stop = StopSignal()
    from cloudrc.processes.ends import EndSettings, run_cloud

    run_cloud(settings_from(options, EndSettings), options.teleop, options.records, stop)


world = SimpleNamespace(arguments=_end_arguments, execute=_run_world)
cloud = SimpleNamespace(arguments=_cloud_arguments, execute=_run_cloud)
