"""`cloudrc up` and `cloudrc down`: a session, in which missions fly one after the other.

A session consists of the processes of a local run. It has no mission of its own: the robot waits on
the ground for the commands of an operator. The recordings of world and cloud contain all flights of
the session; `mission.mcap` and the report contain the last mission.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from math import inf
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Any

from cloudrc.cli.advice import warn
from cloudrc.cli.extras import MODES, require
from cloudrc.cli.find_run import run_argument, short
from cloudrc.cli.output import escape, print_line, print_or_drop
from cloudrc.cli.pool import interrupt_on_signals
from cloudrc.cli.processes import Command
from cloudrc.errors import BadInputError, CloudrcError, MissingPrerequisiteError

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.teleop.store import Mission

DOWN_LIMIT = 120.0
"""Time limit for a session to end and to write its report [s]."""
CONSOLE_LIMIT = 2.0
"""Time limit for the console to end after SIGTERM [s]; then it is killed."""
NEXT = """\
in another terminal:
  cloudrc mission run pipes
  cloudrc mission goto 0.5 0 1.2
  cloudrc link set --profile paper-p3
to end: Ctrl-C here, or cloudrc down"""
UP_EPILOG = """\
examples:
  cloudrc up
  cloudrc up hover --set link.profile=wifi
  cloudrc up --console

