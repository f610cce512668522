"""Fly missions as Kubernetes Jobs: create, list, follow, cancel and delete them.

The container of a Job posts the mission to the release's API, follows the mission, and ends with
the exit code of the mission's verdict. `charts/cloudrc/examples/mission-job.yaml` shows the same
objects, written by hand.
"""

from __future__ import annotations

import json
import secrets
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from math import ceil
from typing import Any

from cloudrc.cluster.client import REQUEST_TIMEOUT, Release
from cloudrc.cluster.pods import (
    API_PORT,
    NO_PROXY,
    OPERATOR,
    VOLUME,
    find_pod,
    forwarded,
    list_pods,
    missing_secret,
    operator_token,
    pod_failure,
    refusal,
    secret_name,
)
from cloudrc.cluster.tools import ClusterError, ExpiredError, explain_errors, retry

COMPONENT = "mission"
"""Label `component` of missions' Jobs, pods and ConfigMaps."""
FOLDER = "/etc/cloudrc-mission"
"""Folder of the mission's file in the container."""
FILE = "mission.yaml"
"""Key of the mission in the ConfigMap, and name of the mission's file."""
TOKENS = "/etc/cloudrc-tokens"
"""Folder of the API's tokens in the container."""
KEY = "MISSION_KEY"
"""Environment variable with the mission's key in the API."""
UID_LABEL = "batch.kubernetes.io/controller-uid"
"""Label with the Job's UID, which Kubernetes sets on the Job's pod."""
START_ALLOWANCE = 120
"""Time to start the pod and to receive the robot's state, added to the mission's time limit [s]."""
QUEUE_ALLOWANCE = 3600
"""Time for earlier missions to end, added to the deadline of a Job that may queue [s]."""
DEADLINE_MAX = 2**31 - 1
"""Largest deadline that Kubernetes accepts [s]."""
KEEP_FINISHED = 3600
"""How long Kubernetes keeps a finished Job [s]."""
USER = 10001
"""User and group id in the container."""
API_CONTAINER = "teleop"
"""Container of the cloud pod that serves the API."""
API_PORT_NAME = "api"
"""Name of the API's port in its Service."""
LOOK_PERIOD = 0.5
"""Time between two looks at a Job [s]."""
READ_LIMIT = 30.0
"""Time limit to read a pod's log [s]."""
END_ALLOWANCE = 60.0
"""Time for Kubernetes to end a Job after its deadline [s]."""
ANSWER_LIMIT = 10.0
"""Time limit for the release's API to answer [s]."""


@dataclass(frozen=True)
class JobSettings:
    """Settings of the Job's pod, taken from the release.

    Attributes:
        image: Image of the release's teleop container.
        pull_policy: Pull policy of that image.
        pull_secrets: Names of Secrets for the image's registry.
        api: URL of the release's API inside the cluster.
        tokens: Name of the Secret with the API's tokens.
        placement: `nodeSelector`, `tolerations` and `affinity` of the release's cloud pod.
        owner: Reference to the release's cloud Deployment, so that uninstalling the release deletes
            its missions.
    """

    image: str
    pull_policy: str
    pull_secrets: tuple[str, ...]
    api: str
    tokens: str
    placement: Mapping[str, Any] = field(default_factory=dict)
    owner: Mapping[str, Any] | None = None


def labels(release: Release) -> dict[str, str]:
    """Return the labels of a mission's objects; the NetworkPolicies select by these labels."""
    return {
        "app.kubernetes.io/name": "cloudrc",
        "app.kubernetes.io/instance": release.name,
        "app.kubernetes.io/component": COMPONENT,
        "app.kubernetes.io/part-of": "cloudrc",
        "app.kubernetes.io/managed-by": "cloudrc",
    }


def config_map(release: Release, name: str, mission: Mapping[str, Any]) -> dict[str, Any]:
    """Build the ConfigMap with the mission.

    Args:
        release: Release that flies the mission.
        name: Name of Job and ConfigMap.
        mission: Mission in the API's format.
    """
    return {
        "apiVersion": "v1",
        "kind": "ConfigMap",
        "metadata": {"name": name, "labels": labels(release)},
        "data": {FILE: json.dumps(mission, indent=2) + "\n"},
    }


