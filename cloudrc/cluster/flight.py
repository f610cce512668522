"""Fly one experiment in a cluster.

Install or upgrade the release, wait until it is ready, fly the mission by a Job, fetch and merge
the recordings of both pods, and write the report.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.errors import BadInputError, CloudrcError

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release
    from cloudrc.cluster.jobs import JobStatus
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.record.merge import Mission

Tell = Callable[[str], None]

FLUSH = 1.0
"""Time after which a recorder has certainly flushed its buffer [s]; the buffer holds at most half a
second of records."""
FETCHES = 4
"""Largest number of attempts to fetch recordings that contain the mission's end."""
FLOWN = (0, 1, 6, 130)
"""Exit codes of a Job whose mission has flown: success, failure, invalid, interrupted."""
COMPONENTS = ("world", "cloud")
_SHAPER_LABEL = re.compile(r'cloudrc_link_info\{[^}]*shaper="(\w+)"')


def fly_in_cluster(
    experiment: ResolvedExperiment, folder: Path, release: Release, timeout: float, tell: Tell
) -> dict[str, Any]:
    """Fly one experiment on a release and fill its run folder.

    Args:
        experiment: A complete and checked experiment.
        folder: Folder of the run. It is empty until the mission has flown; then it gets
            configuration, recordings, metrics, logs and report.
        release: The release that flies; installed if missing, and kept afterwards.
        timeout: Time for the release to become ready [s].
        tell: Called with progress, a line at a time.

    Returns:
        The content of report.json.

    Raises:
        CloudrcError: If the mission could not be flown, or if the release flies another mission.
    """
    from cloudrc.cluster.release import current_values, install
    from cloudrc.cluster.tools import chart_folder
    from cloudrc.config.load import dump

    _refuse_busy(release)
    began = time.monotonic()
    given = chart_values(experiment, current_values(release))
    install(release, chart_folder(), given, timeout=timeout, tell=tell)
    tell(
        f"release '{release.name}' {release.where} is ready after {time.monotonic() - began:.0f} s"
    )
    interrupted = False
    try:
        _fly(experiment, release, tell)
    except KeyboardInterrupt:
        interrupted = True
    (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
    mission = fetch_all(release, folder, tell, want_end=not interrupted)
    return _report(experiment, folder, mission, interrupted)


def chart_values(experiment: ResolvedExperiment, before: Mapping[str, Any]) -> dict[str, Any]:
    """Return the chart's values for an experiment; all other values of the release stay the same.

    Args:
        experiment: A complete experiment; it becomes the chart's `experiment`, with its link.
        before: Values with which the release was installed.
    """
    link = {**before.get("link", {}), "profile": ""}
    # The chart's own Job would fly its mission at the same time.
    mission = {**before.get("mission", {}), "enabled": False}
    flown = experiment.model_dump(mode="json")
    return {**before, "link": link, "mission": mission, "experiment": flown}


def _refuse_busy(release: Release) -> None:
    """Refuse to install an experiment, which replaces both pods, while a mission flies."""
    from cloudrc.cluster.jobs import current_mission
    from cloudrc.cluster.tools import ClusterError

    found, job = current_mission(release)
    if found:
        end = " ".join(["cloudrc mission cancel", *filter(None, [job]), *release.cloudrc_flags])
        raise ClusterError(
            f"{found} is under way on release '{release.name}' {release.where}; wait for it, "
            f"end it: {end}, or fly on a release of your own: --release NAME"
        )


def mission_document(experiment: ResolvedExperiment) -> dict[str, Any]:
    """Return the mission of an experiment in the API's format."""
    mission = experiment.mission.model_dump(mode="json")
    return {
        "name": experiment.name,
        "start": mission["start"],
        "time_limit_s": experiment.criteria.time_limit_s,
        "waypoints": mission["waypoints"],
    }


def refuse_local_files(experiment: ResolvedExperiment) -> None:
    """Refuse an experiment that names local files, which the images do not contain.

    Raises:
        BadInputError: If the experiment names a local file; the message names the key.
    """
    from cloudrc.config.load import FILE_READERS

    paths = {
        f"cloud.{key}": getattr(experiment.cloud, key).name
        for key in ("estimator", "predictor", "controller")
    }
    paths |= {
        f"link.{key}.{name}": getattr(getattr(experiment.link, key), name)
        for key in ("uplink", "downlink")
        for name in FILE_READERS
    }
    paths |= {"world.robot": experiment.world.robot, "world.scene": experiment.world.scene}
    for key, name in paths.items():
        if name is not None and ("/" in name or name.endswith(".py")):
            raise BadInputError(
                f"{key}: {name}: the pods do not have this file; build it into an image, "
                "or fly with --mode local"
            )
    if experiment.mission.steps is not None:
        raise BadInputError(
            "mission.steps: a mission in a cluster has waypoints; fly steps with --mode local "
            "or --mode virtual"
        )


def _fly(experiment: ResolvedExperiment, release: Release, tell: Tell) -> None:
    """Fly the mission by a Job; cancel the mission if the user interrupts."""
    from cloudrc.cluster.jobs import follow, follow_limit, run_job
    from cloudrc.cluster.tools import ClusterError

    limit = experiment.criteria.time_limit_s
    job = run_job(release, mission_document(experiment), limit=limit)
    tell(f"Job {job.name} flies {experiment.name}")
    try:
        ended = follow(release, job.name, tell, timeout=follow_limit(limit, False))
    except KeyboardInterrupt:
        _cancel(release, job, tell)
        raise
    if ended.exit_code not in FLOWN:
        raise ClusterError(f"Job {job.name} did not fly its mission: {ended.message}")


def _cancel(release: Release, job: JobStatus, tell: Tell) -> None:
    from cloudrc.cluster.jobs import cancel

    try:
        tell(cancel(release, job.name))
    except CloudrcError as error:
        tell(f"cannot cancel: {error}")


def fetch_all(release: Release, folder: Path, tell: Tell, *, want_end: bool) -> Mission:
    """Fetch recordings, metrics and logs, and merge the recordings.

    Args:
        release: The release that flew the mission.
        folder: The folder of the run.
        tell: Called with a line for each file that cannot be fetched.
        want_end: Whether to fetch again until the recordings contain the mission's end.

    Raises:
        CloudrcError: If the recordings cannot be fetched. The other files are not needed for the
            report, so they cause no exception.
    """
    from cloudrc.cluster.pods import fetch_logs, fetch_metrics
    from cloudrc.record.merge import cut_to_last_mission, merge

    for _ in range(FETCHES):
        time.sleep(FLUSH)
        _fetch_recordings(release, folder, tell)
        mission, ended = cut_to_last_mission(merge(folder / "world.mcap", folder / "cloud.mcap"))
        if ended or not want_end:
            break
    _fetch_before(release, folder, tell)
    for component in COMPONENTS:
        for fetch, suffix in ((fetch_metrics, "metrics"), (fetch_logs, "log")):
            try:
                texts = fetch(release, component)
            except CloudrcError as error:
                tell(f"the report is written without the {component} pod's {suffix}: {error}")
                continue
            for container, text in texts.items():
                path = folder / f"{component}-{container}.{suffix}"
                path.write_text(text, encoding="utf-8")
    return mission


def _fetch_recordings(release: Release, folder: Path, tell: Tell) -> None:
    """Copy both recordings; retry if a connection breaks."""
    from cloudrc.cluster.pods import fetch_recording

    for component in COMPONENTS:
        for left in reversed(range(FETCHES)):
            try:
                fetch_recording(release, component, folder / f"{component}.mcap")
                break
            except CloudrcError as error:
                if not left:
                    raise
                tell(f"{error}; trying again")
                time.sleep(FLUSH)


def _fetch_before(release: Release, folder: Path, tell: Tell) -> None:
    """Copy the earlier recording of a restarted container; the report does not need it."""
    from cloudrc.cluster.pods import fetch_previous_recording

    for component in COMPONENTS:
        path = folder / f"{component}.before.mcap"
        try:
            if fetch_previous_recording(release, component, path):
                tell(f"{component} was restarted; its earlier recording is in {path}")
        except CloudrcError as error:
            path.unlink(missing_ok=True)
            tell(f"{component} was restarted; no earlier recording: {error}")


def _shaper(folder: Path) -> str:
    """Read from the link container's metrics what emulates the link, such as netem."""
    texts = [path.read_text(encoding="utf-8") for path in sorted(folder.glob("*-link.metrics"))]
    found = {name for text in texts for name in _SHAPER_LABEL.findall(text)}
    return "+".join(sorted(found)) or "unknown"


def _report(
    experiment: ResolvedExperiment, folder: Path, mission: Mission, interrupted: bool
) -> dict[str, Any]:
    from cloudrc.record.hash import messages_sha256
    from cloudrc.report.document import Run
    from cloudrc.report.write import attachments, write_report

    digest = messages_sha256(mission.contents.messages)
    run = replace(Run("cluster", _shaper(folder), digest), interrupted=interrupted)
    try:
        own = experiment.report.metrics  # evaluated here, so the pods do not need the file
        return write_report(folder, mission.recording(), experiment, run, own=own)
    finally:
        mission.write(folder / "mission.mcap", attachments(folder))
