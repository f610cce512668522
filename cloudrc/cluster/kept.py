# SPDX-License-Identifier: Apache-2.0

"""Reports of a release's missions: the Job of a mission keeps one, anybody else fetches one.

With the chart's `recordings`, a volume has world.mcap and cloud.mcap of the pods, and the folder
`missions` with a folder per report, named TIME-MISSION. Else the pods have the recordings.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from cloudrc.base.errors import InvalidRunError, StateError
from cloudrc.base.outside.document import parse_yaml, write_yaml
from cloudrc.base.outside.refusal import check_names
from cloudrc.cluster.client import Release
from cloudrc.cluster.flight import FETCHES, FLUSH, fetch_all, report_flight
from cloudrc.cluster.link import EXPERIMENT
from cloudrc.cluster.pods import DATA, copy_file, find_pod, list_files
from cloudrc.config.ground import put_on_ground
from cloudrc.config.heading import without_held_yaws
from cloudrc.config.load import load_link, read_experiment, robot_settings
from cloudrc.config.profile import DIRECTIONS
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.config.schema import MissionConfig
from cloudrc.flight.session import experiment_of
from cloudrc.link.follow import PROFILE
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.merge import cut_to_last_mission, merge
from cloudrc.results.report.document import ENVIRONMENT_FILE
from cloudrc.teleop.store import MissionRecord, open_store

REPORTS = "missions"
"""Folder of the reports in the volume."""
FILES = ("config.yaml", "report.json", ENVIRONMENT_FILE, "mission.mcap")
"""Files of a kept report. Its page has to be drawn: the images have no matplotlib."""
JOURNAL = "/var/lib/cloudrc-journal/missions.journal"
"""File of the missions in the container teleop; its newest events are in the one with -wal."""
BEFORE = 30.0
"""Time before the first event and after the last one of a mission that is read, too [s]."""
DAY = 86_400.0
"""A day [s]."""


class Retention(NamedTuple):
    """The reports that a volume keeps; the oldest go first."""

    number: int  # largest number of reports
    days: float  # largest age of a report [days]
    size: float  # largest size of the reports before the newest [bytes]


def keep_report(
    data: Path,
    files: tuple[Path, Path],
    order: Mapping[str, Any],
    view: Mapping[str, Any],
    most: Retention,
) -> Path:
    """Write the report of the mission that has just ended, and remove old ones; return its folder.

    Args:
        data: The volume with the recordings that the pods write.
        files: The release's experiment and the profile of its link.
        order: The mission as it was posted.
        view: The mission as the API shows it.
        most: The reports that remain.
    """
    experiment = _experiment(*files, order)
    _remove_old(data / REPORTS, most)
    seconds = max((event["time_s"] for event in view["events"]), default=0.0) + 2 * BEFORE
    for _ in range(FETCHES):
        time.sleep(FLUSH)
        recording = merge(data / "world.mcap", data / "cloud.mcap", round(seconds * 1e9))
        if cut_to_last_mission(recording, being_written=True):
            break
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    folder = data / REPORTS / f"{stamp}-{view['id']}"
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
    report_flight(experiment, folder, recording, False, page=False, figures=False)
    return folder


def _experiment(
    experiment: Path, profile: Path, order: Mapping[str, Any], robot: int | None = None
) -> ResolvedExperiment:
    """Return a release's experiment with its link, and with the waypoints of `order`, if any.

    `robot` is the number of a robot in a fleet.
    """
    tree: dict[str, Any] = parse_yaml(experiment.read_text("utf-8"), experiment.name)[0] or {}
    keys = {*DIRECTIONS, "start_s"}
    link = load_link(profile, experiment).model_dump(mode="json", include=keys)
    tree["link"] = link
    tree.setdefault("name", order.get("name", "mission").replace("/", "-"))
    if "waypoints" in order:
        tree["mission"] = {key: order[key] for key in MissionConfig.model_fields if key in order}
        if limit := order.get("time_limit_s"):
            tree["criteria"] = {**(tree.get("criteria") or {}), "time_limit_s": limit}
    with TemporaryDirectory() as name:
        config = Path(name) / "config.yaml"
        config.write_text(write_yaml(tree), encoding="utf-8")
        found = read_experiment(config, robot_settings(robot), flown=True)
    # As teleop does with an order, which may have waypoints of two numbers.
    mission = put_on_ground(found.mission, found.world.files)
    mission = without_held_yaws(mission, found.robot.heading)
    return found.model_copy(update={"mission": mission})


def _remove_old(reports: Path, most: Retention) -> None:
    """Remove the oldest reports, so that a new one is within `most`."""
    size, oldest = 0, time.time() - most.days * DAY
    for count, folder in enumerate(sorted(reports.glob("*-*/"), reverse=True), start=1):
        size += sum(file.stat().st_size for file in folder.iterdir())
        if count >= most.number or size > most.size or folder.stat().st_mtime < oldest:
            shutil.rmtree(folder)


def fetch_mission(
    release: Release, mission: str, folder: Path, tell: Callable[[str], None]
) -> None:
    """Fetch a flown mission of a release into a folder: recording, config.yaml and report.json.

    `mission` is an id such as m3, or the name of a kept report; "" means the last mission. `tell`
    gets a line about logs that cannot be fetched.

    Raises:
        StateError: If the mission has not ended.
        InvalidRunError: If the recordings of the pods begin after the mission.
    """
    known = _missions(release)
    flown = [each.id for each in known.values() if "started" in each.happened]
    wanted = mission or (flown[-1] if flown else "")
    pod = find_pod(release, "cloud").metadata.name
    names = list_files(release, pod, "cloud", f"{DATA}/{REPORTS}")
    kept = [name for name in names if name == wanted or name.endswith(f"-{wanted}")]
    if wanted and kept:
        for name in FILES:
            path = f"{DATA}/{REPORTS}/{kept[-1]}/{name}"
            copy_file(release, pod, "cloud", path, folder / name)
        # Another install, whose volume this is, may have had a mission of this id.
        if wanted not in known or _has(Recording.read(folder / "mission.mcap"), known[wanted]):
            return
        for name in FILES:
            (folder / name).unlink()
    check_names("mission", [wanted], flown, f"{release}: ")
    if not known[wanted].ended:
        raise StateError(f"mission {wanted} has not ended; wait for its end")
    _report_of_pods(release, known[wanted], folder, tell)


def _report_of_pods(
    release: Release, record: MissionRecord, folder: Path, tell: Callable[[str], None]
) -> None:
    with TemporaryDirectory() as name:
        files = Path(name) / EXPERIMENT, Path(name) / PROFILE
        for component in ("experiment", "link"):
            for found in release.find("configmaps", component):
                for key, text in (found.data or {}).items():
                    (Path(name) / key).write_text(text, encoding="utf-8")
        session = _experiment(*files, {"name": record.order.name or release.name}, release.robot)
        about = f"Mission {record.id} ({record.order.name}) of {release.name}"
        experiment = experiment_of(session, record, folder, about)
        recording = fetch_all(release, folder, tell, want_end=True, number=record.number)
    if not _has(recording, record):
        raise InvalidRunError(
            f"the pods' recordings lack mission {record.id}: a pod has been replaced since, or "
            "newer flights took its place; keep reports by recordings.storage of the chart"
        )
    (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
    report_flight(experiment, folder, recording, False, page=False, figures=False)


def _has(recording: Recording, record: MissionRecord) -> bool:
    return record.number in recording["/telemetry"]["mission_id"]


def _missions(release: Release) -> dict[str, MissionRecord]:
    """Read the missions that a release knows: id -> mission, the oldest first."""
    pod = find_pod(release, "cloud").metadata.name
    with TemporaryDirectory() as name:
        journal = Path(name) / "missions.journal"
        for ending in ("", "-wal"):
            target = Path(f"{journal}{ending}")
            copy_file(release, pod, "teleop", f"{JOURNAL}{ending}", target)
        with closing(open_store(journal, b"")) as store:
            return store.missions