def deadline(limit: float, queue: bool) -> int:
    """Compute the time limit of a Job [s].

    Args:
        limit: Time limit of the mission [s].
        queue: Whether the mission may wait for others.
    """
    return min(ceil(limit) + START_ALLOWANCE + queue * QUEUE_ALLOWANCE, DEADLINE_MAX)


def job(
    release: Release, name: str, follower: JobSettings, *, limit: float, queue: bool
) -> dict[str, Any]:
    """Build the Job that posts the mission, follows the mission and ends with its verdict.

    Args:
        release: Release that flies the mission.
        name: Name of Job and ConfigMap.
        follower: Settings of the pod.
        limit: Time limit of the mission [s].
        queue: Whether to wait while another mission flies; else the mission is refused.
    """
    owners = [dict(follower.owner)] if follower.owner else []
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"name": name, "labels": labels(release), "ownerReferences": owners},
        "spec": {
            # The key is the Job's UID: a second pod would only read the first one's verdict.
            "backoffLimit": 0,
            "activeDeadlineSeconds": deadline(limit, queue),
            "ttlSecondsAfterFinished": KEEP_FINISHED,
            "template": {
                "metadata": {"labels": labels(release)},
                "spec": _pod(name, follower, queue),
            },
        },
    }


def _pod(name: str, follower: JobSettings, queue: bool) -> dict[str, Any]:
    return {
        **follower.placement,
        "restartPolicy": "Never",
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": USER,
            "runAsGroup": USER,
            "fsGroup": USER,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "imagePullSecrets": [{"name": secret} for secret in follower.pull_secrets],
        "containers": [_container(follower, queue)],
        "volumes": [
            {"name": "mission", "configMap": {"name": name}},
            {"name": VOLUME, "secret": _operator_secret(follower.tokens)},
        ],
    }


def _operator_secret(secret: str) -> dict[str, Any]:
    return {
        "secretName": secret,
        "defaultMode": 0o440,
        "items": [{"key": OPERATOR, "path": OPERATOR}],
    }


def _container(follower: JobSettings, queue: bool) -> dict[str, Any]:
    arguments = ["mission", "fly", f"--api={follower.api}"]
    arguments += [f"--token-file={TOKENS}/{OPERATOR}", f"--mission={FOLDER}/{FILE}"]
    arguments += [f"--key=$({KEY})", *(["--queue"] if queue else [])]
    return {
        "name": "mission",
        "image": follower.image,
        "imagePullPolicy": follower.pull_policy,
        "args": arguments,
        "env": [
            {
                "name": KEY,
                "valueFrom": {"fieldRef": {"fieldPath": f"metadata.labels['{UID_LABEL}']"}},
            }
        ],
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "resources": {
            "requests": {"cpu": "10m", "memory": "48Mi"},
            "limits": {"cpu": "500m", "memory": "128Mi"},
        },
        "volumeMounts": [
            {"name": "mission", "mountPath": FOLDER, "readOnly": True},
            {"name": VOLUME, "mountPath": TOKENS, "readOnly": True},
        ],
    }


@dataclass(frozen=True, slots=True)
class JobStatus:
    """State of a mission's Job.

    Attributes:
        name: Name of the Job.
        uid: UID of the Job, and key of the mission in the API.
        state: "pending", "flying", "complete" or "failed".
        created: Time of creation on the cluster's clock (RFC 3339).
        exit_code: Exit code of the container; None until the container has ended.
        message: Verdict in words; "" until the verdict is known.
    """

    name: str
    uid: str
    state: str
    created: str
    exit_code: int | None
    message: str


