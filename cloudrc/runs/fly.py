"""Fly an experiment, record the flight, and write the report.

A run is a folder: the experiment as config.yaml, the recording as mission.mcap, and the report.
"""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Callable, Iterator
from dataclasses import replace
from math import inf
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc import assembly, source
from cloudrc.config.overrides import OUTSIDE, REMOTE
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.drivers.companion import companion
from cloudrc.drivers.local import LINK_FOLDER, LocalRun
from cloudrc.errors import CloudrcError, ControllerLostError, InterruptedRunError, machine_error
from cloudrc.link.follow import make_folder
from cloudrc.record.columns import Recording, RecordStore
from cloudrc.record.merge import merge
from cloudrc.record.writer import CODE, McapWriter
from cloudrc.records import CONTROLLER_LOST, Record
from cloudrc.report.document import Run
from cloudrc.report.views import views
from cloudrc.report.write import attachments, write_report
from cloudrc.runs.interrupts import raise_if_interrupted
from cloudrc.runs.own_files import hash_files
from cloudrc.runs.session import read_last_mission

See: TypeAlias = Callable[[list[Record]], None]
"""Function that gets records during the flight."""
Session: TypeAlias = Callable[[str, dict[str, str]], None]
"""Function that a session calls when it is ready, with the API's address, and process -> HOST:PORT
of its metrics."""


def fly(
    experiment: ResolvedExperiment,
    mode: str,
    folder: Path,
    see: See = lambda records: None,
    *,
    page: bool = True,
    figures: bool = False,
    session: Session | None = None,
    beside: str = "",
    landed: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Fly in mode "virtual" or "local"; write all files into `folder`, and return the report.

    During the flight `see` is called with new records; in local mode some are left out. An
    interrupted flight also gets a report, but not one whose controller outside never gave a
    command. With `page`, write report.html; with `figures`, write the files in figures/.

    With `session`, teleop waits for missions, and the report is that of the last one. When all
    processes are ready, `session` gets the API's address and process -> HOST:PORT of its metrics.

    `beside` is a command: a program that runs during the flight, such as a remote controller.
    `landed` is called once the flight is over, before the report is written.
    """
    own = experiment.report.metrics
    try:
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        files = hash_files(experiment)  # now: the user may edit them during the flight
        with contextlib.ExitStack() as stack:
            gone = stack.enter_context(_beside(beside, experiment, folder))
            if mode == "virtual":
                flown = _record_virtual(experiment, folder, see, gone, landed)
            else:
                flown = _record_local(experiment, folder, see, gone, landed, session=session)
            recording, resolved, run = stack.enter_context(flown)
            if _is_refused(recording):
                return {}  # the end of the block raises the error
            run = replace(run, files=files)
            return write_report(
                folder, recording, resolved, run, own=own, page=page, figures=figures
            )
    except OSError as error:
        error.filename = str(error.filename or folder)
        raise machine_error(error) or error from error


def _beside(
    command: str, experiment: ResolvedExperiment, folder: Path
) -> contextlib.AbstractContextManager[Callable[[], bool]]:
    """Run `command` during the flight; wait until it listens if it is the remote controller.

    The context is a function that returns whether the program has ended.
    """
    if not command:
        return contextlib.nullcontext(lambda: False)
    controller = experiment.cloud.controller
    url = str((controller.model_extra or {})["url"]) if controller.name == REMOTE else ""
    return companion(command, folder, url)


def _raise_if_lost(records: list[Record]) -> None:
    """Raise the error with which a flight ends if a controller outside is lost."""
    for error in assembly.lost_controller(records):
        raise error


def _is_refused(recording: Recording) -> bool:
    """Return whether a controller outside was lost before a command of it was flown."""
    lost = {*CONTROLLER_LOST} & {*recording["/fault"]["code"]}
    return bool(lost) and not recording["/cmd_vel"]["command"].any()


def _interruptible(see: See) -> See:
    """Return a function that first looks for a signal: a library may have caught the exception."""

    def look(records: list[Record]) -> None:
        raise_if_interrupted()
        see(records)

    return look


@contextlib.contextmanager
def _record_virtual(
    experiment: ResolvedExperiment,
    folder: Path,
    see: See,
    gone: Callable[[], bool],
    landed: Callable[[], None],
) -> Iterator[tuple[Recording, ResolvedExperiment, Run]]:
    """Fly in virtual time, and yield the recording, the experiment and facts about the run.

    `gone` is that of `assembly.fly`, `landed` that of `fly`. The caller writes the report in the
    `with` block. After the block, this function attaches a copy of the report to mission.mcap.
    """
    from cloudrc.robots.build import describe_steps
    from cloudrc.robots.shapes import flown_files

    store, interrupted, see = RecordStore(), False, _interruptible(see)
    lost: ControllerLostError | None = None
    code = source.code_hash()
    # The recording is kept if the run or its report fails; a copy cut short has the experiment.
    with McapWriter(folder / "mission.mcap", clock="world", code=code) as writer:
        at_start = attachments(folder) | flown_files(experiment.world)
        for name, data in at_start.items():
            writer.attach(name, data)

        def sink(from_world: list[Record], from_cloud: list[Record]) -> None:
            records = [*heapq.merge(from_world, from_cloud, key=attrgetter("stamp_ns"))]
            writer.write(records)
            store.add(from_world, from_cloud)
            see(records)

        try:
            assembly.fly(experiment, sink, gone=gone)
        except KeyboardInterrupt:
            interrupted = True
        except ControllerLostError as error:
            lost = error
        landed()
        try:
            steps = describe_steps(experiment.world)
            notes = (*assembly.virtual_notes(experiment), *([str(lost)] if lost else ()))
            run = Run("virtual", "virtual", interrupted, notes, steps)
            writer.note(run.metadata)
            recording = Recording(records=store, metadata={CODE: code}, attachments=at_start)
            writer.write_views(views(recording, experiment))
            yield recording, experiment, run
        finally:
            for name, data in attachments(folder).items() - at_start.items():
                writer.attach(name, data)
    if lost:
        raise lost


@contextlib.contextmanager
def _record_local(
    experiment: ResolvedExperiment,
    folder: Path,
    see: See,
    gone: Callable[[], bool],
    landed: Callable[[], None],
    session: Session | None = None,
) -> Iterator[tuple[Recording, ResolvedExperiment, Run]]:
    """Fly in real time; yield the merged recording, the experiment and facts about the run.

    With `session`, as in `fly`, yield those of its last mission. `gone` is that of `LocalRun`,
    `landed` that of `fly`.
    """
    from cloudrc.robots.build import describe_steps

    make_folder(folder / LINK_FOLDER, experiment.link_values)
    see, remote = _interruptible(see), experiment.cloud.controller.name in OUTSIDE
    local = LocalRun(folder, see, session, remote=remote, lost=_raise_if_lost, gone=gone)
    broken, interrupted = None, True
    try:
        local.fly(inf if session else assembly.flight_limit(experiment))
        interrupted = False
    except KeyboardInterrupt:
        pass
    except CloudrcError as error:
        broken = error
    landed()
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
    steps = describe_steps(experiment.world)
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
