"""`cloudrc run`: fly an experiment, write its run folder and print the verdict."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from cloudrc.cli.cluster_flags import release_arguments, release_from_flags, timeout_argument
from cloudrc.cli.extras import missing, require
from cloudrc.cli.output import (
    escape,
    format_document,
    ignore_closed_pipe,
    is_live,
    output_argument,
    paint,
    print_line,
    table,
)
from cloudrc.cli.parser import read_count
from cloudrc.cli.pool import interrupt_on_signals
from cloudrc.errors import BadInputError, CloudrcError, InterruptedRunError

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.record.columns import Recording
    from cloudrc.records import Record
    from cloudrc.report.document import Run

Flight = Callable[[Path, TextIO, int], dict[str, Any]]
"""Function that flies: (run folder, stream for the progress, number of waypoints) -> report."""

MODES = ("local", "virtual", "cluster")
EXTRAS = {
    "local": ("world", "record", "report"),
    "virtual": ("world", "record", "report"),
    "cluster": ("kube", "record", "report"),
}
"""Mode -> the extras that it needs."""
GRACE = 30.0
"""Time after the mission's time limit at which the program ends a flight that still runs [s]."""

See = Callable[["list[Record]"], None]
"""Function that displays records during the flight."""
COLOURS = {"success": "green", "failure": "red", "invalid": "yellow", "interrupted": "yellow"}

# The most important numbers -> their labels; report.html and report.json show all numbers.
MAIN = {
    "duration": "mission took",
    "contact_time": "arm touches the board at",
    "tip_speed": "with the tip at",
    "steady_contact_force": "and then presses with",
    "min_clearance": "least clearance in the pipes",
    "rtt_mean": "round trip, mean",
    "prediction_error_rms": "prediction error, RMS",
    "hold_count": "times in HOLD",
    "real_time_factor": "real-time factor",
}
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

        return sweep.fly_seeds(options, overrides, fly)
    if options.seed is not None:
        overrides.append(f"seed={options.seed}")
    return _fly_once(options, mode, overrides)


def _fly_once(options: argparse.Namespace, mode: str, overrides: list[str]) -> int:
    from cloudrc import metrics
    from cloudrc.cli.find_run import discard, new_folder, point_latest_to
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
    """Return the function that flies on this machine."""

    def flight(folder: Path, stream: TextIO, waypoints: int) -> dict[str, Any]:
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
    """Return the function that flies in the cluster that the flags name."""
    from cloudrc.cluster.client import program
    from cloudrc.cluster.flight import fly_in_cluster, refuse_local_files

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


def fly(
    experiment: ResolvedExperiment, mode: str, folder: Path, see: See, *, page: bool = True
) -> dict[str, Any]:
    """Fly one experiment and fill its run folder.

    Args:
        experiment: The experiment, complete and checked.
        mode: "virtual" or "local".
        folder: Empty folder; receives configuration, recording and report.
        see: Called with records during the flight: with all in virtual mode, with a selection in
            local mode.
        page: Whether to write the HTML page with figures; the numbers are always written.

    Returns:
        The content of report.json.

    Raises:
        CloudrcError: If the flight broke off. The recording stays, and the report says
            "interrupted".
    """
    from cloudrc.config.load import dump

    fly_mode = _fly_virtual if mode == "virtual" else _fly_local
    try:
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        return fly_mode(experiment, folder, see, page)
    except OSError as error:
        where = error.filename or folder
        raise CloudrcError(
            f"{where}: {error.strerror or error}; free some space or choose another folder: --out"
        ) from error


def _fly_virtual(
    experiment: ResolvedExperiment, folder: Path, see: See, page: bool
) -> dict[str, Any]:
    from cloudrc.record.columns import Recording, merged
    from cloudrc.record.hash import RecordHash
    from cloudrc.record.writer import McapWriter
    from cloudrc.report.document import Run
    from cloudrc.report.write import attachments

    world: list[Record] = []
    cloud: list[Record] = []
    digest = RecordHash()
    # Record during the flight, so that the recording is kept if the run or its report fails.
    with McapWriter(folder / "mission.mcap", clock="world") as writer:

        def sink(from_world: list[Record], from_cloud: list[Record]) -> None:
            for log_time_ns, row in merged(from_world, from_cloud):
                writer.write_row(row, log_time_ns)
            for kept, new in ((cloud, from_cloud), (world, from_world)):
                kept.extend(new)
                digest.update(new)
                see(new)

        interrupted = False
        try:
            _virtual_run(experiment, sink)
        except KeyboardInterrupt:
            interrupted = True
        run = Run("virtual", "virtual", digest.hexdigest(), interrupted)
        recording = Recording.from_records(world, cloud)
        try:
            return _report(folder, recording, experiment, run, page=page)
        finally:
            for name, data in attachments(folder).items():
                writer.attach(name, data)