def run_job(
    release: Release,
    mission: Mapping[str, Any],
    *,
    name: str = "",
    limit: float = 60.0,
    queue: bool = False,
) -> JobStatus:
    """Create the Job of a mission; the Job runs to its end even if no client watches it.

    Args:
        release: Release that flies the mission.
        mission: Mission in the API's format: name, start, time_limit_s, waypoints.
        name: Name of the Job; default: an unused name.
        limit: Time limit of the mission [s].
        queue: Whether to wait while another mission flies; else the mission is refused.

    Returns:
        The new Job.

    Raises:
        ClusterError: If the cluster refuses the Job, or if the release does not exist.
    """
    # A Job's pod has a longer name than the Job; the limit is 63 characters.
    name = name or f"{release.name[:40].rstrip('-.')}-mission-{secrets.token_hex(3)}"
    follower = find_follower(release)
    body = job(release, name, follower, limit=limit, queue=queue)
    with explain_errors("create jobs", release.where):
        created = release.batch.create_namespaced_job(
            release.namespace, body, _request_timeout=REQUEST_TIMEOUT
        )
    owner = {"apiVersion": "batch/v1", "kind": "Job", "name": name, "uid": created.metadata.uid}
    plan = config_map(release, name, mission)
    plan["metadata"]["ownerReferences"] = [owner]  # deleted with the Job
    _create_plan(release, plan)
    return _status(created, None)


def _create_plan(release: Release, plan: Mapping[str, Any]) -> None:
    """Create the ConfigMap. If this fails, delete the Job, which would wait forever."""
    try:
        with explain_errors("create configmaps", release.where):
            release.core.create_namespaced_config_map(
                release.namespace, plan, _request_timeout=REQUEST_TIMEOUT
            )
    except BaseException:  # Ctrl-C too
        with suppress(ClusterError):
            delete_job(release, plan["metadata"]["name"])
        raise


def find_follower(release: Release) -> JobSettings:
    """Read a Job's settings from the release's cloud pod and Services."""
    spec = find_pod(release, "cloud").spec
    teleop = next((c for c in spec.containers if c.name == API_CONTAINER), None)
    if teleop is None:
        raise ClusterError(
            f"release '{release.name}' {release.where} has no container '{API_CONTAINER}': it has "
            "another version of the chart; upgrade it: helm upgrade"
        )
    pull_secrets = tuple(secret.name for secret in spec.image_pull_secrets or [])
    policy = teleop.image_pull_policy or "IfNotPresent"
    deployment = _cloud_deployment(release)
    return JobSettings(
        teleop.image,
        policy,
        pull_secrets,
        _api_url(release),
        secret_name(release),
        _placement(release, deployment),
        _reference(deployment),
    )


def _cloud_deployment(release: Release) -> Any:
    """Find the release's cloud Deployment; None if there is none."""
    with explain_errors("list deployments", release.where):
        found = release.apps.list_namespaced_deployment(
            release.namespace,
            label_selector=release.selector("cloud"),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    return found[0] if found else None


def _reference(deployment: Any) -> dict[str, Any] | None:
    if deployment is None:
        return None
    metadata = deployment.metadata
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "name": metadata.name,
        "uid": metadata.uid,
    }


def _placement(release: Release, deployment: Any) -> dict[str, Any]:
    """Return the keys of a Deployment's pod that select nodes."""
    if deployment is None:
        return {}
    spec = release.apps.api_client.sanitize_for_serialization(deployment.spec.template.spec) or {}
    return {key: spec[key] for key in ("nodeSelector", "tolerations", "affinity") if key in spec}


