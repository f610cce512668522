"""What the process commands share: their flags, their socket addresses, their metrics."""

from __future__ import annotations

import argparse
import re
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter

Address = tuple[str, int]
LOOPBACK_NAMES = ("localhost", "::1", "[::1]")
EPILOG = """\
'cloudrc run --mode local' starts this process with the flags that it needs.
It ends on SIGTERM, on Ctrl-C, and when the process that started it is gone."""


def process_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what every process takes."""
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="the experiment")
    parser.add_argument(
        "--feed", action="store_true", help="tell a supervisor on stdout; else only events are said"
    )
    parser.add_argument(
        "--metrics",
        type=address,
        metavar="HOST:PORT",
        help="serve /metrics, /healthz and /readyz here (default: not at all)",
    )


def end_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what an end of the tunnel takes."""
    process_arguments(parser)
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="MCAP file to write; one that is there is kept, as NAME.before.mcap",
    )
    parser.add_argument(
        "--record-flights",
        action="store_true",
        help="leave out what comes periodically while nothing flies",
    )
    parser.add_argument(
        "--record-max",
        type=size,
        metavar="SIZE",
        help="end the recording at nine tenths of this, one kept from before counted: 500M, 1Gi "
        "(default: no limit)",
    )
    parser.add_argument(
        "--listen", type=address, required=True, metavar="HOST:PORT", help="where to receive"
    )
    parser.add_argument(
        "--link",
        type=Path,
        metavar="FILE",
        help="where the link tells its state; its changes are recorded (default: link.json beside"
        " the route)",
    )
    parser.add_argument(
        "--key",
        type=Path,
        required=True,
        metavar="FILE",
        help="the tunnel's pre-shared key; followed while it flies ('cloudrc key new FILE')",
    )
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument(
        "--peer", type=address, metavar="HOST:PORT", help="where to send; a name is resolved once"
    )
    target.add_argument(
        "--route",
        type=Path,
        metavar="FILE",
        help="file that says where to send, HOST:PORT with the host as a number; it is waited for"
        " and followed",
    )


def address(text: str) -> Address:
    """Read HOST:PORT, as argparse calls it."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT")
    return host, int(port)


def resolve(name: str) -> list[str]:
    """Give the IPv4 addresses of a name; raises an OSError if there is none."""
    try:
        found = socket.getaddrinfo(name, None, socket.AF_INET, socket.SOCK_DGRAM)
    except UnicodeError as error:  # a label that is empty or too long
        raise OSError(f"not a name: {error}") from error
    return [str(entry[4][0]) for entry in found]


def resolved(flag: str, where: Address) -> Address:
    """Give an address in numbers, once and before the loop: that cannot wait for a name server.

    Raises:
        BadInputError: If its host cannot be resolved; names the flag.
    """
    host, port = where
    try:
        return resolve(host)[0], port
    except OSError as error:
        raise BadInputError(
            f"{flag} {host}:{port}: {host} cannot be resolved ({error.strerror or error}); name a"
            " host that has an IPv4 address, or the address itself"
        ) from error


def size(text: str) -> float:
    """Read an amount of bytes as Kubernetes writes it, as argparse calls it."""
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)(m|k|Ki|M|Mi|G|Gi|T|Ti)?", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' is not a size such as 500M or 1Gi")
    number, unit = found.groups(default="")
    factor = {"": 1.0, "m": 1e-3}.get(unit)
    if factor is None:
        base = 1024.0 if unit.endswith("i") else 1000.0
        factor = base ** ("kMGT".index(unit[0].replace("K", "k")) + 1)
    return float(number) * factor


def warn_if_exposed(listen: Address) -> None:
    """Say so if others than this machine can send to an address."""
    if not listen[0].startswith("127.") and listen[0] not in LOOPBACK_NAMES:
        print(f"cloudrc: warning: {listen[0]} can be reached from outside", file=sys.stderr)


def open_exporter(options: argparse.Namespace, role: str) -> Exporter | None:
    """Serve a process's metrics where its flags say; None if they do not."""
    if options.metrics is None:
        return None
    from cloudrc.drivers.exporter import Exporter

    warn_if_exposed(options.metrics)
    elsewhere = getattr(options, "teleop", None) is not None
    exporter = Exporter(role, missions=not elsewhere)
    exporter.serve(options.metrics)
    return exporter


@contextmanager
def listening(flag: str, listen: Address) -> Iterator[None]:
    """Open a socket at an address inside; if that fails, say which flag asked for what."""
    try:
        yield
    except OSError as error:
        raise BadInputError(
            f"{flag} {listen[0]}:{listen[1]}: cannot receive there: {error.strerror or error};"
            " name an address of this machine and a port that is free"
        ) from error
