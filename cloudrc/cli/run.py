"""`cloudrc run`: fly an experiment, write a recording and a report, and print the verdict."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from shlex import quote, split
from shutil import which
from typing import TYPE_CHECKING, Any, TextIO

from cloudrc.cli.cluster_flags import (
    DEFAULT_RELEASE,
    release_arguments,
    release_from_flags,
    timeout_argument,
)
from cloudrc.cli.output import (
    output_argument,
    print_line,
    print_or_drop,
    print_result,
    warn,
)
from cloudrc.cli.parser import read_count, read_seed
from cloudrc.cli.report import print_traceback, report_arguments, summary
from cloudrc.errors import BadInputError, CloudrcError, NothingFlownError
from cloudrc.runs.folder import point_to, run_folder
from cloudrc.runs.interrupts import interrupt_on_signals, is_interrupted
from cloudrc.runs.requirements import MODES, require
from cloudrc.text import escape

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment

Flight = Callable[[Path], dict[str, Any]]
"""Function that flies, writes all files of the run into a folder, and returns the report."""
Ready = Callable[[Path, Callable[[str], None], contextlib.ExitStack, str, dict[str, str]], None]
"""Function that a session calls when it is ready. Arguments: the run's folder, a function that
prints a line, a stack that closes at the end, the API's URL, process -> HOST:PORT of metrics."""

