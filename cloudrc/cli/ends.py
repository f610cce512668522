"""What the three process commands share: their flags, their socket addresses, their recorder."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.record.recorder import Recorder

Address = tuple[str, int]
EPILOG = """\
'cloudrc run --mode local' starts this process with the flags that it needs.
It ends on SIGTERM, on Ctrl-C, and when the process that started it is gone."""


def process_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what every process takes."""
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="the experiment")


def end_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what an end of the tunnel takes."""
    process_arguments(parser)
    parser.add_argument("--record", type=Path, metavar="FILE", help="MCAP file to write")
    for flag, text in (("--listen", "where to receive"), ("--peer", "where to send")):
        parser.add_argument(flag, type=address, required=True, metavar="HOST:PORT", help=text)


def address(text: str) -> Address:
    """Read HOST:PORT, as argparse calls it."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT")
    return host, int(port)


def warn_if_exposed(listen: Address) -> None:
    """Say so if others than this machine can send to an address."""
    if not listen[0].startswith("127."):
        print(f"cloudrc: warning: {listen[0]} can be reached from outside", file=sys.stderr)


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


def open_recorder(path: Path | None, clock: str, clock_id: bytes) -> Recorder:
    """Make the recorder of a process; without a file it writes into nothing."""
    from cloudrc.record.recorder import Recorder
    from cloudrc.record.writer import McapWriter

    return Recorder(
        path or Path(os.devnull),
        lambda file: McapWriter(file, clock=clock, clock_id=clock_id.hex()),
    )
