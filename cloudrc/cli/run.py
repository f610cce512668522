"""`cloudrc run`: fly an experiment, write its run folder and print the verdict."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from cloudrc.cli.cluster_flags import release_arguments, release_from_flags, timeout_argument
from cloudrc.cli.extras import missing, require
from cloudrc.cli.output import (
    escape,
    format_document,
    is_live,
    output_argument,
    print_line,
    print_or_drop,
)
from cloudrc.cli.parser import read_count
from cloudrc.cli.pool import interrupt_on_signals
from cloudrc.cli.report import exit_code, summary
from cloudrc.errors import BadInputError, CloudrcError, InterruptedRunError

if TYPE_CHECKING:
    from cloudrc.cloud.endpoint import CloudEndpoint
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.virtual import VirtualRun
    from cloudrc.record.columns import Recording
    from cloudrc.records import Record
    from cloudrc.report.document import Run
    from cloudrc.world.endpoint import WorldEndpoint

Flight = Callable[[Path], dict[str, Any]]
"""Function that flies and fills a run folder; it returns the content of report.json."""
See = Callable[["list[Record]"], None]
"""Function that displays records during the flight."""
Write = Callable[["Recording", "Run"], dict[str, Any]]
"""Function that writes the report and returns the content of report.json."""

MODES = ("local", "virtual", "cluster")
EXTRAS = {
    "local": ("world", "record", "report"),
    "virtual": ("world", "record", "report"),
    "cluster": ("kube", "record", "report"),
}
"""Mode -> the extras that it needs."""
GRACE = 30.0
"""Time after the mission's time limit at which the program ends a flight that still runs [s]."""
CLOCK = bytes(16)
"""Identity of the clock that both ends share in virtual time."""
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
    add, many = parser.add_argument, parser.add_mutually_exclusive_group()
    about = "name of a shipped experiment, or a YAML file (default: paper)"
    add("experiment", nargs="?", default="paper", metavar="EXPERIMENT", help=about)
    add("--mode", choices=MODES, help="where to fly (default: local; with --seeds: virtual)")
    about = "random seed of this run (default: the experiment's)"
    many.add_argument("--seed", type=_seed, metavar="S", help=about)
    about = "fly seeds 1 to N on all cores and print a table"
    many.add_argument("--seeds", type=read_count, metavar="N", help=about)
    about = "change one key of the experiment; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    add("--out", type=Path, metavar="DIR", help="folder of the run (default: a new one in runs/)")
    output_argument(parser, "json, yaml: print only the report")
    release_arguments(parser)
    timeout_argument(parser)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number >= 0")
    return int(text)


def execute(options: argparse.Namespace) -> int:
    """Fly once or many times."""
    interrupt_on_signals()  # an interrupted flight still gets its report
    mode = options.mode or ("virtual" if options.seeds else "local")
    if options.seeds and mode != "virtual":
        raise BadInputError(f"--seeds flies in virtual time; leave out --mode {mode}")
    require(f"mode {mode}", EXTRAS[mode])
    if options.seeds:
        from cloudrc.cli import sweep

        return sweep.fly_seeds(options)
    return _fly_once(options, mode)


def _fly_once(options: argparse.Namespace, mode: str) -> int:
    from cloudrc import metrics
    from cloudrc.cli.find_run import discard, new_folder, point_latest_to
    from cloudrc.config.load import load_experiment

    seed = [] if options.seed is None else [f"seed={options.seed}"]
    experiment = load_experiment(options.experiment, [*options.set, *seed])
    metrics.check(experiment.report.metrics)
    in_cluster, for_programs = mode == "cluster", options.output != "table"
    stream = sys.stderr if for_programs else sys.stdout
    mission = experiment.mission
    count = mission.steps.count if mission.steps else len(mission.waypoints)
    # First prepare the flight: if that fails, no folder must be left.
    flight: Flight = partial(_fly_here, experiment, mode, stream, count)
    if in_cluster:
        flight = _cluster_flight(experiment, options, stream)
    # A cluster can fail before anything is recorded; the folder is then removed.
    name = f"{experiment.name}-{mode}-seed{experiment.seed}"
    folder = new_folder(options.out, name, latest=not in_cluster)
    if not for_programs:
        facts = f"mode {mode}, seed {experiment.seed}, link {experiment.link.profile}"
        waypoints = "1 waypoint" if count == 1 else f"{count} waypoints"
        print_or_drop(escape(f"{experiment.name}: {facts}, {waypoints}"))
    try:
        report = flight(folder)
    except (CloudrcError, KeyboardInterrupt) as error:
        if not (in_cluster and discard(folder)):
            unwritten = isinstance(error, KeyboardInterrupt)
            remedy = f"; 'cloudrc report {folder}' writes its report" if unwritten else ""
            print_line(f"the recording is in {folder}{remedy}", sys.stderr)
        raise
    finally:
        if in_cluster and options.out is None and folder.exists():
            point_latest_to(folder)
    text = format_document(report, options.output) if for_programs else summary(report, folder)
    print_or_drop(text)
    return exit_code(report)


def _fly_here(
    experiment: ResolvedExperiment, mode: str, stream: TextIO, waypoints: int, folder: Path
) -> dict[str, Any]:
    """Fly on this machine, and show the progress on a stream."""
    from cloudrc.cli.progress import FlightView

    if stream is sys.stderr and not is_live(stream):
        return fly(experiment, mode, folder)
    with closing(FlightView(stream, waypoints)) as view:
        return fly(experiment, mode, folder, view.see)


