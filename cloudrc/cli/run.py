"""`cloudrc run`: fly an experiment, write a recording and a report, and print the verdict."""

from __future__ import annotations

import argparse
import contextlib
import heapq
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from math import inf
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from cloudrc.advice import advise
from cloudrc.cli.cluster_flags import (
    DEFAULT_RELEASE,
    release_arguments,
    release_from_flags,
    timeout_argument,
)
from cloudrc.cli.extras import MODES, require
from cloudrc.cli.find_run import RUNS
from cloudrc.cli.output import (
    escape,
    is_live,
    output_argument,
    print_line,
    print_or_drop,
    print_result,
)
from cloudrc.cli.parser import read_count, whole_number
from cloudrc.cli.report import print_traceback, summary
from cloudrc.errors import BadInputError, CloudrcError, InterruptedRunError, machine_error
from cloudrc.runs.interrupts import interrupt_on_signals, is_interrupted, raise_if_interrupted

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.record.columns import Recording
    from cloudrc.records import Record
    from cloudrc.report.document import Run

Flight = Callable[[Path], dict[str, Any]]
"""Function that flies, writes all files of the run into a folder, and returns the report."""
See = Callable[["list[Record]"], None]
"""Function that displays records during the flight."""
Ready = Callable[[Path, Callable[[str], None], contextlib.ExitStack, str, dict[str, str]], None]
"""Function that a session calls when it is ready. Arguments: the run's folder, a function that
prints a line, a stack that closes at the end, the API's URL, process -> HOST:PORT of metrics."""

