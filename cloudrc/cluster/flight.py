# SPDX-License-Identifier: Apache-2.0

"""Install a release, wait until it is ready, and fly one experiment with it.

A flight installs or upgrades the release, flies the mission by a Kubernetes Job, fetches and merges
the recordings of the pods of world and cloud, and writes the report.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import CloudrcError, InterruptedRunError, TimedOutError
from cloudrc.cluster import pods
from cloudrc.cluster.client import (
    COMPONENTS,
    PACKAGE,
    ClusterError,
    NoAnswerError,
    Release,
    chart_folder,
    explain_errors,
    program,
    run,
)
from cloudrc.cluster.diagnosis import why_not_ready
from cloudrc.cluster.incidents import observe
from cloudrc.cluster.jobs import (
    Ended,
    JobGoneError,
    delete_job,
    failure_of,
    follow,
    job_key,
    run_job,
)
from cloudrc.cluster.missions import release_api, settle_mission
from cloudrc.cluster.own_files import find_own_files, give_to_release, send_own_files
from cloudrc.teleop.client import Api, find_mission
from cloudrc.version import __version__

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment
    from cloudrc.results.record.columns import Recording

Tell = Callable[[str], None]


LOOK_PERIOD = 1.5
"""Time between two requests for the state of the pods [s]."""
FAILED_LOOKS = 5
"""Number of looks in a row at which a pod fails before it is reported: at first, Kubernetes may not
yet have made all objects that the pod needs."""
FLUSH = 1.0
"""Time after which a recorder has certainly written its buffer of half a second [s]."""
FETCHES = 4
"""Largest number of attempts to fetch recordings that contain the end of the mission."""
FLOWN = (0, 1, 6, 130)
"""Exit codes of a Job whose mission was flown: success, failure, invalid, interrupted."""


def install(release: Release, values: Mapping[str, Any], timeout: float, tell: Tell) -> None:
    """Install or upgrade a release, and wait for its pods; raise an error if one cannot run.

    Args:
        release: Context, namespace and name; a missing namespace is created.
        values: Values that override the chart's defaults.
        timeout: Time limit for the pods to become ready [s]; after it, raise a TimedOutError.
        tell: Receives a line about each change of the pods' state.
    """
    arguments = ["upgrade", "--install", release.name, str(chart_folder()), *release.helm_flags]
    arguments += ["--create-namespace", "--values=-"]
    run("helm", arguments, given=json.dumps(values))
    wait_ready(release, timeout=timeout, tell=tell)


def current_values(release: Release) -> dict[str, Any]:
    """Read the values with which a release was installed; {} if the release does not exist."""
    arguments = ["list", "--output=json", f"--filter=^{release.name}$", *release.helm_flags]
    if not json.loads(run("helm", arguments) or "[]"):
        return {}
    arguments = ["get", "values", release.name, "--output=json", *release.helm_flags]
    return json.loads(run("helm", arguments)) or {}


def wait_ready(release: Release, *, timeout: float, tell: Tell = lambda text: None) -> None:
    """Wait until the pods of world and cloud have the release's newest version and are ready.

    `tell` receives a line about each change of the pods' state.

    Raises:
        ClusterError: If a pod will never run; the message names the cause.
        TimedOutError: If the pods are not ready within `timeout` [s].
    """
    selector = f"app.kubernetes.io/instance={release.name}"
    see = f"see: {release.kubectl} describe pods -l {selector}"
    until, failed, last = time.monotonic() + timeout, 0, ""
    while True:
        words, fatal = _why_not_ready(release)
        if not words:
            return
        failed = failed + 1 if fatal else 0
        if failed > FAILED_LOOKS:
            raise ClusterError(f"{fatal}; {see}")
        if time.monotonic() > until:
            raise TimedOutError(
                f"{release} is not ready after {timeout:g} s: {words}; "
                f"{see}, or wait longer: --timeout"
            )
        if not fatal and words != last:  # what is fatal becomes an error
            tell(words)
            last = words
        time.sleep(LOOK_PERIOD)


def _why_not_ready(release: Release) -> tuple[str, str]:
    """Say why the pods of a release are not ready, and why they will never be; "" if not so."""
    words, never, objects = list[str](), list[str](), observe(release)
    for component in objects.workloads:
        if why := why_not_ready(objects, component):
            words.append(f"{component}: {why}")
            never += [f"the {component} pod cannot run: {why}"] * (why.state == "missing")
    return "; ".join(words), "; ".join(never)


def check_can_begin(release: Release) -> None:
    """Raise an error if a program is missing, or if a Job or mission is under way.

    Installing would replace the pods. If the API does not answer, return: installing may repair the
    release.
    """
    for name in ("helm", "kubectl"):
        program(name)
    busy, end = "", ""
    for job in release.find("jobs", "mission"):
        if failure_of(job) is None:
            name = job.metadata.name
            busy, end = f"Job '{name}'", f"{release.kubectl} delete job {name}"
    if not busy and (mission := _ask(release, lambda api: api.get("/v1/state")["mission"])):
        busy, end = f"mission {mission['id']}", _cancel_command(release, mission["id"])
    if busy:
        raise ClusterError(
            f"{busy} is under way on {release}; wait for it, end it: {end}, or fly on a release of "
            "your own: --release NAME"
        )


def begin_job(
    release: Release, mission: Mapping[str, Any], tell: Tell, timeout: float, *, queue: bool
) -> str:
    """Create the Job of a mission on a release that is ready; return the Job's name.

    After `helm install` without --wait, the release needs some seconds: wait at most `timeout` [s].
    """
    wait_ready(release, timeout=timeout, tell=tell)
    job = run_job(release, mission, queue=queue)
    tell(f"Job {job} on {release}")
    return job


def follow_job(release: Release, job: str, tell: Tell) -> Ended:
    """Follow the Job of a mission to its end, and return how it has ended.

    If the Job no longer follows its mission, cancel the mission.

    Raises:
        NoAnswerError: If the API server no longer answers; the Job goes on.
    """
    try:
        return follow(release, job, tell)
    except JobGoneError as gone:
        ended = settle_mission(release, gone.key, str(gone))
        tell(ended.message)
        return ended
    except NoAnswerError as error:
        log = f"{release.kubectl} logs --follow job/{job}"
        raise NoAnswerError(f"{error}; Job {job} goes on without this command: {log}") from None


def cancelling_command(release: Release, job: str) -> str:
    """Return the command that cancels the mission of a Job."""
    mission = _ask(release, lambda api: find_mission(api, job_key(release, job)))
    if mission:
        return _cancel_command(release, mission["id"])
    return f"{release.kubectl} delete job {job}"


def _ask(release: Release, ask: Callable[[Api], Any]) -> Any:
    """Return what the API of a release answers; None if it does not answer."""
    try:
        with release_api(release) as api:
            return ask(api)
    except CloudrcError:
        return None


def _cancel_command(release: Release, mission: str) -> str:
    flags = " ".join([*release.flags, f"--release={release.name}"])
    return f"cloudrc mission cancel {mission} {flags}"


def fly_in_cluster(
    experiment: ResolvedExperiment,
    folder: Path,
    release: Release,
    timeout: float,
    tell: Tell = lambda text: None,
    *,
    page: bool = True,
    figures: bool = False,
) -> dict[str, Any]:
    """Fly one experiment in a cluster, fill its run folder, and return the report.

    If nothing flies, remove the folder.

    Args:
        experiment: A complete and checked experiment.
        folder: Folder of the run, which gets configuration, recordings, logs and report.
        release: The Helm release to use; it is installed if it is missing, and stays afterwards.
        timeout: Time limit for the release to become ready [s].
        tell: Receives the progress, one line per call.
        page: Whether to write report.html.
        figures: Whether to write the files in figures/.
    """
    from cloudrc.config.resolved import dump

    try:
        began = time.monotonic()
        own = send_own_files(release, find_own_files(experiment.world))
        values = chart_values(experiment, current_values(release), own, loaded_tag(release))
        install(release, values, timeout, tell)
        give_to_release(release, own)
        took = time.monotonic() - began
        tell(f"{release} is ready after {took:.0f} s")
        interrupted = not _fly(experiment, release, tell)
    except (CloudrcError, KeyboardInterrupt):
        folder.rmdir()  # nothing has flown
        raise
    (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
    mission = fetch_all(release, folder, tell, want_end=not interrupted)
    return report_flight(experiment, folder, mission, interrupted, page=page, figures=figures)


def loaded_tag(release: Release, clone: Path = PACKAGE.parent) -> str:
    """Return the tag of the images that `make kind-load` loaded last from `clone`; "" if none.

    An image that was built again has another tag, so that it restarts the pods.
    """
    from kubernetes import config

    list_contexts: Any = config.list_kube_config_contexts  # not annotated
    with explain_errors("read the kubeconfig", release.where):
        context = release.context or list_contexts()[1]["name"]
    file = clone / "build" / "loaded" / context.replace("/", "-")
    return file.read_text("utf-8").strip() if file.is_file() else ""


def chart_values(
    experiment: ResolvedExperiment, before: Mapping[str, Any], own: Mapping[str, str], tag: str = ""
) -> dict[str, Any]:
    """Return Helm values for a flight: the release's present values `before`, with `experiment`.

    `own` has the names of the ConfigMaps with the user's robot and scene. The chart's own mission
    is disabled, because it would fly in addition. `tag` is that of the loaded images, "" if it is
    not known; a user's own registry or tag stays.
    """
    image = before.get("image", {})
    is_loaded = not image.get("tag") or image["tag"].startswith(f"{__version__}-g")
    if tag and is_loaded and not image.get("registry"):
        before = {**before, "image": {**image, "tag": tag}}
    link = {**before.get("link", {}), "profile": ""}
    # With a mission, the chart would start a second Job.
    mission = {**before.get("mission", {}), "enabled": False}
    flown = experiment.model_dump(mode="json")
    files = {kind: {"configMap": own.get(kind, "")} for kind in ("robot", "scene")}
    for kind in own:
        del flown["world"][kind]
    return {**before, **files, "link": link, "mission": mission, "experiment": flown}


def _fly(experiment: ResolvedExperiment, release: Release, tell: Tell) -> bool:
    """Fly the experiment's mission by a Job; return False if it was interrupted."""
    from cloudrc.teleop.models import ORDERED

    mission = experiment.mission.model_dump(mode="json", include=set(ORDERED))
    limit = experiment.criteria.time_limit_s
    job = run_job(release, {"name": experiment.name, "time_limit_s": limit, **mission})
    tell(f"Job {job} flies {experiment.name}")
    try:
        ended = follow_job(release, job, tell)
    except KeyboardInterrupt:
        tell("cancelling the mission")
        try:
            # The pod of a deleted Job does not cancel: teleop would fly on for the mission's lease.
            tell(settle_mission(release, job_key(release, job), "interrupted").message)
            delete_job(release, job)
        except CloudrcError as error:
            tell(f"cannot cancel: {error}")
        return False
    if ended.exit_code not in FLOWN:
        raise ClusterError(f"Job {job} did not fly its mission: {ended.message}")
    return ended.exit_code != InterruptedRunError.exit_code


