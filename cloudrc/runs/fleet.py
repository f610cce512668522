"""Fly a fleet in virtual time: build its robots, its cell and its shared cloud, and judge each.

The folder of a fleet has a folder for each robot, `robot-0` and so on, with all that a run has but
its page; `cell.csv`, what the cell did; and the report of the fleet.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from cloudrc import assembly
from cloudrc.cloud.sharing import SharedCompute
from cloudrc.config.load import robots_of
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.drivers.fleet import CellQueue, FleetRun, Member, SharedCores
from cloudrc.drivers.virtual import Sink
from cloudrc.errors import machine_error
from cloudrc.link.cell import FRAME_NS, Bulk, Cell, Video
from cloudrc.record.columns import Recording
from cloudrc.records import Record
from cloudrc.report.document import Run, write_json
from cloudrc.report.fleet import CellLog, FleetFlown, RobotFlown, fleet_document
from cloudrc.report.write import write_report
from cloudrc.runs.fly import See, VirtualRecorder
from cloudrc.runs.interrupts import raise_if_interrupted
from cloudrc.runs.own_files import hash_files


def fly_fleet(
    experiment: ResolvedExperiment,
    folder: Path,
    see: See = lambda records: None,
    *,
    page: bool = True,
    landed: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Fly a fleet in virtual time; write all files into `folder`, and return the fleet's report.

    `see`, `page` and `landed` are those of `runs.fly.fly`.
    """
    try:
        return _fly(experiment, folder, see, landed, page=page)
    except OSError as error:
        error.filename = str(error.filename or folder)
        raise machine_error(error) or error from error


def _fly(
    experiment: ResolvedExperiment,
    folder: Path,
    see: See,
    landed: Callable[[], None],
    *,
    page: bool,
) -> dict[str, Any]:
    """Do as `fly_fleet`; let an OSError pass."""
    (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
    robots, interrupted = robots_of(experiment), False
    files = [hash_files(robot) for robot in robots]  # now: the user may edit them during the flight
    folders = [folder / f"robot-{robot.fleet.only}" for robot in robots]

    def look(records: list[Record]) -> None:
        raise_if_interrupted()
        see(records)

    with ExitStack() as stack:
        recorders = list[VirtualRecorder]()
        for robot, own in zip(robots, folders, strict=True):
            own.mkdir()
            (own / "config.yaml").write_text(dump(robot), encoding="utf-8")
            recorders.append(stack.enter_context(VirtualRecorder(robot, own, look)))
        fleet = assemble_fleet(experiment, robots, [each.sink for each in recorders])
        log = CellLog(fleet.cells)
        try:
            fleet.run.fly(log.take)
        except KeyboardInterrupt:
            interrupted = True
        landed()
        flown = list[RobotFlown]()
        for own, recorder, hashes in zip(folders, recorders, files, strict=True):
            report = partial(_report, own, hashes, flown)
            recorder.finish(report, interrupted=interrupted)
    if fleet.cells:
        (folder / "cell.csv").write_text(log.as_csv(), encoding="utf-8")
    result = FleetFlown(experiment, flown, log, fleet.cores, fleet.run.now_ns)
    document = fleet_document(result)
    write_json(folder / "report.json", document)
    if page:
        from cloudrc.report.fleet_page import write_fleet_page

        write_fleet_page(folder, result, document)
    return document


def _report(
    folder: Path,
    files: dict[str, str],
    flown: list[RobotFlown],
    recording: Recording,
    robot: ResolvedExperiment,
    run: Run,
) -> dict[str, Any]:
    """Write the report of a robot into `folder`, and add what the fleet's needs to `flown`."""
    run, own = replace(run, files=files), robot.report.metrics
    document = write_report(folder, recording, robot, run, own=own, page=False)
    flown.append(RobotFlown.of(recording, robot, document))
    return document


@dataclass(frozen=True, slots=True)
class Fleet:
    """A fleet that is ready to fly in virtual time."""

    run: FleetRun
    cells: Sequence[Cell]  # of uplink and downlink, or one for both; empty without a cell
    cores: SharedCores | None


def assemble_fleet(
    experiment: ResolvedExperiment, robots: Sequence[ResolvedExperiment], sinks: Sequence[Sink]
) -> Fleet:
    """Build the robots of a fleet and connect them; each of `sinks` gets the records of a robot."""
    cells, cloud = build_cells(experiment), experiment.cloud
    cores = SharedCores(cloud.cores, cloud.sharing) if cloud.cores else None
    members, shortest_ns = list[Member](), list[int]()
    for number, (robot, sink) in enumerate(zip(robots, sinks, strict=True)):
        members.append(_build(number, robot, sink, cells, is_shared=cores is not None))
        shortest_ns += (link.shortest_ns for link in assembly.build_links(robot))
    return Fleet(FleetRun(members, cells, cores, min(shortest_ns)), cells, cores)


def _build(
    number: int, robot: ResolvedExperiment, sink: Sink, cells: Sequence[Cell], *, is_shared: bool
) -> Member:
    orders = robot.uplink.keep_order, robot.downlink.keep_order
    own = assembly.build_compute_time(robot) if is_shared else None
    compute = None if own is None else SharedCompute(own)
    queue = partial(CellQueue, number, (*cells, *cells)[:2], orders) if cells else None
    _, cloud, teleop, run = assembly.assemble(robot, queue=queue, compute=compute)
    if compute is not None:
        compute.now_ns = lambda: run.now_ns
        compute.finish = lambda now_ns: cloud.finish(run.cloud_clock.at(now_ns))

    def see(from_world: list[Record], from_cloud: list[Record]) -> None:
        sink(from_world, run.on_world_clock(from_cloud))

    limit_ns = round(assembly.flight_limit(robot) * 1e9)
    return Member(run, compute, lambda: teleop.over, limit_ns, see)


def build_cells(experiment: ResolvedExperiment) -> list[Cell]:
    """Build the cell of each direction, or one for both, with the traffic of others."""
    given = experiment.cell
    if given.rate_kbit is None:
        return []
    rate, airtime_ns = given.rate_kbit * 1e3, round(given.airtime_us * 1e3)
    cells = [
        Cell(rate, given.queue, given.queue_packets, airtime_ns)
        for _ in range(1 if given.shared else 2)
    ]
    for number, each in enumerate(given.traffic):
        flow, cell = -1 - number, cells[-1 if each.direction == "downlink" else 0]
        start_ns = int(assembly.generator(experiment.seed, f"traffic {number}").integers(FRAME_NS))
        if each.kind == "video":
            cell.traffic[flow] = Video(flow, each.rate_kbit * 1e3, start_ns)
        else:
            cell.traffic[flow] = Bulk(flow, start_ns)
    return cells
