"""Fly missions as Kubernetes Jobs: create, follow and delete a mission's Job.

The container of the Job posts the mission to the release's API, follows the mission, and ends with
the exit code of the mission's verdict. The Job has the form of the chart's
`examples/mission-job.yaml`.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import ceil
from typing import Any, NamedTuple

import yaml

from cloudrc.cluster.client import ClusterError, Release, chart_folder
from cloudrc.cluster.pods import (
    container_statuses,
    find_deployment,
    list_pods,
    pod_failure,
    pod_log,
    tokens_secret,
)
from cloudrc.errors import CloudrcError, TimedOutError, to_one_line

EXAMPLE = "examples/mission-job.yaml"
"""File in the chart with the Job and the ConfigMap of a mission, the template for `run_job`."""
COMPONENT = "mission"
"""Label `component` of the Jobs, pods and ConfigMaps of missions."""
FILE = "mission.yaml"
"""Key in the ConfigMap under which the mission is stored."""
UID_LABEL = "batch.kubernetes.io/controller-uid"
"""Label with the Job's UID, which Kubernetes sets on the Job's pod."""
FROM_POD = ("nodeSelector", "tolerations", "affinity", "imagePullSecrets", "securityContext")
FROM_CONTAINER = ("image", "imagePullPolicy", "securityContext")
"""Keys that the pod and the container of a mission take from teleop's pod and container."""
START_ALLOWANCE = 120
"""Time to start the pod and to get the robot's state, added to the mission's time limit [s]."""
QUEUE_ALLOWANCE = 3600
"""Time for earlier missions to end, added to the time limit of a Job that may wait [s]."""
KEEP_FINISHED = 3600
"""Time for which Kubernetes keeps a finished Job [s]."""
LOOK_PERIOD = 0.5
"""Time between two requests for the state of a Job [s]."""
DELETE_LIMIT = 40.0
"""Time limit for a deleted Job to end [s]; Kubernetes gives the Job's pod 30 s."""


class Ended(NamedTuple):
    """How a mission's Job ended."""

    exit_code: int | None  # of the container; None if the container has not ended
    message: str  # verdict in words, or why the Job failed


def run_job(
    release: Release,
    mission: Mapping[str, Any],
    *,
    name: str = "",
    limit: float = 60.0,
    queue: bool = False,
) -> str:
    """Create the Job of a mission, and return its name; the Job runs even if nobody follows it.

    Args:
        release: Release that flies the mission.
        mission: Mission in the API's format: name, start, time_limit_s, waypoints.
        name: Name of the Job; default: an unused name.
        limit: Time limit of the mission [s].
        queue: Whether to wait while another mission flies; if False, the API refuses the mission.

    Raises:
        ClusterError: If the cluster refuses the Job, or if the release does not exist.
    """
    # A Job's pod has a longer name than the Job; the limit is 63 characters.
    name = name or f"{release.name[:40].rstrip('-.')}-mission-{secrets.token_hex(3)}"
    plan, job = yaml.safe_load_all((chart_folder() / EXAMPLE).read_text("utf-8"))
    labels = {
        **release.labels(COMPONENT),  # used by the NetworkPolicies
        "app.kubernetes.io/part-of": "cloudrc",
        "app.kubernetes.io/managed-by": "cloudrc",
    }
    deployment = find_deployment(release, "cloud")
    owner = owner_of("apps/v1", "Deployment", deployment)
    job["metadata"] = {"name": name, "labels": labels, "ownerReferences": [owner]}
    deadline = ceil(limit) + START_ALLOWANCE + queue * QUEUE_ALLOWANCE
    job["spec"] |= {"activeDeadlineSeconds": deadline, "ttlSecondsAfterFinished": KEEP_FINISHED}
    job["spec"]["template"]["metadata"]["labels"] = labels
    _fill_pod(job["spec"]["template"]["spec"], release, deployment, name, queue)
    plan["data"] = {FILE: json.dumps(mission, indent=2) + "\n"}
    create_job(release, job, plan, labels, COMPONENT)
    return name


def create_job(
    release: Release, job: Any, files: Any, labels: Mapping[str, str], component: str
) -> None:
    """Create a Job, and `files` as a ConfigMap of the same name.

    If the ConfigMap cannot be created, delete the Job. `component` is the Job's component label.
    """
    name, created = job["metadata"]["name"], release.request("create", "jobs", body=job)
    owner = owner_of("batch/v1", "Job", created)
    files["metadata"] = {"name": name, "labels": labels, "ownerReferences": [owner]}
    try:
        release.request("create", "configmaps", body=files)
    except BaseException:  # Ctrl-C too: without its files the Job would wait forever
        with suppress(CloudrcError):
            delete_job(release, name, component)
        raise


