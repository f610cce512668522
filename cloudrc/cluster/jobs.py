"""Missions as Jobs: a mission comes in; a Job posts it, and how it stands goes out.

A mission as Kubernetes objects: mission, release and image come in, Job and ConfigMap go out.

The same objects as `charts/cloudrc/examples/mission-job.yaml` shows by hand.

A Job followed to its end: its name comes in; its lines, its verdict or its trouble go out.

Missions from outside: a Job's name comes in and it ends; or a release, and what it flies.
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
    DIRECTLY,
    OPERATOR,
    VOLUME,
    find_pod,
    forwarded,
    list_pods,
    missing_secret,
    operator_token,
    refusal,
    secret_name,
    trouble,
)
from cloudrc.cluster.tools import ClusterError, WaitedTooLongError, explained, insist

COMPONENT = "mission"
FOLDER = "/etc/cloudrc-mission"
FILE = "mission.yaml"
TOKENS = "/etc/cloudrc-tokens"
KEY = "MISSION_KEY"
UID_LABEL = "batch.kubernetes.io/controller-uid"
"""Kubernetes puts the Job's UID under it on the Job's pod."""
START_ALLOWANCE = 120
"""Beyond the mission's own limit, for the pod to start and the robot to be seen [s]."""
QUEUE_ALLOWANCE = 3600
"""Beyond that, for the missions before it to end, where it waits in the queue [s]."""
DEADLINE_MAX = 2**31 - 1
"""What Kubernetes takes [s]."""
KEEP = 3600
"""How long a finished Job stays to be looked at [s]."""
USER = 10001


@dataclass(frozen=True)
class Follower:
    """What runs in the Job's container.

    Attributes:
        image: Image with cloudrc in it: that of the release's teleop container.
        pull_policy: Of that image.
        pull_secrets: Names of Secrets for the image's registry.
        api: URL of the release's API inside the cluster.
        tokens: Name of the Secret with the API's tokens.
        placement: `nodeSelector`, `tolerations` and `affinity` of the release's cloud pod.
        owner: Reference to the release's cloud Deployment: missions go when the release goes.
    """

    image: str
    pull_policy: str
    pull_secrets: tuple[str, ...]
    api: str
    tokens: str
    placement: Mapping[str, Any] = field(default_factory=dict)
    owner: Mapping[str, Any] | None = None


def labels(release: Release) -> dict[str, str]:
    """Label what belongs to a mission of a release; the NetworkPolicies go by it."""
    return {
        "app.kubernetes.io/name": "cloudrc",
        "app.kubernetes.io/instance": release.name,
        "app.kubernetes.io/component": COMPONENT,
        "app.kubernetes.io/part-of": "cloudrc",
        "app.kubernetes.io/managed-by": "cloudrc",
    }


def config_map(release: Release, name: str, mission: Mapping[str, Any]) -> dict[str, Any]:
    """Put the mission into a ConfigMap of the Job's name.

    Args:
        release: Whose mission it is.
        name: Of Job and ConfigMap.
        mission: As the API takes it; JSON is YAML too.
    """
    return {
        "apiVersion": "v1",
        "kind": "ConfigMap",
        "metadata": {"name": name, "labels": labels(release)},
        "data": {FILE: json.dumps(mission, indent=2) + "\n"},
    }


def deadline(limit: float, queue: bool) -> int:
    """Say how long a Job may last [s].

    Args:
        limit: The mission's own limit of time [s].
        queue: Whether it may have to wait for others.
    """
    return min(ceil(limit) + START_ALLOWANCE + queue * QUEUE_ALLOWANCE, DEADLINE_MAX)


def job(
    release: Release, name: str, follower: Follower, *, limit: float, queue: bool
) -> dict[str, Any]:
    """Make the Job that posts the mission, follows it and ends with its verdict.

    Args:
        release: Whose mission it is.
        name: Of Job and ConfigMap.
        follower: What runs in it.
        limit: The mission's own limit of time [s].
        queue: Whether to wait where another mission flies, in place of being refused.
    """
    owners = [dict(follower.owner)] if follower.owner else []
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"name": name, "labels": labels(release), "ownerReferences": owners},
        "spec": {
            # The mission is posted under the Job's UID: a second try would only read its verdict.
            "backoffLimit": 0,
            "activeDeadlineSeconds": deadline(limit, queue),
            "ttlSecondsAfterFinished": KEEP,
            "template": {
                "metadata": {"labels": labels(release)},
                "spec": _pod(name, follower, queue),
            },
        },
    }


def _pod(name: str, follower: Follower, queue: bool) -> dict[str, Any]:
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
            {"name": VOLUME, "secret": _operators_alone(follower.tokens)},
        ],
    }


def _operators_alone(secret: str) -> dict[str, Any]:
    return {
        "secretName": secret,
        "defaultMode": 0o440,
        "items": [{"key": OPERATOR, "path": OPERATOR}],
    }


