"""Run the processes `cloudrc world` and `cloudrc cloud` of a local run or a pod."""

from __future__ import annotations

import argparse
import re
import socket
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from cloudrc.cli.parser import settings_from
from cloudrc.drivers.process import StopSignal
from cloudrc.drivers.realtime import Address, split_address


class CliCommand(NamedTuple):
    """One command of a module that defines several commands.

    A module with only one command is used in place of a `CliCommand`: it defines the same names.
    """

    arguments: Callable[[argparse.ArgumentParser], None]
    execute: Callable[[argparse.Namespace], int]
    EPILOG: str | None = None


def _add(
    parser: argparse.ArgumentParser, flag: str, kind: str, text: str, *, required: bool = False
) -> None:
    """Declare a flag; `kind`, such as "FILE", names its value; with "" the flag has no value."""
    if not kind:
        parser.add_argument(flag, action="store_true", help=text)
        return
    read: Callable[[str], object] = {"HOST:PORT": read_address, "SIZE": read_size}.get(kind, Path)
    parser.add_argument(flag, type=read, metavar=kind, help=text, required=required)


def process_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags that world, cloud, link and teleop have in common."""
    _add(parser, "--config", "FILE", "experiment file (YAML)", required=True)
    _add(parser, "--feed", "", "write status for a supervisor to stdout (default: events only)")
    _add(parser, "--metrics", "HOST:PORT", "serve metrics and health checks here (default: off)")


def _end_arguments(parser: argparse.ArgumentParser) -> None:
    process_arguments(parser)
    file = "MCAP file to record to; an existing one becomes NAME.before.mcap"
    _add(parser, "--record", "FILE", file, required=True)
    _add(parser, "--record-flights", "", "no periodic records while the robot does not fly")
    size = "limit of both recordings, such as 500M or 1Gi; at 90 %% the recording ends"
    _add(parser, "--record-max", "SIZE", size)
    _add(parser, "--listen", "HOST:PORT", "address to receive at", required=True)
    _add(parser, "--key", "FILE", "the tunnel's key ('cloudrc key new FILE')", required=True)
    route = "the link's file with the address to send to; the link's state is beside it"
    _add(parser, "--route", "FILE", route, required=True)


def _cloud_arguments(parser: argparse.ArgumentParser) -> None:
    _end_arguments(parser)
    text = "folder of the sockets of 'cloudrc teleop --socket DIR'"
    _add(parser, "--teleop", "DIR", text, required=True)
    text = "folder of the sockets of programs that read cloud's records (default: that of teleop)"
    _add(parser, "--records", "DIR", text)


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


def read_size(text: str) -> float:
    """Parse a size in the notation of Kubernetes, such as 500M, for argparse; return bytes."""
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([kKMGT]?)(i?)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' is not a size such as 500M or 1Gi")
    number, unit, binary = found.groups()
    power = " KMGT".index(unit.upper() or " ")
    return float(number) * (1024.0 if binary else 1000.0) ** power


def _run_world(options: argparse.Namespace) -> int:
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.processes.ends import EndSettings, run_world

    run_world(settings_from(options, EndSettings), stop)
    return 0


def _run_cloud(options: argparse.Namespace) -> int:
    stop = StopSignal()
    from cloudrc.processes.ends import EndSettings, run_cloud

    run_cloud(settings_from(options, EndSettings), options.teleop, options.records, stop)
    return 0


world = CliCommand(_end_arguments, _run_world)
cloud = CliCommand(_cloud_arguments, _run_cloud)
