# SPDX-License-Identifier: Apache-2.0

"""Fly an experiment beside the same experiment without a network, and compare both paths.

Where the setpoint waits for the robot, the cost of control cannot be compared: a badly damped
flight passes its waypoints sooner, and its mission ends earlier.
"""

from __future__ import annotations

from functools import lru_cache

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.schema import Link, MissionConfig
from cloudrc.flight.in_memory import fly_in_memory, or_error, row_of
from cloudrc.flight.trials.rows import Row
from cloudrc.flight.trials.summary import OFF_PATH, TIME_RATIO
from cloudrc.results.metrics.flight import Array
from cloudrc.results.metrics.path import path_of, rms_distance


def setpoint_waits(mission: MissionConfig) -> bool:
    """Whether the setpoint of a mission stays at each waypoint until the robot is there."""
    return bool(mission.waypoints) and mission.carrot is None


def without_network(experiment: ResolvedExperiment) -> ResolvedExperiment:
    """Return an experiment with the same settings and seed over an ideal link."""
    return experiment.model_copy(update={"link": Link(profile="ideal")})


def fly_beside_ideal(experiment: ResolvedExperiment) -> Row:
    """Fly an experiment; its numbers include those beside its flight over an ideal link.

    They are left out if that flight failed, or if the robot never flew.
    """

    def fly() -> Row:
        found = fly_in_memory(experiment)
        row, path = row_of(found, experiment), path_of(found.flight)
        ideal = _fly_ideal(without_network(experiment).model_dump_json())
        if ideal is not None and len(path):
            ideal_path, ideal_time = ideal
            row["numbers"] |= {
                OFF_PATH: rms_distance(path, ideal_path),
                TIME_RATIO: found.flight.duration / ideal_time,
            }
        return row

    return or_error(fly)


@lru_cache(maxsize=16)  # points that differ in the network alone share this flight
def _fly_ideal(values: str) -> tuple[Array, float] | None:
    """Return path and duration [s] of the experiment with these values; None if it failed."""
    found = fly_in_memory(ResolvedExperiment.model_validate_json(values))
    if found.verdict.outcome != "success":
        return None
    return path_of(found.flight), found.flight.duration
