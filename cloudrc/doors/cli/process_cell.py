# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc process cell`: the process through which the packets of a fleet pass."""

from __future__ import annotations

from pathlib import Path

from cloudrc.doors.cli.parser import Options, Parser, read_size, settings_from, whole_number
from cloudrc.doors.cli.processes import read_address, status_arguments
from cloudrc.flight.pod.process import StopSignal

EPILOG = """\
Robot k's world sends to the port of --uplink + k, its cloud to the port of
--downlink + k. What leaves the cell goes to --clouds and --worlds: {robot} in
HOST becomes the robot's number; without it, the number is added to PORT."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    status_arguments(parser)
    for name, end, to in (("uplink", "worlds", "clouds"), ("downlink", "clouds", "worlds")):
        about = f"where to receive what {end} send"
        parser.add_argument(
            f"--{name}", type=read_address, required=True, metavar="HOST:PORT", help=about
        )
        about = f"where to send the {name}"
        parser.add_argument(
            f"--{to}", type=read_address, required=True, metavar="HOST:PORT", help=about
        )
    parser.add_argument(
        "--record", type=Path, required=True, metavar="FILE", help="CSV file for what the cell does"
    )
    about = "at this size, such as 20M, the file begins anew"
    parser.add_argument("--record-max", type=read_size, metavar="SIZE", help=about)
    about = "number of robots, as after 'kubectl scale' (default: that of the experiment)"
    parser.add_argument("--robots", type=whole_number(1, 1000), metavar="N", help=about)


def execute(options: Options) -> None:
    """Carry packets until SIGTERM."""
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.flight.pod.cell import CellSettings, run_cell

    run_cell(settings_from(options, CellSettings), stop)
