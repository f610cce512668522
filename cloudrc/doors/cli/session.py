# SPDX-License-Identifier: Apache-2.0

"""`cloudrc up` and `cloudrc down`: a session, in which missions fly one after the other.

A session consists of the processes of a local run. It has no mission of its own: the robot waits on
the ground for the commands of an operator. The recordings of world and cloud contain all flights of
the session; `mission.mcap` and the report contain the last mission.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from shlex import quote
from threading import Thread
from types import SimpleNamespace
from typing import IO, Any

from cloudrc.base.errors import CloudrcError, NothingFlownError
from cloudrc.base.requirements import MODES, require
from cloudrc.doors.cli.output import print_line
from cloudrc.doors.cli.parser import Options, Parser, whole_number
from cloudrc.doors.cli.report import report_arguments
from cloudrc.doors.cli.run import experiment_arguments, fly_once
from cloudrc.doors.cli.where import run_argument

Say = Callable[[str], None]
"""Function that prints a line above the status line of a flight."""
DOWN_LIMIT = 120.0
"""Time limit for a session to end and to write its report [s]."""
NEXT = """\
the robot waits on the ground
  folder   {run}
  API      {api}
  metrics  http://127.0.0.1:PORT/metrics ({ports})
in another terminal:
  cloudrc mission goto {point}
  cloudrc mission run {mission}
  cloudrc link set --profile paper-p3
to end: Ctrl-C here, or cloudrc down"""
UP_EPILOG = """\
examples:
  cloudrc up
  cloudrc up hover --set link.profile=wifi
  cloudrc up --console
  cloudrc up --foxglove                  live in Foxglove

The session takes robot, controller and link from EXPERIMENT. The robot waits on
the ground until 'cloudrc mission run' or 'cloudrc mission goto' lets it fly. At
the end, the session writes the report of the last mission. The exit code is 0;
6 or 4 if a process has died or hung in flight."""
DOWN_EPILOG = """\
'down' waits until the session has ended, and prints the path of its report. It
does not end a flight of 'cloudrc run'; that flight ends with its mission."""


def _up_arguments(parser: Parser) -> None:
    experiment_arguments(parser, parser)
    parser.add_argument("--console", action="store_true", help="also open the console's page")
    about = "serve the flight to Foxglove at this port of 127.0.0.1 (default: 8765)"
    parser.add_argument(
        "--foxglove", nargs="?", const=8765, type=whole_number(1, 65535), metavar="PORT", help=about
    )
    report_arguments(parser)
    parser.set_defaults(output="table", beside="")


def _up(options: Options) -> int:
    """Start a session, and keep it until a signal; return 0 after a regular end."""

    def ready(
        folder: Path, say: Say, stack: ExitStack, api: str, metrics: Mapping[str, str]
    ) -> None:
        run = folder.resolve()
        ports = ", ".join(f"{name} :{at.rpartition(':')[2]}" for name, at in metrics.items())
        mission, point = propose(run / "config.yaml")
        for line in NEXT.format(
            run=short(run), api=api, ports=ports, mission=mission, point=point
        ).splitlines():
            say(line)
        if options.console:
            stack.enter_context(_beside(say, "cloudrc", "console", str(folder)))
        if options.foxglove:
            words = str(run), str(options.foxglove)
            stack.enter_context(_beside(say, "cloudrc.flight.pod.foxglove_live", *words))

    from cloudrc.doors.cli.under_way import short

    more = [name for name in ("console", "foxglove") if getattr(options, name)]
    require("a session", (*MODES["local"], *more))
    try:
        return fly_once(options, "local", ready)
    except NothingFlownError as nothing:
        print_line(str(nothing))
        return 0


def propose(config: Path) -> tuple[str, str]:
    """Return a mission and a point that fit the scene and the robot of an experiment's file."""
    from cloudrc.config.load import read_experiment
    from cloudrc.config.shipped import names

    experiment = read_experiment(config, flown=True)
    x, y, z = experiment.scene.spawn
    scene = experiment.world.scene
    is_planar = experiment.robot.planar
    point = f"{x + 1:g} {y:g}" if is_planar else f"{x + 0.5:g} {y:g} {z + 1.1:g}"
    return scene if scene in names("mission") else "MISSION.yaml", point


@contextmanager
def _beside(say: Say, *words: str) -> Iterator[None]:
    """Run a module during the `with` block; pass its address or its error to `say`."""
    from cloudrc.flight.machine import end_process, interpreter

    process: subprocess.Popen[Any] = subprocess.Popen(
        interpreter("-m", *words),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,  # Ctrl-C reaches only this process, which ends the other
    )

    def read(lines: IO[str]) -> None:
        for line in lines:
            if line.startswith(("console:", "cloudrc:", "foxglove:")):
                say(line.rstrip())

    reader = Thread(target=read, args=[process.stdout], daemon=True)
    with process:
        reader.start()
        try:
            yield
        finally:
            end_process(process)
            reader.join()


def _down(options: Options) -> None:
    """End a session, and print the path of its report."""
    from cloudrc.doors.cli.under_way import find_session, short
    from cloudrc.flight.local.supervisor import end_session
    from cloudrc.flight.session import last_mission

    run = find_session(options.run)
    end_session(run, DOWN_LIMIT)
    name = short(run)
    page, report = run / "report.html", run / "report.json"
    if report.exists():
        print_line(short(page if page.exists() else report))
    elif last := last_mission(run):
        text = f"ended; mission {last.id} flew, but has no report"
        raise CloudrcError(f"{name}: {text}; to write it: cloudrc report {quote(str(name))}")
    else:
        print_line(f"{name}: ended; no mission flew")


up = SimpleNamespace(arguments=_up_arguments, execute=_up, EPILOG=UP_EPILOG)
down = SimpleNamespace(arguments=run_argument, execute=_down, EPILOG=DOWN_EPILOG)
