# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc process world`: the robot's end of a local run or a pod."""

from __future__ import annotations

from cloudrc.doors.cli.parser import Options, Parser, settings_from
from cloudrc.doors.cli.processes import end_arguments
from cloudrc.flight.pod.process import StopSignal

EPILOG = None


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    end_arguments(parser)


def execute(options: Options) -> None:
    """Simulate the robot until a signal stops the process."""
    stop = StopSignal()  # first: until then, process 1 of a container ignores SIGTERM
    from cloudrc.flight.pod.ends import EndSettings, run_world

    run_world(settings_from(options, EndSettings), stop)
