"""Say what happened to pods: evictions and ended containers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from cloudrc.cluster.client import COMPONENTS, Release
from cloudrc.cluster.pods import (
    container_statuses,
    describe_end,
    list_pods,
    pod_failure,
)
from cloudrc.errors import to_one_line


def eviction(pod: Any) -> str:
    """Return why Kubernetes has evicted a pod; "" if it has not."""
    for condition in pod.status.conditions or []:
        if condition.type == "DisruptionTarget" and condition.status == "True":
            return to_one_line(f"evicted: {condition.reason}: {condition.message}")
    return ""


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