EPILOG = """\
modes:
  local    real time: five processes, UDP on 127.0.0.1
  virtual  one process, virtual time: the same flight in seconds, repeatable
  cluster  Kubernetes: installs the chart, flies by a Job, fetches the recording

examples:
  cloudrc run
  cloudrc run paper --mode virtual --set link.profile=satellite
  cloudrc run steps --seeds 10 --set cloud.predictor=last_sample
  cloudrc run pillars --mode virtual --report none        no report.html
  cloudrc run my.yaml --mode virtual --set cloud.predictor=./my_predictor.py
  cloudrc run --set cloud.controller=remote --with "node controller.js"
  cloudrc run --mode cluster --context kind-cloudrc -n demo --release demo
  cloudrc run runs/latest/config.yaml --mode virtual     the same run again

'cloudrc list' shows the names of experiments, profiles and plug-ins. The last
line of the output is the path of the report."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    many = parser.add_mutually_exclusive_group()
    experiment_arguments(parser, many)
    about = "where to fly (default: local; with --seeds: virtual)"
    parser.add_argument("--mode", choices=MODES, help=about)
    about = "fly seeds 1 to N on all cores and print a table"
    many.add_argument("--seeds", type=read_count, metavar="N", help=about)
    about = "start this program with the flight, and end it with it: a remote controller"
    parser.add_argument("--with", dest="beside", default="", metavar="CMD", help=about)
    report_arguments(parser)
    output_argument(parser, "json, yaml: print only the report")
    release_arguments(parser, DEFAULT_RELEASE)
    timeout_argument(parser)


def experiment_arguments(parser: argparse.ArgumentParser, seed: argparse._ActionsContainer) -> None:
    """Declare the arguments that choose an experiment, with `--seed` in the group `seed`."""
    add = parser.add_argument
    about = "name of a shipped experiment, or a YAML file (default: paper)"
    add("experiment", nargs="?", default="paper", metavar="EXPERIMENT", help=about)
    about = "random seed of this run (default: the experiment's)"
    seed.add_argument("--seed", type=read_seed, metavar="S", help=about)
    about = "change one key of the experiment; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    add("--out", type=Path, metavar="DIR", help="folder of the run (default: a new one in runs/)")


def execute(options: argparse.Namespace) -> int:
    """Fly once, or once per seed with `--seeds`; return the exit code."""
    interrupt_on_signals()  # an interrupted flight still gets its report
    mode = options.mode or ("virtual" if options.seeds else "local")
    if options.seeds and mode != "virtual":
        raise BadInputError(f"--seeds flies in virtual time; leave out --mode {mode}")
    if options.beside:
        _check_beside(options, mode)
    if options.seeds and options.figures:
        raise BadInputError("--figures draws one flight; leave out --seeds")
    is_drawn = options.report == "page" or options.figures
    require(f"mode {mode}", [each for each in MODES[mode] if is_drawn or each != "report"])
    if options.seeds:
        from cloudrc.cli.sweep_run import fly_seeds

        return fly_seeds(options)
    return fly_once(options, mode)


def _check_beside(options: argparse.Namespace, mode: str) -> None:
    if options.seeds or mode == "cluster":
        other = "--seeds" if options.seeds else "--mode cluster"
        raise BadInputError(f"--with starts a program for one flight here; leave out {other}")
    try:
        words = split(options.beside)
    except ValueError as error:
        raise BadInputError(f"--with '{options.beside}': no command: {error}") from None
    if not words or which(words[0]) is None:
        program = words[0] if words else ""
        raise BadInputError(f"--with '{options.beside}': there is no program '{program}' here")


def _experiment(options: argparse.Namespace, *, is_session: bool) -> ResolvedExperiment:
    """Return the experiment that `options` name.

    The missions of a session come later. Its scene thus needs no body that the experiment's own
    mission touches.
    """
    from cloudrc.runs.experiment import load

    try:
        return load(options.experiment, options.set, options.seed)
    except BadInputError:
        if not is_session:
            raise
        with contextlib.suppress(BadInputError):
            settings = ["mission.touch=null", *options.set]
            return load(options.experiment, settings, options.seed)
        raise


def fly_once(options: argparse.Namespace, mode: str, ready: Ready | None = None) -> int:
    """Fly as `options` say, print the summary, and return the exit code.

    With `ready`, fly a session of any number of missions; `ready` is called when the session waits
    for missions.
    """
    from cloudrc.metrics.verdict import exit_code
    from cloudrc.runs.experiment import check_mode
    from cloudrc.runs.own_files import describe_changes

    experiment = _experiment(options, is_session=ready is not None)
    check_mode(experiment, mode)
    warn(experiment)
    if changes := describe_changes(options.experiment, experiment):
        print_line(f"cloudrc: warning: {changes}", sys.stderr)
    in_cluster, for_programs = mode == "cluster", options.output != "table"
    # First prepare the flight: if that fails, no folder must be left.
    if in_cluster:
        flight = _cluster_flight(experiment, options, sys.stderr if for_programs else sys.stdout)
    else:
        flight = _local_flight(experiment, mode, ready, options)
    folder = run_folder(experiment, "session" if ready else mode, options.out)
    if not for_programs:
        facts = f"mode {mode}, seed {experiment.seed}, link {experiment.link.profile}"
        flown = "session" if ready else experiment.mission.contents
        print_or_drop(escape(f"{experiment.name}: {facts}, {flown}"))
    with _place_of_recording(folder):
        report = flight(folder)
    print_traceback(options, report)
    last = "report.html" if options.report == "page" else "report.json"
    print_result(options.output, report, summary(report, folder, last))
    return 0 if ready else exit_code(report)


@contextlib.contextmanager
def _place_of_recording(folder: Path) -> Iterator[None]:
    """Say where the recording is if the flight inside the `with` block fails or is interrupted."""
    try:
        yield
    except (CloudrcError, KeyboardInterrupt) as error:
        nothing = isinstance(error, NothingFlownError)  # the regular end of a session by a signal
        if isinstance(error, BadInputError) and is_interrupted() and not nothing:
            error = KeyboardInterrupt()  # a library has converted the exception
        if any(folder.glob("*.mcap*")):
            text = f"the recording is in {folder}"
            if isinstance(error, KeyboardInterrupt):
                text += f"; to write its report: cloudrc report {quote(str(folder))}"
            print_line(text, sys.stderr)
        raise error


def _local_flight(
    experiment: ResolvedExperiment,
    mode: str,
    ready: Ready | None,
    options: argparse.Namespace,
) -> Flight:
    """Return a function that flies on this machine and shows the progress.

    With `ready`, the function flies a session, in which teleop waits for missions. It calls `ready`
    when all processes are ready.
    """
    from cloudrc.cli.progress import FlightView
    from cloudrc.runs.fly import fly

    def flight(folder: Path) -> dict[str, Any]:
        with contextlib.ExitStack() as stack:
            mission = experiment.mission
            counted = (0, "waypoint") if ready else (mission.count, mission.unit)
            view = FlightView(*counted, events=options.output == "table")
            stack.enter_context(contextlib.closing(view))

            def landed() -> None:
                if is_interrupted():
                    text = "interrupted: writes the report; Ctrl-C again leaves it out"
                    view.say(
                        "the session ends; Ctrl-C again leaves its report out" if ready else text
                    )
                view.tell("writes the report")

            session = partial(ready, folder, view.say, stack) if ready else None
            return fly(
                experiment,
                mode,
                folder,
                view.see,
                page=options.report == "page",
                figures=options.figures,
                session=session,
                beside=options.beside,
                landed=landed,
            )

    return flight


def _cluster_flight(
    experiment: ResolvedExperiment, options: argparse.Namespace, stream: TextIO
) -> Flight:
    from cloudrc.cluster.flight import check_can_begin, fly_in_cluster
    from cloudrc.cluster.own_files import check_experiment

    check_experiment(experiment)
    release = release_from_flags(options)
    check_can_begin(release)

    def tell(text: str) -> None:
        print_line(f"  {text}", stream)

    def flight(folder: Path) -> dict[str, Any]:
        try:
            return fly_in_cluster(
                experiment,
                folder,
                release,
                options.timeout,
                tell,
                page=options.report == "page",
                figures=options.figures,
            )
        finally:
            if options.out is None and folder.exists():
                point_to(folder, "latest")

    return flight
