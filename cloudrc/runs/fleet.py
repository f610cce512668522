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
from typing import Any

from cloudrc import assembly
from cloudrc.cloud.sharing import SharedCompute
from cloudrc.config.load import read_experiment
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.drivers.fleet import Computation, FleetRun, Member, SharedCores
from cloudrc.drivers.local import LINK_FOLDER
from cloudrc.drivers.local_fleet import CELL_FILE, LocalFleet
from cloudrc.drivers.virtual import Sink
from cloudrc.errors import CloudrcError
from cloudrc.files import read_json, write_json
from cloudrc.link.cell import CellLog, CellQueue
from cloudrc.link.follow import make_folder
from cloudrc.record.columns import Recording
from cloudrc.record.merge import cut_to_last_mission, merge
from cloudrc.records import Record
from cloudrc.report.document import ENVIRONMENT_FILE, Run, environment_document
from cloudrc.report.fleet import FleetFlown, cloud_numbers, fleet_document
from cloudrc.report.folder import ROBOT, read_cell, robots_in
from cloudrc.report.write import write_report
from cloudrc.runs.fly import VirtualRecorder, end_of, explaining, naming_files, write_merged
from cloudrc.runs.interrupts import raise_if_interrupted
from cloudrc.runs.own_files import hash_files
from cloudrc.text import csv_table

