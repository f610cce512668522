"""Say what happened to pods: evictions, ended containers, refusals by a LimitRange or a quota."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

from cloudrc.cluster.client import COMPONENTS, Release
from cloudrc.cluster.pods import (
    container_statuses,
    describe_end,
    list_pods,
    pod_failure,
    value_key,
)
from cloudrc.errors import to_one_line

EVICTIONS = {
    "EvictionByEvictionAPI": "evicted: node drained, or another request to evict",
    "PreemptionByScheduler": "evicted: a pod with a higher priority takes its place",
    "DeletionByTaintManager": "evicted: its node has a taint, for example because it is lost",
    "TerminationByKubelet": "evicted: its node lacks resources or shuts down",
    "DeletionByPodGC": "lost with its node",
}
"""Reason of the condition DisruptionTarget of a pod -> text."""
_RANGE = re.compile(
    r"(minimum|maximum) (\S+) usage per (?:Container|Pod) is ([^,\s]+), "
    r"but (request|limit) is ([^,\]\s]+)"
)
"""Part of the refusal by a LimitRange."""
_QUOTA = re.compile(r"exceeded quota: .*?requested: (?P<requested>.*?), used: ")
"""Part of the refusal by a ResourceQuota."""


def eviction(pod: Any) -> str:
    """Return why Kubernetes has evicted a pod; "" if it has not."""
    for condition in pod.status.conditions or []:
        if condition.type == "DisruptionTarget" and condition.status == "True":
            return EVICTIONS.get(condition.reason, f"evicted: {to_one_line(condition.message)}")
    return ""


def explain_refusal(message: str, pod: Any) -> str:
    """Add to the API server's refusal of a pod which of its containers asks for how much.

    The server names the limit of a LimitRange or of a quota, but not the container. `pod` is the
    pod's spec.
    """
    from kubernetes import utils

    quantity: Any = utils.parse_quantity  # not annotated
    asks, found = [*_container_resources(pod)], list[str]()
    for bound, resource, limit, field, asked in _RANGE.findall(message):
        order = "at least" if bound == "minimum" else "at most"
        own = [
            f"container '{name}' has the {field} {value} of {resource}, {order} {limit} is "
            f"allowed: set {value_key(name)}.{field}s.{resource}"
            for name, kind, key, value in asks
            if (kind, key) == (f"{field}s", resource) and quantity(value) == quantity(asked)
        ]
        found += own or _sum_of(asks, f"{field}s", resource)  # or the sum of a pod's containers
    if quota := _QUOTA.search(message):
        for term in quota["requested"].split(","):
            kind, _, resource = term.partition("=")[0].strip().rpartition(".")
            found += _sum_of(asks, kind or "requests", resource)
    return "; ".join([message, *found])


def _sum_of(asks: Iterable[tuple[str, str, str, str]], kind: str, resource: str) -> list[str]:
    """Return a sentence on what each container asks for of a resource; none if none asks for it."""
    parts = [f"{name} {value}" for name, k, r, value in asks if (k, r) == (kind, resource)]
    return [f"{kind}.{resource} of the pod: {' + '.join(parts)}"] if parts else []


def _container_resources(pod: Any) -> Iterator[tuple[str, str, str, str]]:
    """Yield container, "requests" or "limits", resource and quantity of each resource of a pod."""
    for container in [*(pod.init_containers or []), *pod.containers]:
        for kind in ("requests", "limits"):
            amounts = getattr(container.resources, kind, None) or {}
            yield from ((container.name, kind, key, str(value)) for key, value in amounts.items())


def troubles(release: Release) -> list[str]:
    """Say which containers of world and cloud end before they work, and why their pods wait."""
    found = list[str]()
    for component in COMPONENTS:
        for pod in list_pods(release, component):
            ends = [text for one, _, text in _ended_containers(component, pod) if not one.started]
            why = "" if ends else pod_failure(pod)
            found += [f"the {component} pod waits: {why}"] if why else ends
    return found


def _ended_containers(component: str, pod: Any) -> Iterator[tuple[Any, str, str]]:
    """Yield status, time and a sentence about the last end of each container of a pod."""
    for status in container_statuses(pod):
        ended = status.last_state and status.last_state.terminated
        if ended:
            how = describe_end(status.name, ended)
            text = f"container '{status.name}' of the {component} pod {how}; it starts again"
            yield status, str(ended.finished_at), text


class ReleaseWatch:
    """Watches the pods of world and cloud for what interrupts a flight."""

    def __init__(self, release: Release) -> None:
        """Note the present state: only what happens after it is told."""
        self._release = release
        self._told = set[tuple[str, str]]()  # pod's UID and what was told about the pod
        self._known = {pod.metadata.uid for _, pod in self._pods()}
        for _ in self.look():
            pass

    def look(self) -> Iterator[str]:
        """Yield a sentence about each container or pod that has ended, and each pod that waits."""
        for component, pod in self._pods():
            uid, cause = pod.metadata.uid, eviction(pod)
            ends = _ended_containers(component, pod)
            found = [(f"{one.name} {time}", text) for one, time, text in ends]
            if cause or pod.metadata.deletion_timestamp is not None:
                cause = cause or "it was deleted or replaced"
                found.append(("end", f"the {component} pod ends: {cause}"))
            elif uid not in self._known:
                found.append(("start", f"a new {component} pod starts: {pod.metadata.name}"))
                if why := pod_failure(pod):
                    found.append((why, f"the {component} pod waits: {why}"))
            for key, sentence in found:
                if (uid, key) not in self._told:
                    self._told.add((uid, key))
                    yield sentence

    def _pods(self) -> list[tuple[str, Any]]:
        """List the pods with their components, the oldest first."""
        pods = [(each, pod) for each in COMPONENTS for pod in self._release.find("pods", each)]
        return sorted(pods, key=lambda pair: str(pair[1].metadata.creation_timestamp))
