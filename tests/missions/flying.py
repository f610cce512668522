"""Fly an experiment in virtual time, without files, and judge it."""

from __future__ import annotations

from typing import NamedTuple

from cloudrc import assembly
from cloudrc.cloud.endpoint import CloudEndpoint, CloudIdentity
from cloudrc.config.load import ResolvedExperiment, load_experiment
from cloudrc.drivers.virtual import VirtualRun
from cloudrc.record.columns import Recording
from cloudrc.record.hash import RecordHash
from cloudrc.records import Record
from cloudrc.report.document import Run
from cloudrc.report.write import Assessment, assess
from cloudrc.world.endpoint import WorldEndpoint, WorldIdentity

CLOCK = b"one clock for all"[:16]
LIMIT_NS = 150_000_000_000


class Ends(NamedTuple):
    """Both ends and what joins them."""

    world: WorldEndpoint
    cloud: CloudEndpoint
    run: VirtualRun


def join(experiment: ResolvedExperiment, *, offset_ns: int = 0) -> Ends:
    """Put an experiment together; with an offset the two clocks are not shared."""
    world_clock = b"another clock..." if offset_ns else CLOCK
    world = assembly.build_world(experiment, WorldIdentity(world_clock, b"world".ljust(16)))
    cloud = assembly.build_cloud(
        experiment, CloudIdentity(CLOCK, b"cloud".ljust(16)), lambda: offset_ns
    )
    links = assembly.build_links(experiment)
    return Ends(world, cloud, VirtualRun(world, cloud, *links, cloud_clock_offset_ns=offset_ns))


def records(experiment: ResolvedExperiment, **options: int) -> tuple[list[Record], list[Record]]:
    """Fly; the records of world and of cloud."""
    _, cloud, run = join(experiment, **options)
    of_world: list[Record] = []
    of_cloud: list[Record] = []

    def sink(new_of_world: list[Record], new_of_cloud: list[Record]) -> None:
        of_world.extend(new_of_world)
        of_cloud.extend(new_of_cloud)

    run.fly(lambda: cloud.mission_over, LIMIT_NS, sink)
    return of_world, of_cloud


def fly(name: str, *settings: str) -> Assessment:
    """Fly; numbers and verdict."""
    experiment = load_experiment(name, settings)
    return assess(
        Recording.from_records(*records(experiment)), experiment, Run("virtual", "virtual")
    )


def numbers(assessment: Assessment) -> dict[str, float]:
    """The numbers alone, in their units."""
    return {name: number.value for name, number in assessment.numbers.items()}


def digest(experiment: ResolvedExperiment) -> str:
    """SHA-256 of all records of a flight."""
    digest = RecordHash()
    for each in records(experiment):
        digest.update(each)
    return digest.hexdigest()
