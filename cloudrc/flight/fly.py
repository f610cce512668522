# SPDX-License-Identifier: Apache-2.0

"""Fly an experiment, record the flight, and write the report.

A run is a folder: the experiment as config.yaml, the recording as mission.mcap, and the report.
"""

from __future__ import annotations

import contextlib
import heapq
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from math import inf
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

from cloudrc.base import source
from cloudrc.base.errors import (
    CloudrcError,
    ControllerLostError,
    InterruptedRunError,
    machine_error,
)
from cloudrc.config.faults import CLOUD_KILLED, acting
from cloudrc.config.overrides import OUTSIDE, REMOTE
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.flight.assembly.cloud import lost_controller
from cloudrc.flight.assembly.plan import flight_limit
from cloudrc.flight.assembly.sensing import describe_camera
from cloudrc.flight.interrupts import raise_if_interrupted
from cloudrc.flight.local.companion import companion
from cloudrc.flight.local.places import LINK_FOLDER
from cloudrc.flight.local.supervisor import LocalRun
from cloudrc.flight.own_files import hash_files
from cloudrc.flight.session import read_last_mission
from cloudrc.flight.virtual.flight import fly_virtual, virtual_notes
from cloudrc.link.follow import make_folder
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.record.merge import merge
from cloudrc.results.record.writer import CODE, McapWriter
from cloudrc.results.report.document import Run
from cloudrc.results.report.views import views
from cloudrc.results.report.write import attachments, write_report
from cloudrc.wire.records import Record

See: TypeAlias = Callable[[list[Record]], None]
"""Function that gets records during the flight."""
Session: TypeAlias = Callable[[str, dict[str, str]], None]
"""Function that a session calls when it is ready, with the API's address, and process -> HOST:PORT
of its metrics."""
Report: TypeAlias = Callable[[Recording, ResolvedExperiment, Run], dict[str, Any]]
"""Function that writes and returns the report of a recorded flight."""


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
    with naming_files(folder):
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        files = hash_files(experiment)  # now: the user may edit them during the flight

        def look(records: list[Record]) -> None:
            raise_if_interrupted()  # a library may have caught the exception
            see(records)

        def report(recording: Recording, flown: ResolvedExperiment, run: Run) -> dict[str, Any]:
            own, run = experiment.report.metrics, replace(run, files=files)
            return write_report(folder, recording, flown, run, own=own, page=page, figures=figures)

        with _beside(beside, experiment, folder) as gone:
            if mode == "virtual":
                return _fly_virtual(experiment, folder, look, gone, landed, report)
            return _fly_local(experiment, folder, look, gone, landed, report, session)


@contextlib.contextmanager
def naming_files(folder: Path) -> Iterator[None]:
    """Let an OSError of the `with` block name its file, or else `folder`."""
    try:
        yield
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


class VirtualRecorder:
    """Records a flight in virtual time, and writes its report; mission.mcap gets a copy of it.

    The recording is kept if the run or its report fails; a copy cut short has the experiment.
    """

    def __init__(self, experiment: ResolvedExperiment, folder: Path, see: See) -> None:
        """Begin the recording in `folder`, which has the experiment; `see` is that of `fly`."""
        from cloudrc.results.report.shapes import flown_files

        self._experiment, self.folder, self._see = experiment, folder, see
        self._store, self._code = RecordStore(), source.code_hash()
        self._at_start = attachments(folder) | flown_files(experiment.world)
        self._writer = McapWriter(folder / "mission.mcap", clock="world", code=self._code)

    def __enter__(self) -> Self:
        """Attach the experiment."""
        self._writer.__enter__()
        for name, data in self._at_start.items():
            self._writer.attach(name, data)
        return self

    def __exit__(self, *error: Any) -> None:
        """Close the file."""
        self._writer.__exit__(*error)

    def sink(self, from_world: list[Record], from_cloud: list[Record]) -> None:
        """Take new records of world and cloud."""
        records = [*heapq.merge(from_world, from_cloud, key=attrgetter("stamp_ns"))]
        self._writer.write(records)
        self._store.add(from_world, from_cloud)
        self._see(records)

    def finish(
        self, report: Report, *, interrupted: bool, lost: ControllerLostError | None = None
    ) -> dict[str, Any]:
        """Return the report of the flight; `lost` is the reason why it ended early."""
        experiment, writer = self._experiment, self._writer
        try:
            notes = virtual_notes(experiment)
            run = _describe("virtual", interrupted, experiment, notes, lost)
            writer.note(run.metadata)
            store, self._store = self._store, RecordStore()  # many robots need much memory
            recording = Recording(
                records=store, metadata={CODE: self._code}, attachments=self._at_start
            )
            writer.write_views(views(recording, experiment))
            _raise_if_refused(recording, lost)
            return report(recording, experiment, run)
        finally:
            for name, data in attachments(self.folder).items() - self._at_start.items():
                writer.attach(name, data)


