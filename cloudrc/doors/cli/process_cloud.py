# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc process cloud`: the remote end of a local run or a pod."""

from __future__ import annotations

from pathlib import Path

from cloudrc.doors.cli.parser import Options, Parser, settings_from
from cloudrc.doors.cli.processes import end_arguments
from cloudrc.flight.pod.process import StopSignal

EPILOG = None


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)
    about = "folder of the sockets of 'cloudrc process teleop --socket DIR'"
    parser.add_argument("--teleop", type=Path, required=True, metavar="DIR", help=about)
    about = "folder of the sockets of programs that read cloud's records (default: that of teleop)"
    parser.add_argument("--records", type=Path, metavar="DIR", help=about)


def execute(options: Options) -> None:
    """Control the robot until a signal stops the process."""
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.flight.pod.ends import EndSettings, run_cloud

    run_cloud(settings_from(options, EndSettings), options.teleop, options.records, stop)
