# SPDX-License-Identifier: Apache-2.0

"""Fly a fleet: build its robots, its cell and its shared cloud, and judge each.

The folder of a fleet has a folder for each robot, `robot-0` and so on, with all that a run has but
its page; `cell.csv`, what the cell did; and the report of the fleet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base.errors import CloudrcError
from cloudrc.base.files import read_json, write_json
from cloudrc.base.text import csv_table
from cloudrc.cloud.sharing import SharedCompute
from cloudrc.config.load import read_experiment
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.flight.assembly.cloud import build_compute_time
from cloudrc.flight.assembly.link import build_cells
from cloudrc.flight.assembly.plan import flight_limit
from cloudrc.flight.fly import (
    Report,
    VirtualRecorder,
    end_of,
    explaining,
    naming_files,
    write_merged,
)
from cloudrc.flight.interrupts import raise_if_interrupted
from cloudrc.flight.local.fleet import CELL_FILE, LocalFleet
from cloudrc.flight.local.places import LINK_FOLDER
from cloudrc.flight.own_files import hash_files
from cloudrc.flight.virtual.fleet import Computation, FleetRun, Member, SharedCores
from cloudrc.flight.virtual.flight import assemble
from cloudrc.flight.virtual.run import Sink
from cloudrc.link.cell import Cell, CellQueue
from cloudrc.link.follow import make_folder
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.merge import cut_to_last_mission, merge
from cloudrc.results.report.document import ENVIRONMENT_FILE, Run, environment_document
from cloudrc.results.report.fleet import FleetFlown, fleet_document
from cloudrc.results.report.folder import ROBOT, read_cell, robots_in
from cloudrc.results.report.write import write_report
from cloudrc.wire.records import Record

AFTER_NS = 200_000_000
"""Time after its mission for which a robot is recorded [ns]; it flies on until all are over."""


class _Robot(NamedTuple):
    """A robot of a fleet, its folder, and what writes its report there."""

    experiment: ResolvedExperiment
    folder: Path
    report: Report


def fly_fleet(
    experiment: ResolvedExperiment,
    robots: Sequence[ResolvedExperiment],
    mode: str,
    folder: Path,
    *,
    page: bool = True,
    landed: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Fly a fleet in mode "virtual" or "local"; write all files into `folder`.

    Return the fleet's report. `page` and `landed` are those of `flight.fly.fly`.
    """
    flown, members = FleetFlown(experiment, mode), list[_Robot]()
    with naming_files(folder):
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        for robot in robots:
            own = folder / f"{ROBOT}{robot.fleet.only}"
            own.mkdir()
            (own / "config.yaml").write_text(dump(robot), encoding="utf-8")
            # The hashes now: the user may edit the files during the flight.
            members.append(_Robot(robot, own, partial(_report, flown, own, hash_files(robot))))
        environment = environment_document(files=hash_files(experiment))
        write_json(folder / ENVIRONMENT_FILE, environment)
        fly = _fly_virtual if mode == "virtual" else _fly_local
        broken = fly(flown, members, folder, landed)
        document = write_fleet(folder, flown, page=page)
    if broken:
        raise broken
    return document


def _report(
    flown: FleetFlown,
    folder: Path,
    files: dict[str, str],
    recording: Recording,
    robot: ResolvedExperiment,
    run: Run,
) -> dict[str, Any]:
    """Write the report of a robot into `folder`, and add what the fleet's needs to `flown`."""
    run, own = replace(run, files=files), robot.report.metrics
    document = write_report(folder, recording, robot, run, own=own, page=False)
    flown.add(recording, robot, document)
    return document


def write_fleet(folder: Path, flown: FleetFlown, *, page: bool) -> dict[str, Any]:
    """Write the report of a fleet and, if wanted, its page; return the report."""
    document = fleet_document(flown)
    write_json(folder / "report.json", document)
    if page:
        from cloudrc.results.report.fleet_page import write_fleet_page

        write_fleet_page(folder, flown, document)
    return document


