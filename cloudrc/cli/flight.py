"""Fly one experiment on this machine and write its recording and report."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.extras import missing
from cloudrc.errors import CloudrcError, InterruptedRunError

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.record.columns import Recording
    from cloudrc.records import Record
    from cloudrc.report.document import Run

GRACE = 30.0
"""Time after the mission's time limit at which the program ends a flight in any case [s]."""

See = Callable[["list[Record]"], None]
"""Function that shows records of a flight during the flight."""


def fly(
    experiment: ResolvedExperiment, mode: str, folder: Path, see: See, *, page: bool = True
) -> dict[str, Any]:
    """Fly one experiment and fill its run folder.

    Args:
        experiment: Complete and checked.
        mode: "virtual" or "local".
        folder: Empty; gets configuration, recording and report.
        see: Called with records during the flight: all in virtual mode, else a selection.
        page: Whether to write the HTML page with figures; the numbers are always written.

    Returns:
        The content of report.json.

    Raises:
        CloudrcError: If the flight broke off; its recording is kept and reported as interrupted.
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
    """Compile a user's own robot or scene before a process starts, which would die of a bad one."""
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

    If an interrupted run has recorded nothing, raise `failure`.
    """
    from cloudrc.record.hash import messages_sha256
    from cloudrc.record.merge import merge

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


def attachments(folder: Path) -> dict[str, bytes]:
    """Read the attachments of the recording: the configuration and the report."""
    paths = (folder / "config.yaml", folder / "report.json")
    return {path.name: path.read_bytes() for path in paths if path.exists()}