The session takes robot, controller and link from EXPERIMENT. The robot waits on
the ground until 'cloudrc mission run' or 'cloudrc mission goto' lets it fly. At
the end, the session writes the report of the last mission. The exit code is 0;
6 or 4 if a process has died or hung in flight."""
DOWN_EPILOG = """\
'down' waits until the session has ended, and prints the path of its report. It
does not end a flight of 'cloudrc run'; that flight ends with its mission."""


def _up_arguments(parser: argparse.ArgumentParser) -> None:
    from cloudrc.cli.run import experiment_arguments

    experiment_arguments(parser, parser)
    parser.add_argument("--console", action="store_true", help="also open the console's page")


def _up(options: argparse.Namespace) -> int:
    """Start a session, and keep it until a signal; return 0 after a regular end."""
    from cloudrc.cli import run
    from cloudrc.cli.report import summary
    from cloudrc.config.load import dump
    from cloudrc.drivers.local import locked

    began = time.monotonic()
    interrupt_on_signals()
    require("a session", (*MODES["local"], "api"))
    experiment = run.load(options.experiment, options.set, options.seed)
    run.refuse_virtual_keys(experiment)
    warn(experiment)
    run.check_model(experiment)
    folder = run.new_folder(options.out, f"{experiment.name}-session-seed{experiment.seed}")
    facts = f"seed {experiment.seed}, link {experiment.link.profile}"
    print_or_drop(escape(f"{experiment.name}: session, {facts}"))
    report = None
    with run.explain_disk_errors(folder), locked(folder):
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        broken, notes = _fly(folder, began, with_console=options.console)
        try:
            report = finish(folder, experiment.report.metrics, notes)
        except KeyboardInterrupt:
            remedy = f"'cloudrc report {folder}' writes its report"
            print_line(f"the recording is in {folder}; {remedy}", sys.stderr)
            raise
        except CloudrcError as error:
            raise broken or error from None
        if report is None:
            print_or_drop(escape(f"no mission flew, so there is no report; logs: {folder}"))
        else:
            print_or_drop(escape(report["notes"][0]))
            print_or_drop(summary(report, folder))
    if broken:
        raise broken
    return 0


def _fly(
    folder: Path, began: float, *, with_console: bool
) -> tuple[CloudrcError | None, tuple[str, ...]]:
    """Keep the session in `folder` until a signal; return the error that ended it, and notes.

    `began` is the time at which the command was started [s], monotonic clock.
    """
    from cloudrc.cli.progress import FlightView
    from cloudrc.drivers.local import LocalRun

    def ready(api: str, metrics: dict[str, str]) -> None:
        ports = ", ".join(f"{name} :{at.rpartition(':')[2]}" for name, at in metrics.items())
        shown = {"folder": short(folder.resolve()), "API": api}
        shown["metrics"] = f"http://127.0.0.1:PORT/metrics ({ports})"
        view.say(f"ready after {time.monotonic() - began:.1f} s: the robot waits on the ground")
        for name, text in shown.items():
            view.say(escape(f"  {name:<8} {text}"))
        view.say(NEXT)
        if with_console:
            stack.enter_context(_console(folder, view.say))

    with ExitStack() as stack:
        view = stack.enter_context(closing(FlightView(sys.stdout, 0)))
        local = LocalRun(folder, view.see, session=ready)
        try:
            local.fly(inf)
        except KeyboardInterrupt:
            view.say("the session ends and writes its report")
            return None, local.notes
        except CloudrcError as error:
            return error, (*local.notes, str(error))
    raise AssertionError("a session ends by an exception only")


@contextmanager
def _console(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Run `cloudrc console` while the block runs; `say` gets its address, or why there is none."""
    from cloudrc.drivers.machine import interpreter

    path, ends = folder / "console.log", False
    with path.open("wb") as log:
        process = subprocess.Popen(
            interpreter("-m", "cloudrc", "console", str(folder)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=log,
            start_new_session=True,  # Ctrl-C reaches only the session, which ends the console
        )

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            say(escape(line.decode(errors="replace").rstrip()))
        if not ends:
            lines = path.read_text(errors="replace").splitlines() or [f"see {path}"]
            say(escape(f"without a console: {lines[-1].removeprefix('cloudrc: error: ')}"))

    reader = Thread(target=read, daemon=True)
    reader.start()
    try:
        yield
    finally:
        ends = True
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(CONSOLE_LIMIT)
        process.kill()
        reader.join(CONSOLE_LIMIT)
        process.communicate()


def is_unfinished(folder: Path) -> bool:
    """Return whether a folder is that of a session that was killed before it wrote its report."""
    from cloudrc.drivers.local import JOURNAL_FILE

    return (folder / JOURNAL_FILE).is_file() and not (folder / "mission.mcap").exists()


def finish(
    folder: Path, own: Iterable[str] = (), notes: tuple[str, ...] = ()
) -> dict[str, Any] | None:
    """Write mission.mcap and the report of a session's last mission, and return the report.

    config.yaml then contains this mission. Return None if no mission flew. `own` are the user's
    metrics, which are executed; `notes` are sentences for the reader.
    """
    from cloudrc import assembly
    from cloudrc.cli.run import where_steps_ran
    from cloudrc.config.load import dump, read_experiment
    from cloudrc.record.hash import messages_sha256
    from cloudrc.record.merge import cut_to_last_mission, merge
    from cloudrc.report.document import Run
    from cloudrc.report.write import attachments, write_report

    recording, mission = merge(folder / "world.mcap", folder / "cloud.mcap"), _last(folder)
    if mission is None:
        return None
    cut_to_last_mission(recording)
    config = folder / "config.yaml"
    experiment: ResolvedExperiment = assembly.with_order(read_experiment(config), mission.order)
    config.write_text(dump(experiment), encoding="utf-8")
    about = f"This is mission {mission.id} ({mission.order.name}), the last one of a session."
    digest, steps = messages_sha256(recording.messages), where_steps_ran(experiment)
    facts = Run("local", "relay", digest, not mission.ended, (about, *notes), steps)
    try:
        return write_report(folder, recording.recording(), experiment, facts, own=own)
    finally:
        recording.write(folder / "mission.mcap", attachments(folder))


def _last(folder: Path) -> Mission | None:
    """Return the mission of a session that has started last; None if none has."""
    from cloudrc.drivers.local import JOURNAL_FILE
    from cloudrc.teleop.store import open_store

    if not (folder / JOURNAL_FILE).exists():
        return None
    with closing(open_store(folder / JOURNAL_FILE, b"")) as store:
        flown = [each for each in store.missions.values() if "started" in each.happened]
    return flown[-1] if flown else None


def _down(options: argparse.Namespace) -> int:
    """End a session, and print the path of its report."""
    from cloudrc.drivers.local import SESSION, end_session, flight_files

    flights = flight_files()
    found = [run for run, flight in flights.items() if flight.kind == SESSION]
    others = [short(run) for run in flights if run not in found]
    note = f"; {' and '.join(others)}: flown by 'cloudrc run', ends by Ctrl-C there" * bool(others)
    if options.run is not None:
        found = [run for run in found if run == options.run.resolve()]
        if not found:
            raise BadInputError(f"--run {options.run}: no session runs there{note}")
    if not found:
        raise MissingPrerequisiteError(f"no session runs here; start one: cloudrc up{note}")
    if len(found) > 1:
        names = " or ".join(f"--run {short(run)}" for run in found)
        raise BadInputError(f"{len(found)} sessions run here; choose one: {names}")
    (run,) = found
    end_session(run, DOWN_LIMIT)
    flew = (run / "report.json").exists()
    print_line(short(run / "report.html") if flew else f"{short(run)}: ended; no mission flew")
    return 0


up = Command(_up_arguments, _up, UP_EPILOG)
down = Command(run_argument, _down, DOWN_EPILOG)
