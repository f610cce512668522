"""Fly a fleet in virtual time: build its robots, its cell and its shared cloud, and judge each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from cloudrc import assembly
from cloudrc.cloud.sharing import SharedCompute
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.drivers.fleet import CellQueue, FleetRun, Member, SharedCores
from cloudrc.drivers.virtual import Sink
from cloudrc.link.cell import FRAME_NS, Bulk, Cell, Video
from cloudrc.records import Record


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