ADVISED_MAX = 50
"""Number of points of a sweep for which warnings are looked for."""
WARNINGS_MAX = 3
"""Largest number of warnings that are printed about more than two experiments."""
NO_C = "Python (wind, a robot that differs from its model, or one without steps in C)"
"""Where the physics steps run if the C code does not cover the experiment."""
EPILOG = """\
modes:
  local    real time: five processes, UDP on 127.0.0.1
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
    many = parser.add_mutually_exclusive_group()
    experiment_arguments(parser, many)
    about = "where to fly (default: local; with --seeds: virtual)"
    parser.add_argument("--mode", choices=MODES, help=about)
    about = "fly seeds 1 to N on all cores and print a table"
    many.add_argument("--seeds", type=read_count, metavar="N", help=about)
    output_argument(parser, "json, yaml: print only the report")
    release_arguments(parser, DEFAULT_RELEASE)
    timeout_argument(parser)


def experiment_arguments(parser: argparse.ArgumentParser, seed: argparse._ActionsContainer) -> None:
    """Declare the arguments that choose an experiment, with `--seed` in the group `seed`."""
    add = parser.add_argument
    about = "name of a shipped experiment, or a YAML file (default: paper)"
    add("experiment", nargs="?", default="paper", metavar="EXPERIMENT", help=about)
    about = "random seed of this run (default: the experiment's)"
    seed.add_argument("--seed", type=whole_number(0, 2**53 - 1), metavar="S", help=about)
    about = "change one key of the experiment; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    add("--out", type=Path, metavar="DIR", help="folder of the run (default: a new one in runs/)")


def execute(options: argparse.Namespace) -> int:
    """Fly once, or once per seed with `--seeds`; return the exit code."""
    interrupt_on_signals()  # an interrupted flight still gets its report
    mode = options.mode or ("virtual" if options.seeds else "local")
    if options.seeds and mode != "virtual":
        raise BadInputError(f"--seeds flies in virtual time; leave out --mode {mode}")
    require(f"mode {mode}", MODES[mode])
    if options.seeds:
        from cloudrc.cli.sweep_run import fly_seeds

        return fly_seeds(options)
    return fly_once(options, mode)


def load(name: str, overrides: Iterable[str], seed: int | None = None) -> ResolvedExperiment:
    """Load an experiment by name or path with `overrides` (KEY=VALUE); check `report.metrics`."""
    from cloudrc import metrics
    from cloudrc.config.load import load_experiment

    seeds = [] if seed is None else [f"seed={seed}"]
    experiment = load_experiment(name, [*overrides, *seeds])
    metrics.check(experiment.report.metrics)
    return experiment


def warn(*experiments: ResolvedExperiment) -> None:
    """Print the warnings of `advise` on stderr, each once.

    For three or more experiments, such as the points of a sweep, print at most `WARNINGS_MAX`. Of
    many experiments, only the first, the last and some between them are looked at, because each
    takes some milliseconds: together about `ADVISED_MAX`.
    """
    some = dict.fromkeys(range(0, len(experiments), len(experiments) // ADVISED_MAX + 1))
    some[len(experiments) - 1] = None
    advice = list(dict.fromkeys(text for index in some for text in advise(experiments[index])))
    if len(experiments) > 2 and len(advice) > WARNINGS_MAX:
        advice[WARNINGS_MAX:] = [f"{len(advice)} warnings; the others are alike"]
    for text in advice:
        print_line(f"cloudrc: warning: {text}", sys.stderr)


def refuse_seed(texts: Iterable[str]) -> None:
    """Raise a BadInputError if one of the settings `texts` (KEY=VALUE) sets the seed.

    Commands with --seeds replace the seed in every flight.
    """
    from cloudrc.config.overrides import parse_settings

    if ("seed",) in parse_settings(texts):
        raise BadInputError("seed: each flight has its own seed; give their number with --seeds")


def fly_once(options: argparse.Namespace, mode: str, ready: Ready | None = None) -> int:
    """Fly as `options` say, print the summary, and return the exit code.

    With `ready`, fly a session of any number of missions; `ready` is called when the session waits
    for missions.
    """
    from cloudrc.metrics.verdict import exit_code

    experiment = load(options.experiment, options.set, options.seed)
    if mode != "virtual" and (experiment.cloud.clock_offset_s or experiment.cloud.clock_drift_ppm):
        raise BadInputError(
            "cloud.clock_offset_s and cloud.clock_drift_ppm act in virtual time only, elsewhere "
            "the machine's clock counts; use --mode virtual, or leave them out"
        )
    warn(experiment)
    in_cluster, for_programs = mode == "cluster", options.output != "table"
    stream = sys.stderr if for_programs else sys.stdout
    count = experiment.mission.count
    # First prepare the flight: if that fails, no folder must be left.
    if in_cluster:
        flight = _cluster_flight(experiment, options, stream)
    else:
        flight = _local_flight(experiment, mode, stream, 0 if ready else count, ready)
    name = f"{experiment.name}-{'session' if ready else mode}-seed{experiment.seed}"
    folder = new_folder(options.out, name, "" if in_cluster else "latest")
    if not for_programs:
        facts = f"mode {mode}, seed {experiment.seed}, link {experiment.link.profile}"
        flown = "session" if ready else "1 waypoint" if count == 1 else f"{count} waypoints"
        print_or_drop(escape(f"{experiment.name}: {facts}, {flown}"))
    try:
        report = flight(folder)
    except (CloudrcError, KeyboardInterrupt) as error:
        if isinstance(error, BadInputError) and is_interrupted():
            error = KeyboardInterrupt()  # a library has converted the exception
        if in_cluster:  # the folder stays empty until the mission has flown
            with contextlib.suppress(OSError):
                folder.rmdir()
        if folder.exists():
            text = f"the recording is in {folder}"
            if isinstance(error, KeyboardInterrupt):
                text += f"; 'cloudrc report {folder}' writes its report"
            print_line(text, sys.stderr)
        raise error
    finally:
        if in_cluster and options.out is None and folder.exists():
            point_to(folder, "latest")
    print_traceback(options, report)
    print_result(options.output, report, summary(report, folder))
    return 0 if ready else exit_code(report)


def new_folder(out: Path | None, name: str, link: str = "latest") -> Path:
    """Make the folder of a run: `out`, or the next free `runs/<name>-<n>`.

    Without `out`, point the symbolic link `runs/<link>` to the new folder; "" for no link. Raise a
    BadInputError if `out` exists and is not an empty folder, or if no folder can be made.
    """
    if out is not None and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise BadInputError(
            f"--out {out}: already exists; name a new folder, runs are never overwritten"
        )
    try:
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
            return out
        RUNS.mkdir(exist_ok=True)
        for n in itertools.count(1):
            folder = RUNS / f"{name}-{n}"
            with contextlib.suppress(FileExistsError):  # another process may make it first
                folder.mkdir()
                break
    except OSError as error:
        where = f"--out {out}" if out else f"{RUNS}/ in the working folder"
        text = f"{where}: cannot be made: {error.strerror}; name a writable folder with --out"
        raise BadInputError(text) from error
    if link:
        point_to(folder, link)
    return folder


def point_to(folder: Path, link: str) -> None:
    """Let the symbolic link `link`, beside `folder`, point to `folder`; ignore a failure."""
    latest = folder.parent / link
    with contextlib.suppress(OSError):
        if latest.is_symlink():
            latest.unlink()
        latest.symlink_to(folder.name, target_is_directory=True)


def _local_flight(
    experiment: ResolvedExperiment, mode: str, stream: TextIO, waypoints: int, ready: Ready | None
) -> Flight:
    """Return a function that flies on this machine and shows the progress on `stream`.

    With `ready`, the function flies a session, in which teleop waits for missions. It calls `ready`
    when all processes are ready. Raise a BadInputError if robot and scene of the user do not fit.
    """
    from cloudrc.cli.progress import FlightView

    world = experiment.world
    if "/" in world.robot or world.scene.endswith(".xml"):
        from cloudrc.robots.build import check_robot

        check_robot(world)

    def flight(folder: Path) -> dict[str, Any]:
        if stream is sys.stderr and not is_live(stream):
            return fly(experiment, mode, folder)
        with contextlib.ExitStack() as stack:
            view = stack.enter_context(contextlib.closing(FlightView(stream, waypoints)))
            session = partial(ready, folder, view.say, stack) if ready else None
            return fly(experiment, mode, folder, view.see, session=session)

    return flight


def _cluster_flight(
    experiment: ResolvedExperiment, options: argparse.Namespace, stream: TextIO
) -> Flight:
    from cloudrc.cli.client import Api, settle_mission
    from cloudrc.cluster.client import program
    from cloudrc.cluster.flight import fly_in_cluster, refuse_local_files, refuse_second_flight

    refuse_local_files(experiment)
    release = release_from_flags(options)
    for name in ("helm", "kubectl"):
        program(name)
    refuse_second_flight(release, lambda url, token: Api(url, lambda: token).get("/v1/state"))

    def tell(text: str) -> None:
        print_line(f"  {text}", stream)

    return lambda folder: fly_in_cluster(
        experiment, folder, release, options.timeout, tell, settle_mission
    )


def fly(
    experiment: ResolvedExperiment,
    mode: str,
    folder: Path,
    see: See = lambda records: None,
    *,
    page: bool = True,
    session: Callable[[str, dict[str, str]], None] | None = None,
) -> dict[str, Any]:
    """Fly in mode "virtual" or "local"; write all files into `folder`, and return the report.

    During the flight `see` is called with new records; in local mode some are left out. An
    interrupted flight also gets a report. Without `page`, write no report.html.

    With `session`, teleop waits for missions, and the report is that of the last one. When all
    processes are ready, `session` gets the API's address and process -> HOST:PORT of its metrics.
    """
    from cloudrc.config.load import dump
    from cloudrc.report.write import write_report

    record = _record_virtual if mode == "virtual" else partial(_record_local, session=session)
    own = experiment.report.metrics
    try:
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        with record(experiment, folder, see) as flown:
            return write_report(folder, *flown, own=own, page=page)
    except OSError as error:
        error.filename = str(error.filename or folder)
        raise machine_error(error) or error from error


@contextlib.contextmanager
def _record_virtual(
    experiment: ResolvedExperiment, folder: Path, see: See
) -> Iterator[tuple[Recording, ResolvedExperiment, Run]]:
    """Fly in virtual time, and yield the recording, the experiment and facts about the run.

    The caller writes the report in the `with` block. After the block, this function attaches a copy
    of the report to mission.mcap.
    """
    from cloudrc import assembly
    from cloudrc.record.columns import Recording, RecordStore
    from cloudrc.record.writer import CODE, McapWriter
    from cloudrc.report.document import Run
    from cloudrc.report.views import views
    from cloudrc.report.write import attachments
    from cloudrc.robots.pelican.native.robot import usable
    from cloudrc.source import code_hash

    store, interrupted, see = RecordStore(), False, _interruptible(see)
    # Record during the flight, so that the recording is kept if the run or its report fails.
    with McapWriter(folder / "mission.mcap", clock="world", code=code_hash()) as writer:
        at_start = attachments(folder)  # the experiment, also for a copy that is cut short
        for name, data in at_start.items():
            writer.attach(name, data)

        def sink(from_world: list[Record], from_cloud: list[Record]) -> None:
            writer.write(heapq.merge(from_world, from_cloud, key=attrgetter("stamp_ns")))
            store.add(from_world, from_cloud)
            see(from_cloud)
            see(from_world)

        try:
            assembly.fly(experiment, sink)
        except KeyboardInterrupt:
            interrupted = True
        try:
            steps = _where_steps_run(experiment, usable().text)
            run = Run("virtual", "virtual", interrupted, assembly.virtual_notes(experiment), steps)
            writer.note(run.metadata)
            recording = Recording(records=store, metadata={CODE: code_hash()})
            writer.write_views(views(recording, experiment))
            yield recording, experiment, run
        finally:
            for name, data in attachments(folder).items() - at_start.items():
                writer.attach(name, data)


def _where_steps_run(experiment: ResolvedExperiment, machine: str) -> str:
    """Say where the usual physics steps run; `machine` says where they run if they can be in C."""
    from cloudrc.robots.build import runs_in_c

    return machine if runs_in_c(experiment.world) else NO_C


def _prepare(experiment: ResolvedExperiment, folder: Path) -> None:
    """Write the link's profile into the run's `folder`."""
    from cloudrc.cli.link_run import prepare_link
    from cloudrc.drivers.local import LINK_FOLDER

    prepare_link(folder / LINK_FOLDER, experiment)


def _interruptible(see: See) -> See:
    """Return a function that first looks for a signal: a library may have caught the exception."""

    def look(records: list[Record]) -> None:
        raise_if_interrupted()
        see(records)

    return look


@contextlib.contextmanager
def _record_local(
    experiment: ResolvedExperiment,
    folder: Path,
    see: See,
    session: Callable[[str, dict[str, str]], None] | None = None,
) -> Iterator[tuple[Recording, ResolvedExperiment, Run]]:
    """Fly in real time; yield the merged recording, the experiment and facts about the run.

    With `session`, as in `fly`, yield those of the session's last mission.
    """
    from cloudrc.assembly import flight_limit
    from cloudrc.cli.session import read_last_mission
    from cloudrc.drivers.local import LocalRun
    from cloudrc.record.merge import merge
    from cloudrc.report.document import Run
    from cloudrc.report.views import views
    from cloudrc.report.write import attachments
    from cloudrc.robots.pelican.native.library import library

    _prepare(experiment, folder)
    local = LocalRun(folder, _interruptible(see), session=session)
    broken, interrupted = None, True
    try:
        local.fly(inf if session else flight_limit(experiment))
        interrupted = False
    except KeyboardInterrupt:
        pass
    except CloudrcError as error:
        broken = error
    try:
        if session:
            mission, experiment, interrupted = read_last_mission(folder)
        else:
            mission = merge(folder / "world.mcap", folder / "cloud.mcap")
    except CloudrcError:
        if broken or (interrupted and not session):
            raise broken or InterruptedRunError("interrupted, nothing was recorded") from None
        raise
    notes = (*local.notes, *([str(broken)] if broken else ()))
    steps = _where_steps_run(experiment, library().text)
    run = Run("local", "relay", interrupted, notes, steps)
    mission.metadata |= run.metadata
    try:
        mission.views = views(mission, experiment)
        yield mission, experiment, run
    finally:
        mission.write(folder / "mission.mcap", attachments(folder))
        local.announcement.close()
    if broken:
        raise broken
