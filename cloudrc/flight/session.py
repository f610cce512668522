# SPDX-License-Identifier: Apache-2.0

"""Read the last mission of a session (`cloudrc up`) that has ended.

The recordings of world and cloud contain all flights of the session; `mission.mcap` and the report
contain the last mission.
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

from cloudrc.base.errors import InvalidRunError, NothingFlownError
from cloudrc.config.load import read_experiment
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.config.setpoints import DRIVE_FILE, write_setpoints
from cloudrc.flight.assembly.plan import with_order
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.merge import cut_to_last_mission, merge
from cloudrc.results.report.document import Run
from cloudrc.results.report.folder import check_ended
from cloudrc.results.report.write import attachments
from cloudrc.results.under_way import JOURNAL_FILE
from cloudrc.teleop.store import MissionRecord, open_store


def last_mission(folder: Path) -> MissionRecord | None:
    """Return the last mission that flew in a session that has ended; None if none flew."""
    if not (folder / JOURNAL_FILE).exists():  # the session has ended before it was ready
        return None
    with closing(open_store(folder / JOURNAL_FILE, b"")) as store:
        flown = [each for each in store.missions.values() if "started" in each.happened]
    return flown[-1] if flown else None


def read_last_mission(folder: Path) -> tuple[Recording, ResolvedExperiment, bool]:
    """Read the last mission of a session that has ended; write its experiment to config.yaml.

    Returns:
        The recording of this mission, its experiment, and whether the session ended before the
        mission.

    Raises:
        NothingFlownError: If no mission flew.
        InvalidRunError: If the recording of a killed session ends before its last mission.
    """
    if (last := last_mission(folder)) is None:
        raise NothingFlownError(f"{folder}: no mission flew, so there is no report")
    recording = merge(folder / "world.mcap", folder / "cloud.mcap")
    seen = recording["/telemetry"]["mission_id"]
    if len(seen) and last.number not in seen:
        text = f"the recording ends before mission {last.id}, the last one, so there is no report"
        raise InvalidRunError(f"{folder}: {text}; world.mcap and cloud.mcap have the flight before")
    config = folder / "config.yaml"
    about = f"Mission {last.id} ({last.order.name}), the last one of a session"
    experiment = experiment_of(read_experiment(config, flown=True), last, folder, about)
    config.write_text(dump(experiment), encoding="utf-8")
    cut_to_last_mission(recording)
    return recording, experiment, not last.ended


def experiment_of(
    session: ResolvedExperiment, mission: MissionRecord, folder: Path, about: str
) -> ResolvedExperiment:
    """Return the experiment of a session with one mission; `about` describes it.

    A mission that was driven by hand gets a file of setpoints in `folder`.
    """
    if mission.order.plan.by_hand:  # rest at the start, until the report has the setpoints
        rest = [(time, mission.order.plan.legs[0].position) for time in (0.0, 1.0)]
        drive = write_setpoints(rest, session.world.files.fence)
        (folder / DRIVE_FILE).write_text(drive, encoding="utf-8")
    return with_order(session, mission.order, about)


def restore_mission(folder: Path) -> None:
    """Write the mission.mcap of a session that was killed before it wrote this file."""
    if (folder / JOURNAL_FILE).is_file() and not (folder / "mission.mcap").exists():
        check_ended(folder)
        recording, _, interrupted = read_last_mission(folder)
        recording.metadata |= Run("local", "relay", interrupted).metadata
        recording.write(folder / "mission.mcap", attachments(folder))
