"""Install a release on the cluster and wait until both pods are ready."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cloudrc.cluster.client import REQUEST_TIMEOUT, Release
from cloudrc.cluster.pods import is_ready, list_pods, missing_secret, pod_failure
from cloudrc.cluster.tools import ClusterError, ExpiredError, explain_errors, retry, run

COMPONENTS = ("world", "cloud")
LOOK_PERIOD = 1.0
"""Time between two looks at the pods [s]."""
HELM_LIMIT = 120.0
"""Time limit for one helm command [s]; helm does not wait for pods."""
HINTS = {
    "cluster unreachable": "is the cluster up? ask it: kubectl cluster-info",
    "incompatible with Kubernetes": "make a newer one: kind create cluster",
    "forbidden": "ask for the permission, and check it: kubectl auth can-i --list",
    "another operation": "end that one first: helm history, then helm rollback",
    "the specifications of the schema": "see what there is: helm show values charts/cloudrc",
    "already exists": "is it another release's? see: helm list --all-namespaces",
}
"""Words in an error message of helm -> what to do next."""
FAILURE_TIME = 5.0
"""A failure is reported if it lasts longer than this [s]; a Secret may appear after its pod."""


def install(
    release: Release,
    chart: Path,
    values: Mapping[str, Any],
    *,
    extra: Sequence[str] = (),
    timeout: float = 300.0,
    tell: Callable[[str], None] = lambda text: None,
) -> None:
    """Install or upgrade a release and wait until it is ready to fly.

    Args:
        release: Name and place; a missing namespace is created.
        chart: Folder of the chart.
        values: Values that override the chart's defaults.
        extra: More arguments of helm, such as `--set=...`.
        timeout: Time limit for the pods to become ready [s].
        tell: Gets a line about each change of the pods' state.

    Raises:
        CloudrcError: If helm or the cluster refuses, or if a pod cannot run. The message is one
            sentence.
    """
    arguments = ["upgrade", "--install", release.name, str(chart), *release.helm_flags]
    arguments += ["--create-namespace", "--values=-", *extra]
    _helm(arguments, given=json.dumps(values))
    wait_ready(release, timeout=timeout, tell=tell)


def current_values(release: Release) -> dict[str, Any]:
    """Read the values with which a release was installed; empty if the release does not exist.

    Raises:
        CloudrcError: If helm or the cluster refuses.
    """
    arguments = ["list", "--output=json", f"--filter=^{release.name}$", *release.helm_flags]
    if not json.loads(_helm(arguments) or "[]"):
        return {}
    arguments = ["get", "values", release.name, "--output=json", *release.helm_flags]
    return json.loads(_helm(arguments)) or {}


def _helm(arguments: Sequence[str], given: str = "") -> str:
    """Run helm, and add a hint to helm's error message."""
    try:
        return run("helm", arguments, timeout=HELM_LIMIT, given=given)
    except ClusterError as error:
        message = str(error)
        hint = next((hint for words, hint in HINTS.items() if words in message), "")
        raise ClusterError(f"{message}; {hint}" if hint else message) from error


def wait_ready(
    release: Release, *, timeout: float, tell: Callable[[str], None] = lambda text: None
) -> None:
    """Wait until both pods of a release have its newest version and are ready.

    Args:
        release: The release.
        timeout: Time limit [s].
        tell: Gets a line about each change of the pods' state.

    Raises:
        ClusterError: If a pod will never run; the message has the cause.
        ExpiredError: If the pods are not ready in time; the message has their states.
    """
    until, failing_since, last = time.monotonic() + timeout, None, ""
    while True:
        states = retry(lambda: {each: _state(release, each) for each in COMPONENTS}, tell)
        waiting = {component: why for component, (why, _) in states.items() if why}
        if not waiting:
            return
        now = time.monotonic()
        fatal = [f"the {c} pod cannot run: {w}" for c, (w, bad) in states.items() if bad]
        failing_since = (failing_since or now) if fatal else None
        if failing_since is not None and now - failing_since >= FAILURE_TIME:
            raise ClusterError(f"{'; '.join(fatal)}; see: {_describe(release)}")
        words = "; ".join(f"{component}: {why}" for component, why in waiting.items())
        if now > until:
            raise ExpiredError(
                f"release '{release.name}' is not ready after {timeout:g} s: {words}; "
                f"see: {_describe(release)}, or wait longer: --timeout"
            )
        if words != last:
            tell(words)
            last = words
        time.sleep(LOOK_PERIOD)


def _describe(release: Release) -> str:
    selector = f"app.kubernetes.io/instance={release.name}"
    return f"kubectl {' '.join(release.flags)} describe pods -l {selector}"


def _state(release: Release, component: str) -> tuple[str, bool]:
    """Describe why a component is not ready, "" if it is ready; and whether waiting is useless."""
    deployment = _deployment(release, component)
    refused = _refusal(deployment)
    if refused:
        return refused, True
    pods = list_pods(release, component)
    for pod in pods:
        why = pod_failure(pod) or missing_secret(release, pod)
        if why:
            return why, True
    status = deployment.status
    current = (status.observed_generation or 0) >= deployment.metadata.generation
    settled = current and status.updated_replicas == 1 and status.replicas == 1
    if not settled or not pods:
        return "its pod is being created", False
    return ("", False) if is_ready(pods[0]) else (_not_ready(pods[0]), False)


def _deployment(release: Release, component: str) -> Any:
    with explain_errors("list deployments", release.where):
        found = release.apps.list_namespaced_deployment(
            release.namespace,
            label_selector=release.selector(component),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    if not found:
        raise ClusterError(
            f"release '{release.name}' {release.where} has no Deployment '{component}': "
            "is it a release of cloudrc? see: helm list --all-namespaces"
        )
    return found[0]


def _refusal(deployment: Any) -> str:
    """Return why the cluster does not create the pod, for example Pod Security or a quota."""
    for condition in deployment.status.conditions or []:
        if condition.type == "ReplicaFailure" and condition.status == "True":
            return str(condition.message)
    return ""


def _not_ready(pod: Any) -> str:
    statuses = [*(pod.status.init_container_statuses or []), *(pod.status.container_statuses or [])]
    waiting = [status.name for status in statuses if not status.ready]
    return f"container {' and '.join(waiting)} is not ready yet" if waiting else "not ready yet"
