# SPDX-License-Identifier: Apache-2.0

"""Observe a release: its objects, its metrics, and what happens to its pods in flight."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

from cloudrc.base.errors import to_one_line
from cloudrc.base.outside.prometheus import Metrics, read_metrics, total
from cloudrc.cluster.client import COMPONENTS, ClusterError, Release, run
from cloudrc.cluster.diagnosis import (
    LOOK_UP,
    Objects,
    diagnose,
    ended_containers,
    is_ready,
    is_suspicious,
)
from cloudrc.cluster.pods import (
    INDEX,
    Finding,
    container_statuses,
    list_pods,
    read_page,
    workloads,
)

WINDOW = 2.5
"""Time between two looks at the metrics [s], whose counters are updated once a second."""
ROBOTS_MAX = 8
"""Largest number of robots of a fleet whose metrics are read."""
PEER = "--peer="
"""Flag of a link container: name and port of the other end."""
Robot = dict[tuple[str, str], Metrics]
"""Component and container -> metrics of the container."""


def observe(release: Release) -> Objects:
    """Ask the API server for workloads, pods and events; raise a ClusterError without a release."""
    found = workloads(release)
    pods = {component: list_pods(release, component) for component in found}
    return Objects(found, pods, release.request("list", "events"))


def find_causes(release: Release, *, thoroughly: bool = True) -> list[Finding]:
    """List what a release suffers from, with remedies; [] if it is healthy.

    The counters are looked at twice; without `thoroughly` only if the first look is suspicious.
    """
    objects = observe(release)
    before = after = _read_robots(release, objects)
    if before and (thoroughly or any(map(is_suspicious, before.values()))):
        time.sleep(WINDOW)
        after = _read_robots(release, objects)
    pairs = [(before.get(robot, {}), pages) for robot, pages in after.items()]
    return diagnose(release, objects, pairs, _unresolved(release, objects, after))


def _unresolved(release: Release, objects: Objects, robots: Mapping[str, Robot]) -> list[str]:
    """Return the pods whose link has failed to resolve the other end, and fails again now."""
    found = []
    for robot, pages in robots.items():
        for (component, container), page in pages.items():
            if container == "link" and total(page, "cloudrc_dns_errors_total"):
                pods = objects.pods[component]
                pod = next(each for each in pods if each.metadata.labels.get(INDEX, "") == robot)
                if not _resolves(release, pod):
                    found.append(f"pod {pod.metadata.name}")
    return found


def _resolves(release: Release, pod: Any) -> bool:
    """Return whether the link of a pod can resolve the name of the other end."""
    (link,) = (each for each in pod.spec.init_containers if each.name == "link")
    peer = next(word for word in link.args if word.startswith(PEER)).removeprefix(PEER)
    words = ["exec", pod.metadata.name, "--container=link", "--", "python", "-I", "-S", "-c"]
    try:
        run("kubectl", [*release.flags, *words, LOOK_UP, peer.rpartition(":")[0]])
    except ClusterError:
        return False
    return True


def _read_robots(release: Release, objects: Objects) -> dict[str, Robot]:
    """Read the metrics of the containers that have started; of a fleet, of pods that are not ready.

    Returns:
        Number of the robot, "" if there is only one -> its metrics.
    """
    found = defaultdict[str, Robot](dict)
    for component in COMPONENTS:
        for pod in objects.pods.get(component, []):
            robot = pod.metadata.labels.get(INDEX, "")
            is_of_interest = not is_ready(pod) or robot in ("", str(release.robot))
            if is_of_interest and (robot in found or len(found) < ROBOTS_MAX):
                found[robot] |= _read_pod(release, component, pod)
    return found


def _read_pod(release: Release, component: str, pod: Any) -> Robot:
    """Read the metrics of each container of a pod that serves them by now."""
    started = {each.name for each in container_statuses(pod) if each.started}
    found = Robot()
    for container in [*(pod.spec.init_containers or []), *pod.spec.containers]:
        for port in container.ports or []:
            if container.name in started and (port.name or "").endswith("metrics"):
                try:
                    text = read_page(release, pod.metadata.name, port.container_port)
                except ClusterError:  # it has just ended, or has no time to answer
                    continue
                found[component, container.name] = read_metrics(text)
    return found


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
                for one, ended, text in ended_containers(component, pod):
                    key = f"{pod.metadata.uid} {one.name} {ended.finished_at}"
                    found.append((key, f"{text}; it starts again"))
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
