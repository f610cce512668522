"""Read the experiment that is attached to a recording."""

from __future__ import annotations

from pathlib import Path

from cloudrc.config.load import read_attached
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.record.columns import Recording
from cloudrc.report.folder import read_run


def read_flight(run: Path) -> tuple[Recording, ResolvedExperiment]:
    """Read recording and experiment of a run; `run` is its folder, or an MCAP file."""
    if run.is_dir():
        return read_run(run)[:2]
    recording = Recording.read(run, whole=True)
    return recording, read_attached(recording.attachments, str(run))
