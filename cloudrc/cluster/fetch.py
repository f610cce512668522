"""Brings back what a flight left in the pods: recordings, metrics, logs.

The recordings are open and growing while they are copied: the copy is torn at its end, as that of a
process that was killed is, and as readable.
"""

from __future__ import annotations

import urllib.error
from pathlib import Path

from cloudrc.cluster.access import Release
from cloudrc.cluster.errors import ClusterError, explained
from cloudrc.cluster.forward import DIRECTLY, forwarded
from cloudrc.cluster.pods import find_pod
from cloudrc.cluster.tools import run

DATA = "/var/lib/cloudrc"
METRICS = {
    "world": {"world": 9100, "link": 9102},
    "cloud": {"cloud": 9100, "teleop": 9101, "link": 9102},
}
"""Component -> container -> port of its metrics."""
COPY_LIMIT = 120.0
"""For one recording to be copied [s]."""
SCRAPE_LIMIT = 10.0
LOG_LIMIT = 30.0


def fetch_recording(release: Release, component: str, target: Path) -> None:
    """Copy the recording of one end as it is at this instant.

    Args:
        release: Where it flew.
        component: "world" or "cloud", which is its container's name, too.
        target: File to write.

    Raises:
        ClusterError: If there is no such pod or file.
    """
    _copy(release, component, find_pod(release, component).metadata.name, "", target)


def fetch_before(release: Release, component: str, target: Path) -> bool:
    """Copy what the container before this one had recorded in the same pod.

    Args:
        release: Where it flew.
        component: As of `fetch_recording`.
        target: File to write.

    Returns:
        Whether there was one.

    Raises:
        ClusterError: If there was, and it has left no file.
    """
    pod = find_pod(release, component)
    statuses = pod.status.container_statuses or []
    if not any(status.name == component and status.restart_count for status in statuses):
        return False
    _copy(release, component, pod.metadata.name, ".before", target)
    return True


def _copy(release: Release, component: str, pod: str, which: str, target: Path) -> None:
    path = f"{DATA}/{component}{which}.mcap"
    arguments = [*release.flags, "exec", pod, f"--container={component}", "--", "cat", path]
    with target.open("wb") as file:
        run("kubectl", arguments, timeout=COPY_LIMIT, stdout=file)


def fetch_metrics(release: Release, component: str) -> dict[str, str]:
    """Read the metrics of every container of a pod, in Prometheus' text format.

    Args:
        release: Where it flies.
        component: "world" or "cloud".

    Returns:
        Container -> text.

    Raises:
        ClusterError: If one does not answer.
    """
    pod, ports = find_pod(release, component).metadata.name, METRICS[component]
    texts = {}
    with forwarded(release, pod, list(ports.values())) as local:
        for container, port in ports.items():
            url = f"http://127.0.0.1:{local[port]}/metrics"
            try:
                with DIRECTLY.open(url, timeout=SCRAPE_LIMIT) as answer:
                    texts[container] = answer.read().decode()
            except (urllib.error.URLError, OSError) as error:
                raise ClusterError(
                    f"container '{container}' of pod '{pod}' gives no metrics: {error}"
                ) from error
    return texts


def fetch_logs(release: Release, component: str) -> dict[str, str]:
    """Read the log of every container of a pod.

    Returns:
        Container -> text.
    """
    pod = find_pod(release, component)
    names = [c.name for c in [*(pod.spec.init_containers or []), *pod.spec.containers]]
    texts = {}
    for name in names:
        with explained("get pods/log", release.where):
            texts[name] = release.core.read_namespaced_pod_log(
                pod.metadata.name, release.namespace, container=name, _request_timeout=LOG_LIMIT
            )
    return texts
