# SPDX-License-Identifier: Apache-2.0

"""Build both directions of the link, the cell of a fleet, and when a robot begins."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from cloudrc.config.link_schedule import find_ways
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.assembly.draws import SECOND_NS, generator
from cloudrc.link.cell import FRAME_NS, Bulk, Cell, Video
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DIRECTIONS

if TYPE_CHECKING:
    pass


def build_links(
    experiment: ResolvedExperiment, origin_ns: int = 0
) -> tuple[LinkDirection, LinkDirection]:
    """Build the uplink and the downlink of the link, which come up at `origin_ns` [ns]."""
    up, down, start_ns = find_ways(experiment)
    if experiment.cell.rate_kbit is not None:  # packets get their order behind the cell
        up, down = replace(up, keep_order=False), replace(down, keep_order=False)
    seed, stream = experiment.seed, experiment.stream
    return (
        LinkDirection(up, seed, uplink=True, origin_ns=origin_ns - start_ns, stream=stream),
        LinkDirection(down, seed, uplink=False, origin_ns=origin_ns - start_ns, stream=stream),
    )


def build_cells(experiment: ResolvedExperiment, origin_ns: int = 0) -> list[Cell]:
    """Build the cell of each direction, or one for both, with the traffic of others.

    The traffic begins at `origin_ns` [ns].
    """
    given = experiment.cell
    if given.rate_kbit is None:
        return []
    limits = given.queue, given.queue_packets, round(given.airtime_us * 1e3)
    ways = ["both"] if given.shared else DIRECTIONS
    cells = [Cell(given.rate_kbit * 1e3, *limits, way) for way in ways]
    for flow, each in enumerate(given.traffic, start=-len(given.traffic)):
        start_ns = int(generator(experiment.seed, f"traffic {flow}").integers(FRAME_NS))
        video = Video(flow, each.rate_kbit * 1e3, origin_ns + start_ns)
        source = video if each.kind == "video" else Bulk(flow, origin_ns + start_ns)
        cells[-1 if each.direction == "downlink" else 0].traffic[flow] = source
    return cells


def phase_ns(experiment: ResolvedExperiment) -> int:
    """Return the time at which a robot and its cloud begin [ns]: 0, but for robots of a fleet."""
    if not experiment.stream or experiment.fleet.phase == "equal":
        return 0
    slower = min(experiment.world.odometry_rate_hz, experiment.cloud.command_rate_hz)
    draws = generator(experiment.seed, "phase", experiment.stream)
    return int(draws.integers(SECOND_NS // slower))