def _container(follower: Follower, queue: bool) -> dict[str, Any]:
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
    body = job(release, name, follower, limit=limit, queue=queue)
    with explained("create jobs", release.where):
        created = release.batch.create_namespaced_job(
            release.namespace, body, _request_timeout=REQUEST_TIMEOUT
        )
    owner = {"apiVersion": "batch/v1", "kind": "Job", "name": name, "uid": created.metadata.uid}
    plan = config_map(release, name, mission)
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


def find_follower(release: Release) -> Follower:
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
    return Follower(
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
            label_selector=release.selector(COMPONENT),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    pods = {_owner(pod): pod for pod in list_pods(release, COMPONENT)}
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


LOOK_PERIOD = 0.5
"""Between two looks at a Job [s]."""
READ_LIMIT = 30.0
"""For a log to say anything before the Job itself is looked at again [s]."""
END_ALLOWANCE = 60.0
"""For Kubernetes to end a Job that is past its deadline [s]."""


def patience(limit: float, queue: bool) -> float:
    """Say how long to follow a Job: until Kubernetes itself has ended it [s].

    Args:
        limit: As given to `run_job` [s].
        queue: Likewise.
    """
    return deadline(limit, queue) + END_ALLOWANCE


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
        status, lines = insist(lambda: _look(release, name), write)
        for line in lines[told:]:
            write(line)
        told = max(told, len(lines))
        if status.state in ("complete", "failed"):
            return status
        if status.state == "pending":
            insist(partial(_refuse_hopeless, release, status), write)
        if time.monotonic() > until:
            raise WaitedTooLongError(
                f"Job '{name}' has not ended within {timeout:g} s, it goes on; "
                f"look: cloudrc mission status {name} {' '.join(release.cloudrc_flags)}"
            )
        time.sleep(LOOK_PERIOD)


def _look(release: Release, name: str) -> tuple[JobStatus, list[str]]:
    status = read_job(release, name)
    return status, _log(release, status.uid)


def logs(release: Release, name: str) -> list[str]:
    """Read what a Job has said so far.

    Raises:
        ClusterError: If there is no such Job.
    """
    return _log(release, read_job(release, name).uid)


def _log(release: Release, uid: str) -> list[str]:
    pod = pod_of(release, uid)
    if pod is None or not has_started(pod):
        return []
    with explained("get pods/log", release.where):
        text: str = release.core.read_namespaced_pod_log(
            pod.metadata.name, release.namespace, _request_timeout=READ_LIMIT
        )
    return text.splitlines()


def _refuse_hopeless(release: Release, status: JobStatus) -> None:
    pod = pod_of(release, status.uid)
    if pod is None:
        why = refusal(release, "Job", status.name)
    else:
        why = trouble(pod) or missing_secret(release, pod)
    if why:
        raise ClusterError(
            f"Job '{status.name}' cannot start: {why}; then delete it: "
            f"kubectl {' '.join(release.flags)} delete job {status.name}"
        )


ANSWER_LIMIT = 10.0
"""For the API to answer [s]."""


def cancel(release: Release, name: str, token: str | None = None) -> str:
    """Cancel the mission of a Job, or the Job itself where it has not posted its mission yet.

    Args:
        release: Where it flies.
        name: Of the Job.
        token: Of an operator; None to read the release's own.

    Returns:
        What was done, in words.

    Raises:
        ClusterError: If there is no such Job, or the API of a pod that runs does not answer.
    """
    status = read_job(release, name)
    if status.state in ("complete", "failed"):
        return f"Job '{name}' has ended already: {status.message or status.state}"
    pod = _running_cloud(release)
    if not pod:
        delete_job(release, name)
        end = f"cloudrc mission cancel {' '.join(release.cloudrc_flags)}"
        return (
            f"Job '{name}' is deleted; no cloud pod runs now: if its mission was posted before, "
            f"it goes on when one does, then: {end}"
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
    return f"Job '{name}' had not posted its mission: deleted"


def under_way(release: Release) -> tuple[str, str]:
    """Say what flies on a release, or is about to.

    Args:
        release: Which need not be there yet.

    Returns:
        It in words, "" if nothing is known to fly; and the name of its Job, "" if it is not known.

    Raises:
        ClusterError: If the cluster does not say which Jobs there are.
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
    except (ClusterError, WaitedTooLongError):
        return "", ""  # a release that is broken may be mended by installing it again
    ended = ("done", "failed", "cancelled")
    found = next((m["id"] for m in missions if m["state"] not in ended), None)
    return (f"mission {found}" if found else ""), ""


def _running_cloud(release: Release) -> str:
    """Name the newest cloud pod that runs; "" if none does."""
    pods = list_pods(release, "cloud")
    return next((str(pod.metadata.name) for pod in pods if pod.status.phase == "Running"), "")


def _ask(url: str, token: str, *, post: bool = False) -> Any:
    headers = {"Authorization": f"Bearer {token}"}
    request = urllib.request.Request(url, headers=headers, method="POST" if post else "GET")
    try:
        with DIRECTLY.open(request, timeout=ANSWER_LIMIT) as answer:
            return json.loads(answer.read() or b"null")
    except urllib.error.HTTPError as error:
        said = error.read().decode(errors="replace")
        raise ClusterError(f"the API refuses ({error.code}): {said}") from error
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise ClusterError(f"the API does not answer: {error}") from error
