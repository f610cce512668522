"""Read the experiment that is attached to a recording."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from cloudrc.config.load import read_experiment
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.report.folder import read_run

NAME = "config.yaml"


def read_attached(recording: Recording) -> ResolvedExperiment:
    """Return the experiment of a recording; raise a BadInputError if it is lost or invalid."""
    if NAME not in recording.attachments:
        raise BadInputError("its config.yaml, which names the scene, is lost")
    with TemporaryDirectory() as folder:
        config = Path(folder) / NAME
        config.write_bytes(recording.attachments[NAME])
        try:
            return read_experiment(config, flown=True)
        except BadInputError as error:
            raise BadInputError(str(error).replace(str(config), "its config.yaml")) from error


def read_flight(run: Path) -> tuple[Recording, ResolvedExperiment]:
    """Read recording and experiment of a run; `run` is its folder, or an MCAP file."""
    if run.is_dir():
        return read_run(run)[:2]
    recording = Recording.read(run)
    recording.refuse_damaged(run)
    try:
        return recording, read_attached(recording)
    except BadInputError as error:
        raise BadInputError(f"{run}: {error}; name the folder of the run") from error
