"""Fly a fleet in virtual time: build its robots, its cell and its shared cloud, and judge each.

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
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.drivers.fleet import Computation, FleetRun, Member, SharedCores
from cloudrc.drivers.virtual import Sink
from cloudrc.link.cell import CellLog, CellQueue
from cloudrc.record.columns import Recording
from cloudrc.records import Record
from cloudrc.report.document import Run, write_json
from cloudrc.report.fleet import FleetFlown, fleet_document
from cloudrc.report.write import write_report
from cloudrc.runs.fly import VirtualRecorder, naming_files
from cloudrc.runs.interrupts import raise_if_interrupted
from cloudrc.runs.own_files import hash_files
from cloudrc.text import csv_table


def fly_fleet(
    experiment: ResolvedExperiment,
    robots: Sequence[ResolvedExperiment],
    folder: Path,
    *,
    page: bool = True,
    landed: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Fly a fleet in virtual time; write all files into `folder`, and return the fleet's report.

    `page` and `landed` are those of `runs.fly.fly`.
    """
    with naming_files(folder), ExitStack() as stack:
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        recorders = [
            stack.enter_context(_record(robot, folder / f"robot-{robot.fleet.only}"))
            for robot in robots
        ]
        files = [*map(hash_files, robots)]  # now: the user may edit them during the flight
        fleet = assemble_fleet(experiment, robots, [each.sink for each in recorders])
        log, interrupted = CellLog(fleet.cells), False
        try:
            fleet.fly(log.take)
        except KeyboardInterrupt:
            interrupted = True
        landed()
        flown = FleetFlown(experiment, log, fleet.cores, fleet.now_ns, [], [])
        for recorder, hashes in zip(recorders, files, strict=True):
            report = partial(_report, flown, recorder.folder, hashes)
            recorder.finish(report, interrupted=interrupted)
        document = fleet_document(flown)
        write_json(folder / "report.json", document)
        if log.rows:
            (folder / "cell.csv").write_text(csv_table(log.rows), encoding="utf-8")
        if page:
            from cloudrc.report.fleet_page import write_fleet_page

            write_fleet_page(folder, flown, document)
    return document


def _record(robot: ResolvedExperiment, folder: Path) -> VirtualRecorder:
    folder.mkdir()
    (folder / "config.yaml").write_text(dump(robot), encoding="utf-8")
    return VirtualRecorder(robot, folder, lambda records: raise_if_interrupted())


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
    cores = SharedCores(cloud.cores, cloud.sharing) if cloud.cores and cloud.compute_ms else None
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
