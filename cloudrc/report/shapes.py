"""Find what robot and scene of a flight look like."""

from __future__ import annotations

from cloudrc.config.load import ResolvedExperiment
from cloudrc.errors import MissingPrerequisiteError
from cloudrc.geometry.shapes import SHAPES_FILE, Shapes
from cloudrc.record.columns import Recording


def flown_shapes(recording: Recording, experiment: ResolvedExperiment) -> Shapes:
    """Return the shapes of the robot and the scene of a flight.

    They are those that the recording contains. A recording of an older version has none; then they
    are those of the files that the experiment names, or none without MuJoCo.

    Raises:
        BadInputError: If the shapes in the recording are not readable or, in a recording without
            shapes, if the files are missing or unsuitable.
    """
    if (data := recording.attachments.get(SHAPES_FILE)) is not None:
        return Shapes.from_bytes(data)
    try:
        from cloudrc.world.shapes import read_shapes

        return read_shapes(experiment.world)
    except MissingPrerequisiteError:
        return Shapes()
