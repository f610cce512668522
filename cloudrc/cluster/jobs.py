"""Missions as Jobs: a mission comes in; a Job posts it, and how it stands goes out."""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from cloudrc.cluster import manifest
from cloudrc.cluster.access import REQUEST_TIMEOUT, Release
from cloudrc.cluster.errors import ClusterError, explained
from cloudrc.cluster.pods import find_pod, list_pods
from cloudrc.cluster.tokens import secret_name

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
    # A pod is named for its Job, and no name is longer than 63 characters.
    name = name or f"{release.name[:40].rstrip('-.')}-mission-{secrets.token_hex(3)}"
    follower = find_follower(release)
    body = manifest.job(release, name, follower, limit=limit, queue=queue)
    with explained("create jobs", release.where):
        created = release.batch.create_namespaced_job(
            release.namespace, body, _request_timeout=REQUEST_TIMEOUT
        )
    owner = {"apiVersion": "batch/v1", "kind": "Job", "name": name, "uid": created.metadata.uid}
    plan = manifest.config_map(release, name, mission)
    plan["metadata"]["ownerReferences"] = [owner]  # the plan goes when the Job goes
    _create_plan(release, plan)
    return _status(created, None)


def _create_plan(release: Release, plan: Mapping[str, Any]) -> None:
    """Create the ConfigMap; without it the Job would wait for it in vain, and goes too."""
    try:
        with explained("create configmaps", release.where):
            release.core.create_namespaced_config_map(
                release.namespace, plan, _request_timeout=REQUEST_TIMEOUT
            )
    except BaseException:  # Ctrl-C too
        with suppress(ClusterError):
            delete_job(release, plan["metadata"]["name"])
        raise


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
    home = _home(release)
    return manifest.Follower(
        teleop.image,
        policy,
        pull_secrets,
        _api_url(release),
        secret_name(release),
        _placement(release, home),
        _reference(home),
    )


def _home(release: Release) -> Any:
    """The release's cloud Deployment; None if what runs is of nobody."""
    with explained("list deployments", release.where):
        found = release.apps.list_namespaced_deployment(
            release.namespace,
            label_selector=release.selector("cloud"),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    return found[0] if found else None


def _reference(home: Any) -> dict[str, Any] | None:
    if home is None:
        return None
    metadata = home.metadata
    return {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "name": metadata.name,
        "uid": metadata.uid,
    }


def _placement(release: Release, home: Any) -> dict[str, Any]:
    """Where the release may run, as it was written."""
    if home is None:
        return {}
    spec = release.apps.api_client.sanitize_for_serialization(home.spec.template.spec) or {}
    return {key: spec[key] for key in ("nodeSelector", "tolerations", "affinity") if key in spec}


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
    return _status(job, pod_of(release, job.metadata.uid))


def delete_job(release: Release, name: str) -> None:
    """Delete a Job with its pod and its plan; what it has posted flies on unless cancelled."""
    with explained("delete jobs", release.where):
        release.batch.delete_namespaced_job(
            name,
            release.namespace,
            propagation_policy="Background",
            _request_timeout=REQUEST_TIMEOUT,
        )


def has_started(pod: Any) -> bool:
    """Say whether a container of a pod runs or has run."""
    statuses = pod.status.container_statuses or []
    return any(status.state.running or status.state.terminated for status in statuses)


def pod_of(release: Release, uid: str) -> Any:
    """Find the pod of the Job of this UID; None if there is none."""
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
