# SPDX-License-Identifier: Apache-2.0

"""Find where in the schedule of its link a flight begins."""

from __future__ import annotations

from cloudrc.base.errors import CloudrcError
from cloudrc.config.profile import DIRECTIONS
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.start import begin
from cloudrc.link.traces import link_profile


def find_ways(
    experiment: ResolvedExperiment,
) -> tuple[DirectionProfile, DirectionProfile, int]:
    """Return the conditions of uplink and downlink, and where their schedules begin [ns].

    A fleet is at one place at one time, so the link of each of its robots begins there, too.
    """
    ways = link_profile(experiment.uplink), link_profile(experiment.downlink)
    return begin(ways, experiment.link.start_s, experiment.seed)


def link_start(experiment: ResolvedExperiment) -> float | None:
    """Return where the schedule of the link begins [s]; None if a file for it is lost."""
    start = experiment.link.start_s
    if not isinstance(start, str):
        return start or 0.0
    try:
        return find_ways(experiment)[-1] / 1e9
    except CloudrcError:
        return None


def describe_one_schedule(seeds: int, *experiments: ResolvedExperiment) -> str:
    """Say that flights with several seeds meet one part of the schedule; "" if they do not."""
    for experiment in experiments:
        link = experiment.link
        repeats = any(getattr(link, way).may_repeat for way in DIRECTIONS)
        if seeds > 1 and repeats and link.start_s is None:
            return f"{seeds} seeds, one link schedule: --set link.start_s=random"
    return ""
