"""`cloudrc run`: fly an experiment, write its run folder and print the verdict."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from cloudrc.cli.cluster_flags import release_arguments, release_from_flags, timeout_argument
from cloudrc.cli.extras import require
from cloudrc.cli.output import (
    format_document,
    ignore_closed_pipe,
    is_live,
    output_argument,
    print_line,
)
from cloudrc.cli.parser import read_count
from cloudrc.cli.pool import interrupt_on_signals
from cloudrc.errors import BadInputError, CloudrcError

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.records import Record

Flight = Callable[[Path, TextIO, int], dict[str, Any]]
"""Function that flies: (folder to fill, stream for its progress, number of waypoints) -> report."""

MODES = ("local", "virtual", "cluster")
EXTRAS = {
    "local": ("world", "record", "report"),
    "virtual": ("world", "record", "report"),
    "cluster": ("kube", "record", "report"),
}
"""The extras that each mode needs."""
EPILOG = """\
modes:
  local    real time: four processes, UDP on 127.0.0.1
  virtual  one process, virtual time: the same flight in seconds, repeatable
  cluster  Kubernetes: installs the chart, flies by a Job, fetches the recording

examples:
  cloudrc run
  cloudrc run paper --mode virtual --set link.profile=satellite
  cloudrc run steps --seeds 10 --set cloud.predictor=last_sample
  cloudrc run my.yaml --mode virtual --set cloud.predictor=./my_predictor.py
  cloudrc run --mode cluster --context kind-cloudrc -n demo --release demo
  cloudrc run runs/latest/config.yaml --mode virtual     the same run again

'cloudrc list' shows the names of experiments, profiles and plug-ins. The last
line of the output is the path of the report."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "experiment",
        nargs="?",
        default="paper",
        metavar="EXPERIMENT",
        help="name of a shipped experiment, or a YAML file (default: paper)",
    )
    parser.add_argument(
        "--mode", choices=MODES, help="where to fly (default: local; with --seeds: virtual)"
    )
    many = parser.add_mutually_exclusive_group()
    many.add_argument(
        "--seed",
        type=_seed,
        metavar="S",
        help="random seed of this run (default: the experiment's)",
    )
    many.add_argument(
        "--seeds",
        type=read_count,
        metavar="N",
        help="fly seeds 1 to N on all cores and print a table",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change one key of the experiment; repeatable",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the run (default: a new one in runs/)"
    )
    output_argument(parser, "json, yaml: print only the report")
    release_arguments(parser)
    timeout_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Fly once or many times."""
    interrupt_on_signals()  # an interrupted flight still gets its report
    mode = options.mode or ("virtual" if options.seeds else "local")
    if options.seeds and mode != "virtual":
        raise BadInputError(f"--seeds flies in virtual time; leave out --mode {mode}")
    require(f"mode {mode}", EXTRAS[mode])
    overrides = list(options.set)
    if options.seeds:
        from cloudrc.cli import sweep

        return sweep.fly_seeds(options, overrides)
    if options.seed is not None:
        overrides.append(f"seed={options.seed}")
    return _fly_once(options, mode, overrides)


def _fly_once(options: argparse.Namespace, mode: str, overrides: list[str]) -> int:
    from cloudrc import metrics
    from cloudrc.cli.find_run import discard, new_folder, point_latest_to
    from cloudrc.cli.summary import exit_code, show
    from cloudrc.config.load import load_experiment

    experiment = load_experiment(options.experiment, overrides)
    metrics.check(experiment.report.metrics)
    # First prepare the flight: if that fails, no folder must be left.
    flight = _in_cluster(experiment, options) if mode == "cluster" else _here(experiment, mode)
    name = experiment.name
    # A cluster can fail before anything is recorded; the folder is then removed.
    removable = mode == "cluster"
    folder = new_folder(options.out, f"{name}-{mode}-seed{experiment.seed}", latest=not removable)
    for_programs = options.output != "table"
    stream = sys.stderr if for_programs else sys.stdout
    mission = experiment.mission
    waypoints = mission.steps.count if mission.steps else len(mission.waypoints)
    if not for_programs:
        with ignore_closed_pipe(stream):
            print_line(
                f"{name}: mode {mode}, seed {experiment.seed}, link {experiment.link.profile},"
                f" {waypoints} waypoint{'s' if waypoints != 1 else ''}"
            )
    try:
        report = flight(folder, stream, waypoints)
    except (CloudrcError, KeyboardInterrupt):
        if not (removable and discard(folder)):
            print_line(f"the recording is in {folder}", sys.stderr)
        raise
    finally:
        if removable and options.out is None and folder.exists():
            point_latest_to(folder)
    with ignore_closed_pipe(sys.stdout):
        if for_programs:
            document = json.loads((folder / "report.json").read_text())
            print(format_document(document, options.output))
        else:
            show(report, folder)
        sys.stdout.flush()
    return exit_code(report)


def _here(experiment: ResolvedExperiment, mode: str) -> Flight:
    """Prepare a flight on this machine."""

    def flight(folder: Path, stream: TextIO, waypoints: int) -> dict[str, Any]:
        from cloudrc.cli.flight import fly
        from cloudrc.cli.progress import FlightView

        quiet = stream is sys.stderr and not is_live(stream)
        view = None if quiet else FlightView(stream, waypoints)
        try:
            return fly(experiment, mode, folder, view.see if view else _ignore)
        finally:
            if view:
                view.close()

    return flight


def _in_cluster(experiment: ResolvedExperiment, options: argparse.Namespace) -> Flight:
    """Prepare a flight in the cluster that the flags name."""
    from cloudrc.cli.run_cluster import fly_in_cluster, refuse_local_files
    from cloudrc.cluster.tools import program

    refuse_local_files(experiment)
    release = release_from_flags(options)
    for name in ("helm", "kubectl"):
        program(name)

    def flight(folder: Path, stream: TextIO, waypoints: int) -> dict[str, Any]:
        def tell(text: str) -> None:
            print_line(f"  {text}", stream)

        return fly_in_cluster(experiment, folder, release, options.timeout, tell)

    return flight


def _ignore(records: list[Record]) -> None:
    """Show nothing of the flight."""


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number >= 0")
    return int(text)
