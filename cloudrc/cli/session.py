"""`cloudrc up` and `cloudrc down`: a session, in which missions fly one after the other.

A session consists of the processes of a local run. It has no mission of its own: the robot waits on
the ground for the commands of an operator. The recordings of world and cloud contain all flights of
the session; `mission.mcap` and the report contain the last mission.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from shlex import quote
from threading import Thread
from typing import IO, Any

from cloudrc.cli.find_run import run_argument
from cloudrc.cli.output import print_line
from cloudrc.cli.parser import whole_number
from cloudrc.cli.processes import CliCommand
from cloudrc.cli.report import report_arguments
from cloudrc.cli.run import experiment_arguments, fly_once
from cloudrc.errors import BadInputError, CloudrcError, NothingFlownError
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.requirements import MODES, require
from cloudrc.text import escape

Say = Callable[[str], None]
"""Function that prints a line above the status line of a flight."""
DOWN_LIMIT = 120.0
"""Time limit for a session to end and to write its report [s]."""
NEXT = """\
in another terminal:
  cloudrc mission run {mission}
  cloudrc mission goto {point}
  cloudrc link set --profile paper-p3
to end: Ctrl-C here, or cloudrc down"""
NEXT_UNSEEN = """\
in another terminal:
  cloudrc mission run {mission} --api {api}
  cloudrc mission goto {point} --api {api}
to end: Ctrl-C here"""
"""In place of `NEXT` if other commands do not find the session."""
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


def _up_arguments(parser: argparse.ArgumentParser) -> None:
    experiment_arguments(parser, parser)
    parser.add_argument("--console", action="store_true", help="also open the console's page")
    about = "serve the flight to Foxglove at this port of 127.0.0.1 (default: 8765)"
    port = whole_number(1, 65535)
    parser.add_argument("--foxglove", type=port, nargs="?", const=8765, metavar="PORT", help=about)
    report_arguments(parser)
    parser.set_defaults(output="table", beside="")


def _up(options: argparse.Namespace) -> int:
    """Start a session, and keep it until a signal; return 0 after a regular end."""

    def ready(
        folder: Path, say: Say, stack: ExitStack, api: str, metrics: Mapping[str, str]
    ) -> None:
        ports = ", ".join(f"{name} :{at.rpartition(':')[2]}" for name, at in metrics.items())
        say("the robot waits on the ground")
        say(escape(f"  folder   {short(folder.resolve())}"))
        say(escape(f"  API      {api}"))
        say(f"  metrics  http://127.0.0.1:PORT/metrics ({ports})")
        is_seen = folder.resolve() in under_way()
        mission, point = propose(folder / "config.yaml")
        text = NEXT if is_seen else NEXT_UNSEEN
        say(text.format(api=quote(escape(api)), mission=mission, point=point))
        if options.console:
            stack.enter_context(_beside(say, "cloudrc", "console", str(folder)))
        if options.foxglove:
            words = str(folder.resolve()), str(options.foxglove)
            stack.enter_context(_beside(say, "cloudrc.processes.foxglove_live", *words))

    from cloudrc.drivers.local import under_way
    from cloudrc.runs.under_way import short

    interrupt_on_signals()
    more = [name for name in ("console", "foxglove") if getattr(options, name)]
    require("a session", (*MODES["local"], *more))
    try:
        return fly_once(options, "local", ready)
    except NothingFlownError as nothing:
        print_line(str(nothing))
        return 0


def propose(config: Path) -> tuple[str, str]:
    """Return a shipped mission and a point that fit the scene and the robot of an experiment.

    `config` is the experiment's file. If no mission fits, return a word for a user's file.
    """
    from cloudrc.config.load import load_experiment, read_experiment
    from cloudrc.config.robot import is_planar
    from cloudrc.config.scene import scene_of
    from cloudrc.config.shipped import names

    world = read_experiment(config, flown=True).world
    x, y, z = scene_of(world).spawn
    point = f"{x + 1:g} {y:g}" if is_planar(world.robot) else f"{x + 0.5:g} {y:g} {z + 1.1:g}"
    for mission in sorted(names("mission"), key=lambda name: name != world.scene):
        with suppress(BadInputError):
            load_experiment(config, [f"mission={mission}"], build=False)
            return mission, point
    return "MISSION.yaml", point


@contextmanager
def _beside(say: Say, *words: str) -> Iterator[None]:
    """Run a module during the `with` block; pass its address or its error to `say`."""
    from cloudrc.cluster.client import end_process
    from cloudrc.drivers.machine import interpreter

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
                say(escape(line.rstrip()))

    reader = Thread(target=read, args=[process.stdout], daemon=True)
    with process:
        reader.start()
        try:
            yield
        finally:
            end_process(process)
            reader.join()


def _down(options: argparse.Namespace) -> int:
    """End a session, and print the path of its report."""
    from cloudrc.drivers.local import end_session
    from cloudrc.runs.session import last_mission
    from cloudrc.runs.under_way import find_session, short

    run, note = find_session(options.run)
    if note:
        print_line(f"cloudrc: {note}", sys.stderr)
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
    return 0


up = CliCommand(_up_arguments, _up, UP_EPILOG)
down = CliCommand(run_argument, _down, DOWN_EPILOG)