def _cluster_flight(
    experiment: ResolvedExperiment, options: argparse.Namespace, stream: TextIO
) -> Flight:
    """Return the function that flies in the cluster that the flags name."""
    from cloudrc.cluster.client import program
    from cloudrc.cluster.flight import fly_in_cluster, refuse_local_files

    refuse_local_files(experiment)
    release = release_from_flags(options)
    for name in ("helm", "kubectl"):
        program(name)

    def tell(text: str) -> None:
        print_line(f"  {text}", stream)

    return lambda folder: fly_in_cluster(experiment, folder, release, options.timeout, tell)


def _ignore(records: list[Record]) -> None:
    """Show nothing of the flight."""


def fly(
    experiment: ResolvedExperiment,
    mode: str,
    folder: Path,
    see: See = _ignore,
    *,
    page: bool = True,
) -> dict[str, Any]:
    """Fly one experiment in mode "virtual" or "local", and fill its empty run folder.

    Args:
        experiment: The experiment, complete and checked.
        mode: Where to fly.
        folder: Receives configuration, recording and report.
        see: Called with records during the flight: with all in virtual mode, with a selection in
            local mode.
        page: Whether to write the HTML page with figures; the numbers are always written.

    Returns:
        The content of report.json.

    Raises:
        CloudrcError: If the flight broke off. The recording stays; its report says "interrupted".
    """
    from cloudrc.config.load import dump
    from cloudrc.report.write import write_report

    def write(recording: Recording, run: Run) -> dict[str, Any]:
        own = experiment.report.metrics
        return write_report(folder, recording, experiment, run, own=own, page=page)

    fly_mode = _fly_virtual if mode == "virtual" else _fly_local
    try:
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        return fly_mode(experiment, folder, see, write)
    except OSError as error:
        where = error.filename or folder
        raise CloudrcError(
            f"{where}: {error.strerror or error}; free some space or choose another folder: --out"
        ) from error


def assemble(
    experiment: ResolvedExperiment,
) -> tuple[WorldEndpoint, CloudEndpoint, VirtualRun]:
    """Assemble both ends and their run in virtual time."""
    from cloudrc import assembly
    from cloudrc.drivers.virtual import VirtualRun
    from cloudrc.tunnel.end import Identity

    world = assembly.build_world(experiment, Identity(CLOCK, b"world".ljust(16)))
    cloud = assembly.build_cloud(experiment, Identity(CLOCK, b"cloud".ljust(16)))
    return world, cloud, VirtualRun(world, cloud, *assembly.build_links(experiment))


def _fly_virtual(
    experiment: ResolvedExperiment, folder: Path, see: See, write: Write
) -> dict[str, Any]:
    from cloudrc.record.columns import Recording, merged
    from cloudrc.record.hash import RecordHash
    from cloudrc.record.writer import McapWriter
    from cloudrc.report.document import Run
    from cloudrc.report.write import attachments

    records: tuple[list[Record], list[Record]] = ([], [])
    digest = RecordHash()
    # Record during the flight, so that the recording is kept if the run or its report fails.
    with McapWriter(folder / "mission.mcap", clock="world") as writer:

        def sink(from_world: list[Record], from_cloud: list[Record]) -> None:
            for log_time_ns, row in merged(from_world, from_cloud):
                writer.write_row(row, log_time_ns)
            records[0].extend(from_world)
            records[1].extend(from_cloud)
            for new in (from_cloud, from_world):
                digest.update(new)
                see(new)

        interrupted = False
        try:
            _, cloud, flight = assemble(experiment)
            limit_ns = round((experiment.criteria.time_limit_s + GRACE) * 1e9)
            flight.fly(lambda: cloud.mission_over, limit_ns, sink)
        except KeyboardInterrupt:
            interrupted = True
        run = Run("virtual", "virtual", digest.hexdigest(), interrupted)
        try:
            return write(Recording.from_records(*records), run)
        finally:
            for name, data in attachments(folder).items():
                writer.attach(name, data)


def _fly_local(
    experiment: ResolvedExperiment, folder: Path, see: See, write: Write
) -> dict[str, Any]:
    from cloudrc.drivers.local import LocalRun
    from cloudrc.record.hash import messages_sha256
    from cloudrc.record.merge import merge
    from cloudrc.report.document import Run
    from cloudrc.report.write import attachments

    absent = missing("api")
    if absent:
        print(
            f"cloudrc: no operator's API in this run: {', '.join(absent)} not installed; "
            "run: pip install 'cloudrc[api]'",
            file=sys.stderr,
        )
    _check_own_models(experiment)
    local = LocalRun(folder, see, api=not absent)
    broken: CloudrcError | None = None
    interrupted = True
    try:
        local.fly(experiment.criteria.time_limit_s + GRACE)
        interrupted = False
    except KeyboardInterrupt:
        pass
    except CloudrcError as error:
        broken = error
    try:
        mission = merge(folder / "world.mcap", folder / "cloud.mcap")
    except CloudrcError:
        if not interrupted:
            raise
        raise broken or InterruptedRunError("interrupted, nothing was recorded") from None
    digest = messages_sha256(mission.messages)
    notes = (*local.notes, *([str(broken)] if broken else ()))
    run = Run("local", "relay", digest, interrupted, notes)
    try:
        document = write(mission.recording(), run)
    finally:
        mission.write(folder / "mission.mcap", attachments(folder))
    if broken is not None:
        raise broken
    return document


def _check_own_models(experiment: ResolvedExperiment) -> None:
    """Compile the user's own robot and scene before the processes start.

    Otherwise an invalid model would end a process of the flight.
    """
    world = experiment.world
    if world.robot.endswith(".xml") or world.scene.endswith(".xml"):
        from cloudrc.world.scene import compile_model

        compile_model(world.robot, world.scene)
