"""Missions as Jobs: a mission comes in; a Job posts it, and its lines and its verdict go out."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from cloudrc.cluster import manifest
from cloudrc.cluster.access import REQUEST_TIMEOUT, Release
from cloudrc.cluster.errors import ClusterError, WaitedTooLongError, explained
from cloudrc.cluster.pods import find_pod, list_pods, refusal, trouble

LOOK_PERIOD = 0.5
"""Between two looks at a Job [s]."""
READ_LIMIT = 30.0
"""For a log to say anything before the Job itself is looked at again [s]."""
API_CONTAINER = "teleop"
API_PORT_NAME = "api"


@dataclass(frozen=True, slots=True)
class JobStatus:
    """How a mission's Job stands.

    Attributes:
        name: Of the Job.
        uid: Of the Job: the key under which the API knows the mission.
        state: "pending", "flying", "complete" or "failed".
        created: When, as the cluster's clock wrote it (RFC 3339).
        exit_code: Of its container; None until it has ended.
        message: The verdict in words; "" until there is one.
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
    """Create the Job of a mission; it flies whether or not anybody follows it.

    Args:
        release: To fly on.
        mission: As the API takes it: name, start, time_limit_s, waypoints.
        name: Of the Job; default: one that is free.
        limit: The mission's own limit of time [s].
        queue: Whether to wait where another mission flies, in place of being refused.

    Returns:
        The Job as created.

    Raises:
        ClusterError: If the cluster refuses, or there is no such release.
    """
    name = name or f"{release.name}-mission-{secrets.token_hex(3)}"
    follower = find_follower(release)
    body = manifest.job(release, name, follower, limit=limit, queue=queue)
    with explained("create jobs", release.where):
        created = release.batch.create_namespaced_job(
            release.namespace, body, _request_timeout=REQUEST_TIMEOUT
        )
    owner = {"apiVersion": "batch/v1", "kind": "Job", "name": name, "uid": created.metadata.uid}
    plan = manifest.config_map(release, name, mission)
    plan["metadata"]["ownerReferences"] = [owner]  # the plan goes when the Job goes
    with explained("create configmaps", release.where):
        release.core.create_namespaced_config_map(
            release.namespace, plan, _request_timeout=REQUEST_TIMEOUT
        )
    return _status(created, None)


def find_follower(release: Release) -> manifest.Follower:
    """Learn from the release's own cloud pod which image a Job needs and where the API is."""
    spec = find_pod(release, "cloud").spec
    teleop = next((c for c in spec.containers if c.name == API_CONTAINER), None)
    if teleop is None:
        raise ClusterError(
            f"release '{release.name}' {release.where} has no container '{API_CONTAINER}': it is "
            "of another version; upgrade it: helm upgrade"
        )
    pull_secrets = tuple(secret.name for secret in spec.image_pull_secrets or [])
    policy = teleop.image_pull_policy or "IfNotPresent"
    return manifest.Follower(teleop.image, policy, pull_secrets, _api_url(release))


def _api_url(release: Release) -> str:
    with explained("list services", release.where):
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
    """List the missions' Jobs of a release, the oldest first."""
    with explained("list jobs", release.where):
        jobs = release.batch.list_namespaced_job(
            release.namespace,
            label_selector=release.selector(manifest.COMPONENT),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    pods = {_owner(pod): pod for pod in list_pods(release, manifest.COMPONENT)}
    found = [_status(job, pods.get(job.metadata.uid)) for job in jobs]
    return sorted(found, key=lambda status: status.created)


def read_job(release: Release, name: str) -> JobStatus:
    """Look at one Job.

    Raises:
        ClusterError: If there is no such Job.
    """
    with explained("get jobs", release.where):
        job = release.batch.read_namespaced_job(
            name, release.namespace, _request_timeout=REQUEST_TIMEOUT
        )
    return _status(job, _pod_of(release, job.metadata.uid))


def delete_job(release: Release, name: str) -> None:
    """Delete a Job with its pod and its plan; what it has posted flies on unless cancelled."""
    with explained("delete jobs", release.where):
        release.batch.delete_namespaced_job(
            name,
            release.namespace,
            propagation_policy="Background",
            _request_timeout=REQUEST_TIMEOUT,
        )


def follow(
    release: Release, name: str, write: Callable[[str], None], *, timeout: float
) -> JobStatus:
    """Pass on what a Job says, line by line, until it has ended.

    Args:
        release: Where the Job is.
        name: Of the Job.
        write: Gets each line of its log once.
        timeout: How long to follow at most [s].

    Returns:
        The Job's end.

    Raises:
        ClusterError: If the Job's pod cannot run; says why.
        WaitedTooLongError: If it has not ended in time.
    """
    until, told = time.monotonic() + timeout, 0
    while True:
        status = read_job(release, name)
        lines = _log(release, status.uid)
        for line in lines[told:]:
            write(line)
        told = max(told, len(lines))
        if status.state in ("complete", "failed"):
            return status
        if status.state == "pending":
            _refuse_hopeless(release, status)
        if time.monotonic() > until:
            raise WaitedTooLongError(
                f"Job '{name}' has not ended within {timeout:g} s, it goes on; "
                f"look: cloudrc mission status {name}"
            )
        time.sleep(LOOK_PERIOD)


def logs(release: Release, name: str) -> list[str]:
    """Read what a Job has said so far.

    Raises:
        ClusterError: If there is no such Job.
    """
    return _log(release, read_job(release, name).uid)


def _log(release: Release, uid: str) -> list[str]:
    pod = _pod_of(release, uid)
    if pod is None or not _has_started(pod):
        return []
    with explained("get pods/log", release.where):
        text: str = release.core.read_namespaced_pod_log(
            pod.metadata.name, release.namespace, _request_timeout=READ_LIMIT
        )
    return text.splitlines()


def _has_started(pod: Any) -> bool:
    statuses = pod.status.container_statuses or []
    return any(status.state.running or status.state.terminated for status in statuses)


def _refuse_hopeless(release: Release, status: JobStatus) -> None:
    pod = _pod_of(release, status.uid)
    why = trouble(pod) if pod is not None else refusal(release, "Job", status.name)
    if why:
        raise ClusterError(
            f"Job '{status.name}' cannot start: {why}; then delete it: "
            f"kubectl {' '.join(release.flags)} delete job {status.name}"
        )


def _pod_of(release: Release, uid: str) -> Any:
    pods = list_pods(release, manifest.COMPONENT)
    return next((pod for pod in pods if _owner(pod) == uid), None)


def _owner(pod: Any) -> str:
    return str((pod.metadata.labels or {}).get(manifest.UID_LABEL, ""))


def _status(job: Any, pod: Any) -> JobStatus:
    ends = {c.type: c for c in job.status.conditions or [] if c.status == "True"}
    exit_code, message = _verdict(pod)
    if "Complete" in ends:
        state = "complete"
    elif "Failed" in ends:
        state, message = "failed", message or _failure(ends["Failed"])
    else:
        state = "flying" if pod is not None and _has_started(pod) else "pending"
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
    """Exit code and termination message of the Job's container."""
    for status in (pod.status.container_statuses or []) if pod is not None else []:
        ended = status.state.terminated
        if ended is not None:
            return ended.exit_code, " ".join((ended.message or "").split())
    return None, ""


def _failure(condition: Any) -> str:
    """Why Kubernetes itself gave a Job up."""
    if condition.reason == "DeadlineExceeded":
        return "the Job took longer than its activeDeadlineSeconds"
    return f"{condition.reason}: {condition.message}"