def _api_url(release: Release) -> str:
    with explain_errors("list services", release.where):
        services = release.core.list_namespaced_service(
            release.namespace,
            label_selector=f"app.kubernetes.io/instance={release.name}",
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    for service in services:
        for port in service.spec.ports or []:
            if port.name == API_PORT_NAME:
                return f"http://{service.metadata.name}:{port.port}"
    raise ClusterError(
        f"release '{release.name}' {release.where} has no Service with a port "
        f"'{API_PORT_NAME}'; install it again: helm upgrade --install"
    )


def list_jobs(release: Release) -> list[JobStatus]:
    """List the Jobs of a release's missions, the oldest first."""
    with explain_errors("list jobs", release.where):
        jobs = release.batch.list_namespaced_job(
            release.namespace,
            label_selector=release.selector(COMPONENT),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    pods = {_owner(pod): pod for pod in list_pods(release, COMPONENT)}
    found = [_status(job, pods.get(job.metadata.uid)) for job in jobs]
    return sorted(found, key=lambda status: status.created)


def read_job(release: Release, name: str) -> JobStatus:
    """Read the state of one Job.

    Raises:
        ClusterError: If there is no such Job.
    """
    with explain_errors("get jobs", release.where):
        job = release.batch.read_namespaced_job(
            name, release.namespace, _request_timeout=REQUEST_TIMEOUT
        )
    return _status(job, pod_of(release, job.metadata.uid))


def delete_job(release: Release, name: str) -> None:
    """Delete a Job with its pod and ConfigMap; a mission that was already posted continues."""
    with explain_errors("delete jobs", release.where):
        release.batch.delete_namespaced_job(
            name,
            release.namespace,
            propagation_policy="Background",
            _request_timeout=REQUEST_TIMEOUT,
        )


def has_started(pod: Any) -> bool:
    """Whether a container of a pod runs or has run."""
    statuses = pod.status.container_statuses or []
    return any(status.state.running or status.state.terminated for status in statuses)


def pod_of(release: Release, uid: str) -> Any:
    """Find the pod of the Job with this UID; None if there is none."""
    pods = list_pods(release, COMPONENT)
    return next((pod for pod in pods if _owner(pod) == uid), None)


def _owner(pod: Any) -> str:
    return str((pod.metadata.labels or {}).get(UID_LABEL, ""))


def _status(job: Any, pod: Any) -> JobStatus:
    ends = {c.type: c for c in job.status.conditions or [] if c.status == "True"}
    exit_code, message = _verdict(pod)
    if "Complete" in ends:
        state = "complete"
    elif "Failed" in ends:
        state, message = "failed", message or _failure(ends["Failed"])
    else:
        state = "flying" if pod is not None and has_started(pod) else "pending"
    created = job.metadata.creation_timestamp
    return JobStatus(
        job.metadata.name,
        str(job.metadata.uid),
        state,
        created.isoformat() if created else "",
        exit_code,
        message,
    )


def _verdict(pod: Any) -> tuple[int | None, str]:
    """Find the exit code and the termination message of the Job's container."""
    for status in (pod.status.container_statuses or []) if pod is not None else []:
        ended = status.state.terminated
        if ended is not None:
            return ended.exit_code, " ".join((ended.message or "").split())
    return None, ""


def _failure(condition: Any) -> str:
    """Describe why Kubernetes ended a Job."""
    if condition.reason == "DeadlineExceeded":
        return "the Job took longer than its activeDeadlineSeconds"
    return f"{condition.reason}: {condition.message}"


def follow_limit(limit: float, queue: bool) -> float:
    """Compute the time after which Kubernetes has ended a Job in any case [s].

    Args:
        limit: Time limit of the mission, as in `run_job` [s].
        queue: Whether the mission may wait for others.
    """
    return deadline(limit, queue) + END_ALLOWANCE


def follow(
    release: Release, name: str, write: Callable[[str], None], *, timeout: float
) -> JobStatus:
    """Follow a Job's log until the Job has ended.

    Args:
        release: Release of the Job.
        name: Name of the Job.
        write: Gets each line of the log once.
        timeout: Time limit [s].

    Returns:
        The final state of the Job.

    Raises:
        ClusterError: If the Job's pod cannot run; the message has the cause.
        ExpiredError: If the Job has not ended in time.
    """
    until, written = time.monotonic() + timeout, 0
    while True:
        status, lines = retry(lambda: _read_job_and_log(release, name), write)
        for line in lines[written:]:
            write(line)
        written = max(written, len(lines))
        if status.state in ("complete", "failed"):
            return status
        if status.state == "pending":
            retry(partial(_check_can_start, release, status), write)
        if time.monotonic() > until:
            raise ExpiredError(
                f"Job '{name}' has not ended within {timeout:g} s; it continues; "
                f"see: cloudrc mission status {name} {' '.join(release.cloudrc_flags)}"
            )
        time.sleep(LOOK_PERIOD)


def _read_job_and_log(release: Release, name: str) -> tuple[JobStatus, list[str]]:
    status = read_job(release, name)
    return status, _log(release, status.uid)


def logs(release: Release, name: str) -> list[str]:
    """Read the log of a Job.

    Raises:
        ClusterError: If there is no such Job.
    """
    return _log(release, read_job(release, name).uid)


def _log(release: Release, uid: str) -> list[str]:
    pod = pod_of(release, uid)
    if pod is None or not has_started(pod):
        return []
    with explain_errors("get pods/log", release.where):
        text: str = release.core.read_namespaced_pod_log(
            pod.metadata.name, release.namespace, _request_timeout=READ_LIMIT
        )
    return text.splitlines()


def _check_can_start(release: Release, status: JobStatus) -> None:
    """Raise a ClusterError if the Job's pod will never run."""
    pod = pod_of(release, status.uid)
    if pod is None:
        why = refusal(release, "Job", status.name)
    else:
        why = pod_failure(pod) or missing_secret(release, pod)
    if why:
        raise ClusterError(
            f"Job '{status.name}' cannot start: {why}; then delete the Job: "
            f"kubectl {' '.join(release.flags)} delete job {status.name}"
        )


def cancel(release: Release, name: str, token: str | None = None) -> str:
    """Cancel the mission of a Job; delete a Job that has not posted its mission yet.

    Args:
        release: Release that flies the mission.
        name: Name of the Job.
        token: Token of an operator; None to read the token from the release's Secret.

    Returns:
        The result in words.

    Raises:
        ClusterError: If there is no such Job, or the API does not answer although the pod runs.
    """
    status = read_job(release, name)
    if status.state in ("complete", "failed"):
        return f"Job '{name}' has ended already: {status.message or status.state}"
    pod = _running_cloud(release)
    if not pod:
        delete_job(release, name)
        command = f"cloudrc mission cancel {' '.join(release.cloudrc_flags)}"
        return (
            f"Job '{name}' is deleted; no cloud pod runs: a mission that it has posted continues "
            f"when one runs; cancel it then: {command}"
        )
    token = token or operator_token(release)
    with forwarded(release, pod, [API_PORT]) as ports:
        api = f"http://127.0.0.1:{ports[API_PORT]}/v1/missions"
        missions = _ask(api, token)["missions"]
        found = next((m for m in missions if m["key"] == status.uid), None)
        if found is not None:
            _ask(f"{api}/{found['id']}/cancel", token, post=True)
            return f"mission {found['id']} ({found['name']}) of Job '{name}' is cancelled"
    delete_job(release, name)
    return f"Job '{name}' is deleted; it had not posted its mission"


def current_mission(release: Release) -> tuple[str, str]:
    """Find the mission that flies, or will fly next, on a release.

    Args:
        release: The release; it need not exist.

    Returns:
        The mission in words, "" if no mission is known; and the name of the mission's Job, "" if
        the Job is unknown.

    Raises:
        ClusterError: If the cluster does not list the Jobs.
    """
    jobs = [job.name for job in list_jobs(release) if job.state in ("pending", "flying")]
    if jobs:
        return f"Job '{jobs[0]}'", jobs[0]
    pod = _running_cloud(release)
    if not pod:
        return "", ""
    try:
        token = operator_token(release)
        with forwarded(release, pod, [API_PORT]) as ports:
            missions = _ask(f"http://127.0.0.1:{ports[API_PORT]}/v1/missions", token)["missions"]
    except (ClusterError, ExpiredError):
        return "", ""  # unknown: a broken release must not prevent its own repair by an install
    ended = ("done", "failed", "cancelled")
    found = next((m["id"] for m in missions if m["state"] not in ended), None)
    return (f"mission {found}" if found else ""), ""


def _running_cloud(release: Release) -> str:
    """Return the name of the newest running cloud pod; "" if no cloud pod runs."""
    pods = list_pods(release, "cloud")
    return next((str(pod.metadata.name) for pod in pods if pod.status.phase == "Running"), "")


def _ask(url: str, token: str, *, post: bool = False) -> Any:
    headers = {"Authorization": f"Bearer {token}"}
    request = urllib.request.Request(url, headers=headers, method="POST" if post else "GET")
    try:
        with NO_PROXY.open(request, timeout=ANSWER_LIMIT) as answer:
            return json.loads(answer.read() or b"null")
    except urllib.error.HTTPError as error:
        answer_text = error.read().decode(errors="replace")
        raise ClusterError(f"the API refuses ({error.code}): {answer_text}") from error
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise ClusterError(f"the API does not answer: {error}") from error
