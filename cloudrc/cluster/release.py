"""Puts a release on the cluster: values come in, both pods run, or why they do not is said."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cloudrc.cluster.client import REQUEST_TIMEOUT, Release
from cloudrc.cluster.pods import is_ready, list_pods, missing_secret, trouble
from cloudrc.cluster.tools import ClusterError, WaitedTooLongError, explained, insist, run

COMPONENTS = ("world", "cloud")
LOOK_PERIOD = 1.0
"""Between two looks at the pods [s]."""
HELM_LIMIT = 120.0
"""For helm to hand everything over; it does not wait for pods [s]."""
HINTS = {
    "cluster unreachable": "is the cluster up? ask it: kubectl cluster-info",
    "incompatible with Kubernetes": "make a newer one: kind create cluster",
    "forbidden": "ask for the permission, and check it: kubectl auth can-i --list",
    "another operation": "end that one first: helm history, then helm rollback",
    "the specifications of the schema": "see what there is: helm show values charts/cloudrc",
    "already exists": "is it another release's? see: helm list --all-namespaces",
}
"""Words in what helm complains about -> what to do next."""
PATIENCE = 5.0
"""How long trouble has to last to be believed: a Secret may be a moment later than its pod [s]."""


def install(
    release: Release,
    chart: Path,
    values: Mapping[str, Any],
    *,
    extra: Sequence[str] = (),
    timeout: float = 300.0,
    tell: Callable[[str], None] = lambda text: None,
) -> None:
    """Install or upgrade a release and wait until it can fly.

    Args:
        release: What to call it and where to put it; the namespace is made if there is none.
        chart: Folder of the chart.
        values: Laid over the chart's own.
        extra: More arguments of helm, such as `--set=...`.
        timeout: For the pods to become ready [s].
        tell: Gets a line when something is worth telling.

    Raises:
        CloudrcError: If helm or the cluster refuses, or a pod cannot run; in one sentence.
    """
    arguments = ["upgrade", "--install", release.name, str(chart), *release.helm_flags]
    arguments += ["--create-namespace", "--values=-", *extra]
    _helm(arguments, given=json.dumps(values))
    wait_ready(release, timeout=timeout, tell=tell)


def current_values(release: Release) -> dict[str, Any]:
    """Read what a release was installed with; empty if there is none.

    Raises:
        CloudrcError: If helm or the cluster refuses.
    """
    arguments = ["list", "--output=json", f"--filter=^{release.name}$", *release.helm_flags]
    if not json.loads(_helm(arguments) or "[]"):
        return {}
    arguments = ["get", "values", release.name, "--output=json", *release.helm_flags]
    return json.loads(_helm(arguments)) or {}


def _helm(arguments: Sequence[str], given: str = "") -> str:
    """Run helm; where it fails, what to do next is added to what it says."""
    try:
        return run("helm", arguments, timeout=HELM_LIMIT, given=given)
    except ClusterError as error:
        said = str(error)
        hint = next((hint for words, hint in HINTS.items() if words in said), "")
        raise ClusterError(f"{said}; {hint}" if hint else said) from error


def wait_ready(
    release: Release, *, timeout: float, tell: Callable[[str], None] = lambda text: None
) -> None:
    """Wait until both pods of a release are of its newest version, and ready.

    Args:
        release: To wait for.
        timeout: How long at most [s].
        tell: Gets a line when something is worth telling.

    Raises:
        ClusterError: If a pod cannot run by waiting; says why.
        WaitedTooLongError: If they are not ready in time; says what is known.
    """
    until, hopeless_since, said = time.monotonic() + timeout, None, ""
    while True:
        states = insist(lambda: {each: _state(release, each) for each in COMPONENTS}, tell)
        waiting = {component: why for component, (why, _) in states.items() if why}
        if not waiting:
            return
        now = time.monotonic()
        fatal = [f"the {c} pod cannot run: {w}" for c, (w, bad) in states.items() if bad]
        hopeless_since = (hopeless_since or now) if fatal else None
        if hopeless_since is not None and now - hopeless_since >= PATIENCE:
            raise ClusterError(f"{'; '.join(fatal)}; look: {_look(release)}")
        words = "; ".join(f"{component}: {why}" for component, why in waiting.items())
        if now > until:
            raise WaitedTooLongError(
                f"release '{release.name}' is not ready after {timeout:g} s: {words}; "
                f"look: {_look(release)}, or allow more: --timeout"
            )
        if words != said:
            tell(words)
            said = words
        time.sleep(LOOK_PERIOD)


def _look(release: Release) -> str:
    selector = f"app.kubernetes.io/instance={release.name}"
    return f"kubectl {' '.join(release.flags)} describe pods -l {selector}"


def _state(release: Release, component: str) -> tuple[str, bool]:
    """Why a component is not ready, and whether waiting is hopeless; "" if it is ready."""
    deployment = _deployment(release, component)
    refused = _refused(deployment)
    if refused:
        return refused, True
    pods = list_pods(release, component)
    for pod in pods:
        why = trouble(pod) or missing_secret(release, pod)
        if why:
            return why, True
    status = deployment.status
    current = (status.observed_generation or 0) >= deployment.metadata.generation
    settled = current and status.updated_replicas == 1 and status.replicas == 1
    if not settled or not pods:
        return "its pod is being made", False
    return ("", False) if is_ready(pods[0]) else (_not_ready(pods[0]), False)


def _deployment(release: Release, component: str) -> Any:
    with explained("list deployments", release.where):
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


def _refused(deployment: Any) -> str:
    """Why the cluster does not even make the pod: Pod Security, a quota."""
    for condition in deployment.status.conditions or []:
        if condition.type == "ReplicaFailure" and condition.status == "True":
            return str(condition.message)
    return ""


def _not_ready(pod: Any) -> str:
    statuses = [*(pod.status.init_container_statuses or []), *(pod.status.container_statuses or [])]
    waiting = [status.name for status in statuses if not status.ready]
    return f"container {' and '.join(waiting)} is not ready yet" if waiting else "not ready yet"