def owner_of(version: str, kind: str, owner: Any) -> dict[str, Any]:
    """Make an owner reference: deleting `owner` also deletes the objects with this reference."""
    metadata = owner.metadata
    return {"apiVersion": version, "kind": kind, "name": metadata.name, "uid": metadata.uid}


def _fill_pod(
    pod: dict[str, Any], release: Release, deployment: Any, name: str, queue: bool
) -> None:
    volumes = {volume["name"]: volume for volume in pod["volumes"]}
    volumes["mission"]["configMap"]["name"] = name
    volumes["tokens"]["secret"]["secretName"] = tokens_secret(release)
    cloud = release.client.sanitize_for_serialization(deployment.spec.template.spec)
    (teleop,) = (each for each in cloud["containers"] if each["name"] == "teleop")
    (container,) = pod["containers"]
    for target, source, keys in ((pod, cloud, FROM_POD), (container, teleop, FROM_CONTAINER)):
        for key in keys:
            target.pop(key, None)
            if key in source:
                target[key] = source[key]
    arguments = [word for word in container["args"] if not word.startswith("--api=")]
    api = f"--api={_api_address(release)}"
    container["args"] = [*arguments, api, *(["--queue"] if queue else [])]


def _api_address(release: Release) -> str:
    for service in release.find("services", "cloud"):
        for port in service.spec.ports or []:
            if port.name == "api":
                return f"http://{service.metadata.name}:{port.port}"
    raise ClusterError(
        f"release '{release.name}' {release.where} has no Service with a port 'api'; "
        "install it again: helm upgrade --install"
    )


def delete_job(release: Release, name: str, component: str = COMPONENT) -> None:
    """Delete a Job with its pods and ConfigMap; the pod of a mission first cancels the mission."""
    release.request("delete", "jobs", name=name, propagation_policy="Foreground")
    until = time.monotonic() + DELETE_LIMIT
    while any(job.metadata.name == name for job in release.find("jobs", component)):
        if time.monotonic() > until:
            raise TimedOutError(
                f"Job '{name}' has not ended {DELETE_LIMIT:g} s after its deletion; "
                f"see: kubectl {' '.join(release.flags)} describe job {name}"
            )
        time.sleep(LOOK_PERIOD)


def failure_of(job: Any) -> str | None:
    """Return why a Job has failed, "" if it is complete, None if it has not ended."""
    for condition in job.status.conditions or []:
        if condition.status == "True" and condition.type == "Complete":
            return ""
        if condition.status == "True" and condition.type == "Failed":
            where = f" (index {job.status.failed_indexes})" if job.status.failed_indexes else ""
            return f"{condition.reason}: {condition.message}{where}"
    return None


def follow(release: Release, name: str, write: Callable[[str], None]) -> Ended:
    """Follow a Job until it has ended; `write` receives each line of the Job's log.

    Kubernetes ends the Job after the Job's time limit. Raise a ClusterError if the Job's pod cannot
    run; the message names the cause.
    """
    written = 0
    while True:
        job = release.request("get", "jobs", name=name)
        uids = ((pod, pod.metadata.labels.get(UID_LABEL)) for pod in list_pods(release, COMPONENT))
        pod = next((pod for pod, uid in uids if uid == job.metadata.uid), None)
        # A service mesh may add containers.
        states = [c.state for c in container_statuses(pod) if c.name == COMPONENT] if pod else []
        ended = next((state.terminated for state in states if state.terminated), None)
        cause = failure_of(job)
        if cause is None and not ended and not any(state.running for state in states):
            _check_can_start(release, name, pod)
        elif pod is not None and pod.status.phase != "Pending":
            lines = pod_log(release, pod.metadata.name, COMPONENT).splitlines()
            for line in lines[written:]:
                write(line)
            written = max(written, len(lines))
        if cause is not None:
            return Ended(ended and ended.exit_code, to_one_line(ended and ended.message) or cause)
        time.sleep(LOOK_PERIOD)


def _check_can_start(release: Release, name: str, pod: Any) -> None:
    """Raise a ClusterError if the pod of a Job will never run; `pod` is None if there is none."""
    if pod is not None:
        why = pod_failure(pod)
    else:  # the cluster may refuse the pod, for example for a quota
        selector = f"involvedObject.kind=Job,involvedObject.name={name}"
        found = release.request("list", "events", field_selector=selector)
        why = next((event.message for event in found if event.reason == "FailedCreate"), "")
    if why:
        raise ClusterError(
            f"Job '{name}' cannot start: {why}; fix this, then delete the Job: "
            f"kubectl {' '.join(release.flags)} delete job {name}"
        )