def _fly_virtual(
    experiment: ResolvedExperiment,
    folder: Path,
    see: See,
    gone: Callable[[], bool],
    landed: Callable[[], None],
    report: Report,
) -> dict[str, Any]:
    """Fly in virtual time, and return the report.

    `gone` is that of `fly_virtual`, `landed` that of `fly`.
    """
    interrupted, lost = False, None
    with VirtualRecorder(experiment, folder, see) as recorder:
        try:
            fly_virtual(experiment, recorder.sink, gone=gone)
        except KeyboardInterrupt:
            interrupted = True
        except ControllerLostError as error:
            lost = error
        landed()
        document = recorder.finish(report, interrupted=interrupted, lost=lost)
    if lost:
        raise lost
    return document


def _describe(
    mode: Literal["virtual", "local"],
    interrupted: bool,
    experiment: ResolvedExperiment,
    notes: Iterable[str],
    error: CloudrcError | None,
) -> Run:
    """Return facts about a run; `error` is the reason why the flight ended early."""
    from cloudrc.robots.build import describe_steps

    every = (*notes, *([str(error)] if error else ()))
    shaper = "relay" if mode == "local" else mode
    steps, camera = describe_steps(experiment.world), describe_camera(experiment)
    return Run(mode, shaper, interrupted, every, steps, camera)


def _raise_if_lost(records: list[Record]) -> None:
    """Raise the error with which a flight ends if a controller outside is lost."""
    for error in lost_controller(records):
        raise error


def _raise_if_refused(recording: Recording, error: CloudrcError | None) -> None:
    """Raise `error` if a controller outside was lost before a command of it was flown."""
    if isinstance(error, ControllerLostError) and not recording["/cmd_vel"]["command"].any():
        raise error


def _fly_local(
    experiment: ResolvedExperiment,
    folder: Path,
    see: See,
    gone: Callable[[], bool],
    landed: Callable[[], None],
    report: Report,
    session: Session | None,
) -> dict[str, Any]:
    """Fly in real time, and return the report; mission.mcap is the merged recording.

    With `session`, the report is that of its last mission. The other functions are those of `fly`.
    """
    make_folder(folder / LINK_FOLDER, experiment.link_values)
    remote = experiment.cloud.controller.name in OUTSIDE
    faults = experiment.faults
    local = LocalRun(
        folder, see, session, remote=remote, lost=_raise_if_lost, gone=gone, faults=faults
    )
    limit = inf if session else flight_limit(experiment)
    broken, interrupted = end_of(lambda: local.fly(limit))
    landed()
    with explaining(broken, interrupted=interrupted and not session):
        if session:
            mission, experiment, interrupted = read_last_mission(folder)
        else:
            killed = bool(acting(experiment.faults, CLOUD_KILLED))
            mission = merge(folder / "world.mcap", folder / "cloud.mcap", killed=killed)
    try:
        document = write_merged(
            folder, mission, experiment, report, local.notes, interrupted=interrupted, broken=broken
        )
    finally:
        local.announcement.close()
    if broken:
        raise broken
    return document


def end_of(fly: Callable[[], None]) -> tuple[CloudrcError | None, bool]:
    """Fly; return the error that ended the flight, if any, and whether it was cut short."""
    try:
        fly()
    except KeyboardInterrupt:
        return None, True
    except CloudrcError as error:
        return error, True
    return None, False


@contextmanager
def explaining(broken: CloudrcError | None, *, interrupted: bool) -> Iterator[None]:
    """Let an error of the block, which reads a flight cut short, say what ended the flight."""
    try:
        yield
    except CloudrcError:
        if broken or interrupted:
            raise broken or InterruptedRunError("interrupted, nothing was recorded") from None
        raise


def write_merged(
    folder: Path,
    mission: Recording,
    experiment: ResolvedExperiment,
    report: Report,
    notes: Iterable[str],
    *,
    interrupted: bool,
    broken: CloudrcError | None,
) -> dict[str, Any]:
    """Write mission.mcap, the merged recording of a flight in real time, and return its report.

    `broken` is the reason why the flight ended early.
    """
    run = _describe("local", interrupted, experiment, notes, broken)
    mission.metadata |= run.metadata
    try:
        mission.views = views(mission, experiment)
        _raise_if_refused(mission, broken)
        return report(mission, experiment, run)
    finally:
        mission.write(folder / "mission.mcap", attachments(folder))
