"""The pods of a release: a component comes in, its pod, or why it does not run, goes out."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Any

from cloudrc.cluster.access import REQUEST_TIMEOUT, Release
from cloudrc.cluster.errors import ClusterError, explained

FATAL = {
    "ErrImagePull": "image",
    "ImagePullBackOff": "image",
    "ErrImageNeverPull": "image",
    "InvalidImageName": "image",
    "CreateContainerConfigError": "configuration",
    "CreateContainerError": "configuration",
    "RunContainerError": "configuration",
    "CrashLoopBackOff": "crash",
    "Error": "crash",
}
"""Why a container does not run and never will by waiting -> what kind of mistake that is."""
SECRETS = {
    "secret": ("key", "head -c 32 /dev/urandom"),
    "tokens": ("operator", "openssl rand -hex 32"),
}
"""Volume of the chart's pods -> file that its Secret has to have, and what makes one."""
RESTARTS_MAX = 2
"""A container that ended more often than this is not about to settle."""


def list_pods(release: Release, component: str) -> list[Any]:
    """List the pods of a component that are not about to end, the newest first."""
    with explained("list pods", release.where):
        found = release.core.list_namespaced_pod(
            release.namespace,
            label_selector=release.selector(component),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    alive = [pod for pod in found if pod.metadata.deletion_timestamp is None]
    return sorted(alive, key=lambda pod: str(pod.metadata.creation_timestamp), reverse=True)


def find_pod(release: Release, component: str) -> Any:
    """Find the newest running pod of a component.

    Raises:
        ClusterError: If there is none; says whether the release is there at all.
    """
    pods = list_pods(release, component)
    for pod in pods:
        if pod.status.phase == "Running":
            return pod
    if pods:
        why = trouble(pods[0]) or f"it is {pods[0].status.phase}"
        raise ClusterError(
            f"the {component} pod of release '{release.name}' does not run: {why}; "
            f"see: kubectl {' '.join(release.flags)} describe pod {pods[0].metadata.name}"
        )
    raise _no_release(release)


def require_release(release: Release) -> None:
    """Make sure that there is a release, whether or not its pods run.

    Raises:
        ClusterError: If there is none; says how to install it.
    """
    with explained("list deployments", release.where):
        found = release.apps.list_namespaced_deployment(
            release.namespace,
            label_selector=release.selector("cloud"),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    if not found:
        raise _no_release(release)


def _no_release(release: Release) -> ClusterError:
    return ClusterError(
        f"no release '{release.name}' {release.where}; install it: "
        f"helm install {release.name} charts/cloudrc {' '.join(release.helm_flags)}, "
        "or name another: --release NAME -n NAMESPACE"
    )


def is_ready(pod: Any) -> bool:
    """Say whether all of a pod's containers are ready."""
    conditions = pod.status.conditions or []
    return any(c.type == "Ready" and c.status == "True" for c in conditions)


def trouble(pod: Any) -> str | None:
    """Say in one sentence why a pod will not run by waiting; None if it may."""
    for status in _containers(pod):
        why = _container_trouble(status)
        if why:
            return why
    for condition in pod.status.conditions or []:
        if condition.type == "PodScheduled" and condition.status == "False":
            return None if _binds_soon(condition) else f"no node takes it: {condition.message}"
    return None


def refusal(release: Release, kind: str, name: str) -> str | None:
    """Say why the cluster does not make an object's pod: Pod Security, a quota; None if it may."""
    refused = _events(release, kind, name, "FailedCreate")
    return refused[-1] if refused else None


def missing_secret(release: Release, pod: Any) -> str | None:
    """Say which Secret a pod waits for that is not there, and what makes it; None if for none."""
    if any(status.state.running or status.state.terminated for status in _containers(pod)):
        return None
    said: list[str] = []
    with suppress(ClusterError):  # who may not read events may still fly
        said = _events(release, "Pod", pod.metadata.name, "FailedMount")
    for words in said:
        found = re.search(r'volume "(secret|tokens)".* secret "([^"]+)" not found', words)
        if found and not _has_secret(release, found[2]):
            file, content = SECRETS[found[1]]
            return (
                f"there is no Secret '{found[2]}'; make it: {content} >{file} && kubectl "
                f"{' '.join(release.flags)} create secret generic {found[2]} --from-file={file}"
            )
    return None


def _has_secret(release: Release, name: str) -> bool:
    """Events outlive their cause: the kubelet looks again after up to two minutes."""
    with suppress(ClusterError), explained("get secrets", release.where):
        release.core.read_namespaced_secret(
            name, release.namespace, _request_timeout=REQUEST_TIMEOUT
        )
        return True
    return False


def _events(release: Release, kind: str, name: str, reason: str) -> list[str]:
    """What was told of an object for this reason."""
    with explained("list events", release.where):
        events = release.core.list_namespaced_event(
            release.namespace,
            field_selector=f"involvedObject.kind={kind},involvedObject.name={name}",
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    return [event.message for event in events if event.reason == reason]


def _binds_soon(condition: Any) -> bool:
    """A volume that is made on first use is no reason to give up."""
    return "volume" in (condition.message or "") and "unbound" in (condition.message or "")


def _containers(pod: Any) -> list[Any]:
    return [*(pod.status.init_container_statuses or []), *(pod.status.container_statuses or [])]


def _container_trouble(status: Any) -> str | None:
    waiting = getattr(status.state, "waiting", None)
    kind = FATAL.get(waiting.reason) if waiting else None
    if waiting and kind == "image":
        return (
            f"the image {status.image} of container '{status.name}' is not on the node and cannot "
            f"be pulled ({waiting.reason}); load it: make kind-load, or name another: "
            "--set image.registry=... --set image.tag=..."
        )
    if waiting and kind == "configuration":
        return (
            f"container '{status.name}' cannot be made: {' '.join((waiting.message or '').split())}"
        )
    if kind == "crash" or (status.restart_count or 0) > RESTARTS_MAX:
        return f"container '{status.name}' ends again and again{_last_end(status)}"
    return None


def _last_end(status: Any) -> str:
    """What the container said when it last ended, if it left a message."""
    ended = getattr(status.last_state, "terminated", None)
    if ended is None:
        return ""
    said = " ".join((ended.message or "").split())
    return f" (exit code {ended.exit_code}): {said}" if said else f" (exit code {ended.exit_code})"
