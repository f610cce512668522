# SPDX-License-Identifier: Apache-2.0

"""`cloudrc run`: fly an experiment, write a recording and a report, and print the verdict."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from shlex import quote, split
from shutil import which
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import BadInputError, CloudrcError
from cloudrc.base.requirements import MODES, require
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import (
    output_argument,
    paint,
    print_line,
    print_or_drop,
    print_result,
    tell,
    warn,
)
from cloudrc.doors.cli.parser import Arguments, Options, Parser, read_count, read_seed, set_argument
from cloudrc.doors.cli.report import print_traceback, report_arguments, summary
from cloudrc.doors.cli.where import (
    DEFAULT_RELEASE,
    release_arguments,
    release_from_flags,
    timeout_argument,
)
from cloudrc.flight.folder import point_to, run_folder
from cloudrc.flight.interrupts import is_interrupted

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release
    from cloudrc.config.resolved import ResolvedExperiment

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
  cloudrc run steps --mode local --set fleet.robots=3 --set cell.rate_kbit=1000
  cloudrc run --mode cluster --context kind-cloudrc -n demo --release demo
  cloudrc run runs/latest/config.yaml --mode virtual     the same run again

'cloudrc list' shows the names of experiments, profiles and plug-ins. The last
line of the output is the path of the report."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    many = parser.add_mutually_exclusive_group()
    experiment_arguments(parser, many)
    about = "where to fly (default: local; with --seeds or a fleet: virtual)"
    parser.add_argument("--mode", choices=MODES, help=about)
    about = "fly seeds 1 to N on all cores and print a table"
    many.add_argument("--seeds", type=read_count, metavar="N", help=about)
    about = "start this program with the flight, and end it with it: a remote controller"
    parser.add_argument("--with", dest="beside", default="", metavar="CMD", help=about)
    report_arguments(parser)
    output_argument(parser, "json, yaml: print only the report")
    release_arguments(parser, DEFAULT_RELEASE)
    timeout_argument(parser)


def experiment_arguments(parser: Parser, seed: Arguments) -> None:
    """Declare the arguments that choose an experiment, with `--seed` in the group `seed`."""
    about = "name of a shipped experiment, or a YAML file (default: paper)"
    parser.add_argument("experiment", nargs="?", default="paper", metavar="EXPERIMENT", help=about)
    about = "random seed of this run (default: the experiment's)"
    seed.add_argument("--seed", type=read_seed, metavar="S", help=about)
    set_argument(parser)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the run (default: a new one in runs/)"
    )


def execute(options: Options) -> int:
    """Fly once, or once per seed with `--seeds`; return the exit code."""
    mode = options.mode or ("virtual" if options.seeds else "local")
    if options.seeds and (mode != "virtual" or options.figures or options.beside):
        text = "flies in virtual time, many flights; leave out --mode, --figures and --with"
        raise BadInputError(f"--seeds {text}")
    if options.beside:
        _check_beside(options.beside, mode)
    is_drawn = options.report == "page" or options.figures
    require(f"mode {mode}", [each for each in MODES[mode] if is_drawn or each != "report"])
    if options.seeds:
        from cloudrc.doors.cli.sweep_run import fly_seeds

        return fly_seeds(options)
    return fly_once(options, mode)


def _check_beside(command: str, mode: str) -> None:
    if mode == "cluster":
        raise BadInputError("--with starts a program for a flight here; leave out --mode cluster")
    try:
        words = split(command)
    except ValueError as error:
        raise BadInputError(f"--with '{command}': no command: {error}") from None
    if not words or which(words[0]) is None:
        raise BadInputError(f"--with '{command}': there is no such program here")


def fly_once(options: Options, mode: str, ready: Ready | None = None) -> int:
    """Fly as `options` say, print the summary, and return the exit code.

    With `ready`, fly a session of any number of missions; `ready` is called when the session waits
    for missions.
    """
    from cloudrc.flight.experiment import check_mode
    from cloudrc.results.metrics.verdict import exit_code

    experiment = _experiment(options, is_session=ready is not None)
    if experiment.is_fleet:
        return _fly_fleet(experiment, options, is_session=ready is not None)
    check_mode(experiment, mode)
    _warn(options, experiment, experiment)
    # First: if there is no cluster, no folder must be left.
    release = _checked_release(experiment, options) if mode == "cluster" else None
    folder = run_folder(experiment, "session" if ready else mode, options.out)
    flown = "session" if ready else experiment.mission.contents
    _announce(options, experiment, mode, flown)
    with _place_of_recording(folder):
        if release:
            report = _fly_in_cluster(experiment, folder, release, options)
        else:
            report = _fly_here(experiment, folder, mode, ready, options)
    print_traceback(options, report)
    last = "report.html" if options.report == "page" else "report.json"
    print_result(options.output, report, summary(report, folder, last))
    _advise(report)
    return 0 if ready else exit_code(report)


def _advise(report: Mapping[str, Any]) -> None:
    """Say in the last line what to do if the machine was too slow for a flight in real time."""
    from cloudrc.results.metrics.verdict import ADVICE

    codes = [failure["code"] for failure in report["failures"]]
    for robot in report.get("robots", ()):
        codes += robot.get("codes", ())
    if "not_real_time" in codes:
        tell(f"the flight did not keep real time: {ADVICE}, or fly with --mode virtual")


def _warn(options: Options, experiment: ResolvedExperiment, *flights: ResolvedExperiment) -> None:
    """Warn about the settings of flights, and about own files that have changed since a flight."""
    from cloudrc.flight.own_files import describe_changes

    warn(*flights)
    fleet = experiment.fleet
    if fleet.only is None and len(fleet.vary) > fleet.robots:
        numbers = f"{len(fleet.vary)} entries for {fleet.robots} robots"
        tell(f"warning: fleet.vary has {numbers}, so the last ones are not used")
    if changes := describe_changes(options.experiment, experiment):
        tell(f"warning: {changes}")


def _announce(options: Options, experiment: ResolvedExperiment, mode: str, flown: str) -> None:
    """Print what flies and how, for people."""
    if options.output == "table":
        facts = f"mode {mode}, seed {experiment.seed}, {experiment.network}"
        print_or_drop(escape(f"{experiment.name}: {facts}, {flown}"))


def _experiment(options: Options, *, is_session: bool) -> ResolvedExperiment:
    """Return the experiment that `options` name.

    The missions of a session come later. Its scene thus needs no body that the experiment's own
    mission touches.
    """
    from cloudrc.flight.experiment import load

    try:
        return load(options.experiment, options.set, options.seed, fleets=True)
    except BadInputError:
        if not is_session:
            raise
    return load(options.experiment, ["mission.touch=null", *options.set], options.seed)


def _fly_fleet(experiment: ResolvedExperiment, options: Options, *, is_session: bool) -> int:
    """Fly a fleet, print the summary, and return the exit code."""
    from cloudrc.config.overrides import OUTSIDE
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.flight.experiment import check_carried, check_mode, robots_of
    from cloudrc.flight.fleet import fly_fleet
    from cloudrc.results.metrics.verdict import exit_code
    from cloudrc.results.report.fleet import summarize_fleet

    mode = "local" if is_session else options.mode or "virtual"
    beside = options.beside or experiment.cloud.controller.name in OUTSIDE
    if beside or is_session or mode == "cluster" or options.figures:
        text = "a fleet flies with 'cloudrc run' here, without --figures and a controller outside"
        raise BadInputError(f"{text}; fleet.only=0 is its robot 0 alone")
    load = check_carried(experiment) if mode == "local" else ""
    robots = robots_of(experiment, options.experiment, options.set, options.seed)
    for robot in robots:
        check_mode(robot, mode)
    _warn(options, experiment, *robots)
    folder, page = run_folder(experiment, mode, options.out), options.report == "page"
    cell, count = experiment.cell, f"{len(robots)} robot{'s' * (len(robots) > 1)}"
    place = f" in a cell of {cell.rate_kbit:g} kbit/s ({cell.queue})" if cell.rate_kbit else ""
    flown = f"{count}{place}, {experiment.mission.contents}{load}"
    _announce(options, experiment, mode, flown)
    with Progress("flies the fleet") as view:
        judging = partial(view.tell, "judges each robot")
        report = fly_fleet(experiment, robots, mode, folder, page=page, landed=judging)
    last = folder / ("report.html" if page else "report.json")
    text = f"\n{summarize_fleet(report, paint)}\n\n{escape(str(last))}"
    print_result(options.output, report, text)
    _advise(report)
    return exit_code(report)


@contextlib.contextmanager
def _place_of_recording(folder: Path) -> Iterator[None]:
    """Say where the recording is if the flight inside the `with` block fails or is interrupted."""
    try:
        yield
    except (CloudrcError, KeyboardInterrupt):
        if any(folder.glob("*.mcap*")):
            shown = quote(str(folder))
            tell(f"the recording is in {shown}; to write its report: cloudrc report {shown}")
        raise


def _fly_here(
    experiment: ResolvedExperiment,
    folder: Path,
    mode: str,
    ready: Ready | None,
    options: Options,
) -> dict[str, Any]:
    """Fly on this machine, and show the progress; return the report.

    With `ready`, fly a session, in which teleop waits for missions. Call `ready` when all processes
    are ready.
    """
    from cloudrc.doors.cli.progress import FlightView
    from cloudrc.flight.fly import fly

    mission = experiment.mission
    counted = (0, "waypoint") if ready else (mission.count, mission.unit)
    with (
        FlightView(*counted, events=options.output == "table") as view,
        contextlib.ExitStack() as stack,
    ):

        def landed() -> None:
            if is_interrupted():
                view.say("interrupted: writes the report; Ctrl-C again leaves it out")
            view.tell("writes the report")

        return fly(
            experiment,
            mode,
            folder,
            view.see,
            page=options.report == "page",
            figures=options.figures,
            session=partial(ready, folder, view.say, stack) if ready else None,
            beside=options.beside,
            landed=landed,
        )


def _checked_release(experiment: ResolvedExperiment, options: Options) -> Release:
    """Return the release that the flags name; check that it can fly the experiment."""
    from cloudrc.cluster.flight import check_can_begin
    from cloudrc.cluster.own_files import check_experiment

    check_experiment(experiment)
    release = release_from_flags(options)
    check_can_begin(release)
    return release


def _fly_in_cluster(
    experiment: ResolvedExperiment, folder: Path, release: Release, options: Options
) -> dict[str, Any]:
    from cloudrc.cluster.flight import fly_in_cluster

    stream = sys.stdout if options.output == "table" else sys.stderr
    try:
        return fly_in_cluster(
            experiment,
            folder,
            release,
            options.timeout,
            lambda text: print_line(f"  {text}", stream),
            page=options.report == "page",
            figures=options.figures,
        )
    finally:
        if options.out is None and folder.exists():
            point_to(folder, "latest")