def write_again(
    folder: Path, write: Callable[[Path], tuple[Recording, ResolvedExperiment, dict[str, Any]]]
) -> dict[str, Any]:
    """Write the report of a fleet again, from the recordings in its `folder`.

    `write` writes the report of a robot, whose folder it gets; it returns the robot's recording,
    experiment and report.
    """
    flown = FleetFlown(read_experiment(folder / "config.yaml", flown=True))
    flown.log = read_cell(folder / CELL_FILE)
    flown.cloud = read_json(folder / "report.json").get("cloud")  # it is recorded nowhere else
    for robot in robots_in(folder):
        recording, experiment, document = write(robot)
        flown.mode = document["mode"]
        flown.add(recording, experiment, document)
    return write_fleet(folder, flown, page=True)


def _fly_virtual(
    flown: FleetFlown, robots: Sequence[_Robot], folder: Path, landed: Callable[[], None]
) -> CloudrcError | None:
    """Fly in virtual time; write recordings and reports; return why the flight ended early."""
    with ExitStack() as stack:
        recorders = [
            stack.enter_context(VirtualRecorder(robot.experiment, robot.folder, _look))
            for robot in robots
        ]
        sinks = [each.sink for each in recorders]
        fleet = assemble_fleet(flown.experiment, [each.experiment for each in robots], sinks)
        broken, interrupted = end_of(fleet.fly)
        landed()
        flown.share(fleet)
        if flown.log:
            rows = [each.row() for each in flown.log]
            (folder / CELL_FILE).write_text(csv_table(rows), encoding="utf-8")
        for robot, recorder in zip(robots, recorders, strict=True):
            recorder.finish(robot.report, interrupted=interrupted)
    return broken


def _look(records: list[Record]) -> None:
    raise_if_interrupted()


def _fly_local(
    flown: FleetFlown, robots: Sequence[_Robot], folder: Path, landed: Callable[[], None]
) -> CloudrcError | None:
    """Fly in real time, as `_fly_virtual`."""
    for robot in robots:
        make_folder(robot.folder / LINK_FOLDER, robot.experiment.link_values)
    folders = {each.experiment.fleet.only or 0: each.folder for each in robots}
    has_cell = flown.experiment.cell.rate_kbit is not None
    local = LocalFleet(folder, folders, _look, cell=has_cell)
    limit = max(flight_limit(robot.experiment) for robot in robots)
    broken, interrupted = end_of(lambda: local.fly(limit))
    landed()
    flown.log = read_cell(folder / CELL_FILE)
    for experiment, own, report in robots:
        with explaining(broken, interrupted=interrupted):
            mission = merge(own / "world.mcap", own / "cloud.mcap")
        cut_to_last_mission(mission, after_ns=AFTER_NS)
        facts = own, mission, experiment, report, local.notes
        write_merged(*facts, interrupted=interrupted, broken=broken)
    return broken


def assemble_fleet(
    experiment: ResolvedExperiment, robots: Sequence[ResolvedExperiment], sinks: Sequence[Sink]
) -> FleetRun:
    """Build the robots of a fleet and connect them; each of `sinks` gets the records of a robot."""
    cells, cloud = build_cells(experiment), experiment.cloud
    computes = any(robot.cloud.compute_ms for robot in robots)
    cores = SharedCores(cloud.cores, cloud.sharing) if cloud.cores and computes else None
    members = [
        _build(number, robot, sink, cells, cores)
        for number, (robot, sink) in enumerate(zip(robots, sinks, strict=True))
    ]
    return FleetRun(members, cells, cores)


def _build(
    number: int,
    robot: ResolvedExperiment,
    sink: Sink,
    cells: Sequence[Cell],
    cores: SharedCores | None,
) -> Member:
    """Connect a robot to the cells and cores that it shares."""
    orders = robot.uplink.keep_order, robot.downlink.keep_order
    queue = partial(CellQueue, number, cells, orders) if cells else None
    compute, own = None, build_compute_time(robot)
    if cores and own:
        compute = SharedCompute(
            own,
            lambda duration_ns: cores.inbox.append(
                Computation(run.now_ns, number, duration_ns, finish)
            ),
        )
        cores.clouds.append(compute)
    _, cloud, teleop, run = assemble(robot, queue=queue, compute=compute)

    def finish(now_ns: int) -> None:
        cloud.finish(run.cloud_clock.at(now_ns))

    def see(from_world: list[Record], from_cloud: list[Record]) -> None:
        sink(from_world, run.on_world_clock(from_cloud))

    limit_ns = round(flight_limit(robot) * 1e9)
    return Member(run, lambda: teleop.over, limit_ns, see)