AFTER_NS = 200_000_000
"""Time after its mission for which a robot is recorded [ns]; it flies on until all are over."""


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

    Return the fleet's report. `page` and `landed` are those of `runs.fly.fly`.
    """
    with naming_files(folder):
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        for robot in robots:
            _folder(folder, robot).mkdir()
            (_folder(folder, robot) / "config.yaml").write_text(dump(robot), encoding="utf-8")
        files = [*map(hash_files, robots)]  # now: the user may edit them during the flight
        environment = environment_document(files=hash_files(experiment))
        write_json(folder / ENVIRONMENT_FILE, environment)
        fly = _fly_virtual if mode == "virtual" else _fly_local
        flown, broken = fly(experiment, robots, folder, files, landed)
        document = write_fleet(folder, flown, page=page)
    if broken:
        raise broken
    return document


def write_fleet(folder: Path, flown: FleetFlown, *, page: bool) -> dict[str, Any]:
    """Write the report of a fleet and, if wanted, its page; return the report."""
    document = fleet_document(flown)
    write_json(folder / "report.json", document)
    if page:
        from cloudrc.report.fleet_page import write_fleet_page

        write_fleet_page(folder, flown, document)
    return document


def write_again(
    folder: Path, write: Callable[[Path], tuple[Recording, ResolvedExperiment, dict[str, Any]]]
) -> dict[str, Any]:
    """Write the report of a fleet again, from the recordings in its `folder`.

    `write` writes the report of a robot, whose folder it gets; it returns the robot's recording,
    experiment and report.
    """
    cloud = read_json(folder / "report.json").get("cloud")  # it is recorded nowhere else
    flown = FleetFlown(
        read_experiment(folder / "config.yaml", flown=True), read_cell(folder / CELL_FILE), cloud
    )
    for robot in robots_in(folder):
        recording, experiment, document = write(robot)
        flown.mode = document["mode"]
        flown.add(recording, experiment, document)
    return write_fleet(folder, flown, page=True)


def _folder(folder: Path, robot: ResolvedExperiment) -> Path:
    return folder / f"{ROBOT}{robot.fleet.only}"


def _fly_virtual(
    experiment: ResolvedExperiment,
    robots: Sequence[ResolvedExperiment],
    folder: Path,
    files: Sequence[dict[str, str]],
    landed: Callable[[], None],
) -> tuple[FleetFlown, None]:
    """Fly in virtual time; write recording and report of each robot."""

    def see(records: list[Record]) -> None:
        raise_if_interrupted()

    with ExitStack() as stack:
        recorders = [
            stack.enter_context(VirtualRecorder(robot, _folder(folder, robot), see))
            for robot in robots
        ]
        fleet = assemble_fleet(experiment, robots, [each.sink for each in recorders])
        log, interrupted = CellLog(fleet.cells), False
        try:
            fleet.fly(log.take)
        except KeyboardInterrupt:
            interrupted = True
        landed()
        if log.rows:
            (folder / CELL_FILE).write_text(csv_table(log.rows), encoding="utf-8")
        cloud = cloud_numbers(fleet, experiment.cloud.command_rate_hz)
        flown = FleetFlown(experiment, log, cloud)
        for recorder, hashes in zip(recorders, files, strict=True):
            report = partial(_report, flown, recorder.folder, hashes)
            recorder.finish(report, interrupted=interrupted)
    return flown, None


def _fly_local(
    experiment: ResolvedExperiment,
    robots: Sequence[ResolvedExperiment],
    folder: Path,
    files: Sequence[dict[str, str]],
    landed: Callable[[], None],
) -> tuple[FleetFlown, CloudrcError | None]:
    """Fly in real time, as `_fly_virtual`; also return why the flight ended early."""
    folders = {robot.fleet.only or 0: _folder(folder, robot) for robot in robots}
    for robot, own in zip(robots, folders.values(), strict=True):
        make_folder(own / LINK_FOLDER, robot.link_values)
    has_cell = experiment.cell.rate_kbit is not None
    local = LocalFleet(folder, folders, lambda records: raise_if_interrupted(), cell=has_cell)
    limit = max(map(assembly.flight_limit, robots))
    broken, interrupted = end_of(lambda: local.fly(limit))
    landed()
    flown = FleetFlown(experiment, read_cell(folder / CELL_FILE), None, "local")
    for robot, own, hashes in zip(robots, folders.values(), files, strict=True):
        with explaining(broken, interrupted=interrupted):
            mission = merge(own / "world.mcap", own / "cloud.mcap")
        cut_to_last_mission(mission, after_ns=AFTER_NS)
        report = partial(_report, flown, own, hashes)
        write_merged(
            own, mission, robot, report, local.notes, interrupted=interrupted, broken=broken
        )
    return flown, broken


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


def assemble_fleet(
    experiment: ResolvedExperiment, robots: Sequence[ResolvedExperiment], sinks: Sequence[Sink]
) -> FleetRun:
    """Build the robots of a fleet and connect them; each of `sinks` gets the records of a robot."""
    cells, cloud = assembly.build_cells(experiment), experiment.cloud
    computes = any(robot.cloud.compute_ms for robot in robots)
    cores = SharedCores(cloud.cores, cloud.sharing) if cloud.cores and computes else None
    members = list[Member]()
    for number, (robot, sink) in enumerate(zip(robots, sinks, strict=True)):
        orders = robot.uplink.keep_order, robot.downlink.keep_order
        queue = partial(CellQueue, number, (*cells, *cells)[:2], orders) if cells else None
        members.append(_build(number, robot, sink, queue, cores))
    links = [link for robot in robots for link in assembly.build_links(robot)]
    for cell in cells:
        cell.delay_ns = min(link.shortest_ns for link in links)
    return FleetRun(members, cells, cores)


def _build(
    number: int,
    robot: ResolvedExperiment,
    sink: Sink,
    queue: Callable[..., CellQueue] | None,
    cores: SharedCores | None,
) -> Member:
    compute, own = None, assembly.build_compute_time(robot)
    if cores is not None and own is not None:
        compute = SharedCompute(own)
        cores.clouds.append(compute)
        compute.ask = lambda duration_ns: cores.inbox.append(
            Computation(run.now_ns, number, duration_ns, finish)
        )
    _, cloud, teleop, run = assembly.assemble(robot, queue=queue, compute=compute)

    def finish(now_ns: int) -> None:
        cloud.finish(run.cloud_clock.at(now_ns))

    def see(from_world: list[Record], from_cloud: list[Record]) -> None:
        sink(from_world, run.on_world_clock(from_cloud))

    limit_ns = round(assembly.flight_limit(robot) * 1e9)
    return Member(run, lambda: teleop.over, limit_ns, see)
