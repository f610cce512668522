"""Say what happens to the pods of a release: events as Kubernetes tells them, ended containers."""

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
        self._pods, self._told = set[str](), set[str]()
        for _ in self.look():
            pass

    def look(self) -> Iterator[str]:
        """Yield a sentence about each container that has ended, and each event of a pod."""
        found = list[tuple[str, str]]()
        for component in COMPONENTS:
            for pod in self._release.find("pods", component):
                self._pods.add(pod.metadata.uid)
                ends = _ended_containers(component, pod)
                found += [
                    (f"{pod.metadata.uid} {one.name} {time}", text) for one, time, text in ends
                ]
        for event in self._release.request("list", "events"):
            pod, is_end = event.involved_object, event.reason == "Killing"
            is_warning = event.type == "Warning" and event.reason != "Unhealthy"
            if pod.uid in self._pods and (is_end or is_warning):
                text = f"pod {pod.name}: {event.reason}: {to_one_line(event.message)}"
                found.append((event.metadata.uid, text))
        for key, sentence in found:
            if key not in self._told:
                self._told.add(key)
                yield sentence