def _virtual_run(
    experiment: ResolvedExperiment, sink: Callable[[list[Record], list[Record]], None]
) -> None:
    from cloudrc import assembly
    from cloudrc.cloud.endpoint import CloudIdentity
    from cloudrc.drivers.virtual import VirtualRun
    from cloudrc.world.endpoint import WorldIdentity

    clock = bytes(16)  # both ends share one clock
    world = assembly.build_world(experiment, WorldIdentity(clock, b"world".ljust(16)))
    cloud = assembly.build_cloud(experiment, CloudIdentity(clock, b"cloud".ljust(16)))
    limit_ns = round((experiment.criteria.time_limit_s + GRACE) * 1e9)
    run = VirtualRun(world, cloud, *assembly.build_links(experiment))
    run.fly(lambda: cloud.mission_over, limit_ns, sink)


def _fly_local(
    experiment: ResolvedExperiment, folder: Path, see: See, page: bool
) -> dict[str, Any]:
    from cloudrc.drivers.local import LocalRun
    from cloudrc.report.document import Run

    run, failure = Run("local", "relay"), None
    nothing_recorded = InterruptedRunError("interrupted before anything was recorded")
    absent = missing("api")
    if absent:
        print(
            f"cloudrc: no operator's API in this run: {', '.join(absent)} not installed; "
            "run: pip install 'cloudrc[api]'",
            file=sys.stderr,
        )
    check_own_models(experiment)
    local = LocalRun(folder, see, api=not absent)
    try:
        local.fly(experiment.criteria.time_limit_s + GRACE)
    except KeyboardInterrupt:
        run = replace(run, interrupted=True)
    except CloudrcError as error:
        run, failure = replace(run, interrupted=True, notes=(str(error),)), error
    run = replace(run, notes=(*local.notes, *run.notes))
    document = _report_ends(folder, experiment, run, page, failure or nothing_recorded)
    if failure is not None:
        raise failure
    return document


def check_own_models(experiment: ResolvedExperiment) -> None:
    """Compile the user's own robot and scene before the processes start.

    Otherwise an invalid model would end a process of the flight.
    """
    world = experiment.world
    if world.robot.endswith(".xml") or world.scene.endswith(".xml"):
        from cloudrc.world.scene import compile_model

        compile_model(world.robot, world.scene)


def _report_ends(
    folder: Path,
    experiment: ResolvedExperiment,
    run: Run,
    page: bool,
    failure: CloudrcError,
) -> dict[str, Any]:
    """Merge the recordings of both ends and write the report.

    If a run was interrupted and has recorded nothing, raise `failure`.
    """
    from cloudrc.record.hash import messages_sha256
    from cloudrc.record.merge import merge
    from cloudrc.report.write import attachments

    try:
        mission = merge(folder / "world.mcap", folder / "cloud.mcap")
    except CloudrcError as error:  # nothing was recorded
        raise failure if run.interrupted else error from None
    run = replace(run, records_sha256=messages_sha256(mission.contents.messages))
    try:
        return _report(folder, mission.recording(), experiment, run, page=page)
    finally:
        mission.write(folder / "mission.mcap", attachments(folder))


def _report(
    folder: Path, recording: Recording, experiment: ResolvedExperiment, run: Run, *, page: bool
) -> dict[str, Any]:
    from cloudrc.report.write import write_report

    try:
        own = experiment.report.metrics
        return write_report(folder, recording, experiment, run, own=own, page=page)
    except KeyboardInterrupt:
        raise InterruptedRunError(
            f"interrupted; the recording is kept but the report is not written: "
            f"run 'cloudrc report {folder}'"
        ) from None


def exit_code(report: Mapping[str, Any]) -> int:
    """Return the exit code of a report's verdict."""
    from cloudrc.metrics.verdict import EXIT_CODES

    return EXIT_CODES[report["verdict"]]


def show(report: Mapping[str, Any], folder: Path) -> None:
    """Print the verdict, the main numbers and, on the last line, the report's path."""
    print()
    print(verdict(report))
    print()
    print(main_numbers(report))
    faults = report["numbers"].get("fault_count", {"value": 0})["value"]
    if faults:
        print(paint(f"  faults noted in flight: {faults:.0f}, see the report", "yellow"))
    print()
    print_line(str(folder / "report.html"))


def verdict(report: Mapping[str, Any]) -> str:
    """Return the verdict with the first failure, then one line for each further failure."""
    outcome = report["verdict"]
    word = paint(outcome.upper(), COLOURS[outcome])
    failures = report["failures"]
    if not failures:
        return f"{word}: every waypoint reached, every criterion met"
    first, *others = failures
    return "\n".join([f"{word}: {escape(first['text'])}", *map(_further_failure, others)])


def _further_failure(failure: Mapping[str, Any]) -> str:
    time = failure.get("time")
    when = f" (at {time:.2f} s)" if time is not None else ""
    return escape(f"  also: {failure['text']}{when}")


def main_numbers(report: Mapping[str, Any]) -> str:
    """Lay out the main numbers as a table; leave out unknown numbers."""
    numbers = report["numbers"]
    rows = [
        (f"  {label}", *_cells(name, numbers[name]))
        for name, label in MAIN.items()
        if name in numbers
    ]
    return table(rows, right=[1]) if rows else "  no numbers: nothing was flown"


def _cells(name: str, entry: Mapping[str, Any]) -> tuple[str, str]:
    from cloudrc.metrics import Number
    from cloudrc.report.numbers import readable

    return readable(name, Number(entry["value"], entry["unit"], ""))