def fetch_all(
    release: Release, folder: Path, tell: Tell, *, want_end: bool, number: int | None = None
) -> Recording:
    """Fetch recordings and logs into a folder; return the merged recording of one mission.

    It is the last mission, or the one with this `number` in telemetry. If logs cannot be fetched,
    `tell` receives the error. With `want_end`, fetch the recordings again until they contain the
    end of the mission.
    """
    from cloudrc.results.record.merge import cut_to_last_mission, merge

    for left in reversed(range(FETCHES)):
        time.sleep(FLUSH)
        try:
            for component in COMPONENTS:
                pods.fetch_recording(release, component, folder / f"{component}.mcap")
        except CloudrcError as error:
            if not left:
                raise
            tell(f"{error}; trying again")
            continue
        mission = merge(folder / "world.mcap", folder / "cloud.mcap")
        if cut_to_last_mission(mission, being_written=True, number=number) or not want_end:
            break
    for component in COMPONENTS:
        try:
            logs = pods.fetch_logs(release, component)
        except CloudrcError as error:
            tell(f"the report is written without the {component} pod's logs: {error}")
            continue
        for container, text in logs.items():
            (folder / f"{component}-{container}.log").write_text(text, encoding="utf-8")
    return mission


def report_flight(
    experiment: ResolvedExperiment,
    folder: Path,
    mission: Recording,
    interrupted: bool,
    *,
    page: bool,
    figures: bool,
) -> dict[str, Any]:
    """Write report and mission.mcap of a flight of a release into a folder; return the report.

    `interrupted` says whether the flight was cut short; `page` and `figures` are those of
    `write_report`.
    """
    from cloudrc.results.report.document import Run
    from cloudrc.results.report.views import views
    from cloudrc.results.report.write import attachments, write_report

    try:
        shaper = "+".join(sorted(set(mission["/link"]["shaper"]))) or "unknown"
        run = Run("cluster", shaper, interrupted)
        mission.metadata |= run.metadata
        mission.views = views(mission, experiment)
        own = experiment.report.metrics  # evaluated here, so the pods do not need the file
        return write_report(folder, mission, experiment, run, own=own, page=page, figures=figures)
    finally:
        mission.write(folder / "mission.mcap", attachments(folder))
