# SPDX-License-Identifier: Apache-2.0

"""Find the robot and the scene of a flight: what the recording has of them, else their files."""

from __future__ import annotations

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.base.outside.refusal import naming
from cloudrc.config.flown import FLOWN_FILE, FlownWorld
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.physics.geometry.shapes import SHAPES_FILE, Shapes
from cloudrc.results.metrics.flight import Flight
from cloudrc.results.record.columns import Recording


def flight_of(recording: Recording, experiment: ResolvedExperiment) -> Flight:
    """Return a flight for metrics and figures; raise errors as `flown_world` does."""
    flown = flown_world(recording, experiment)
    rate_hz = experiment.cloud.command_rate_hz
    asked = experiment.criteria, experiment.mission
    return Flight(recording, *asked, flown.scene, flown.hull, rate_hz)


def flown_world(recording: Recording, experiment: ResolvedExperiment) -> FlownWorld:
    """Return the numbers of the robot and the scene of a flight.

    They are those that the recording contains. A recording of an older version, and a recording in
    memory, has none; then they are those of the files that the experiment names.
    """
    if (data := recording.attachments.get(FLOWN_FILE)) is not None:
        return FlownWorld.from_bytes(data)
    return FlownWorld.of(experiment.world.files)


def flown_shapes(recording: Recording, experiment: ResolvedExperiment) -> Shapes:
    """Return the shapes of the robot and the scene of a flight.

    They are those that the recording contains. A recording of an older version has none; then they
    are those of the files that the experiment names, or none without MuJoCo.
    """
    if (data := recording.attachments.get(SHAPES_FILE)) is not None:
        with naming("the recording"):
            return Shapes.from_bytes(data)
    try:
        from cloudrc.results.report.shapes import read_shapes

        return read_shapes(experiment.world)
    except MissingPrerequisiteError:
        return Shapes()
