"""Forward the page of a release's console to this machine, and read the console's log."""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterator

from cloudrc.cluster.client import ClusterError, Release, end_process, program
from cloudrc.cluster.pods import find_pod, forwarded

CONTAINER, PORT = "console", 8090
"""Container of cloud's pod that serves the page, and its port on the pod's loopback address."""


def follow_page(release: Release, port: int, tell: Callable[[str], None]) -> Iterator[str]:
    """Forward the page to `port` of 127.0.0.1 (0: any), and yield the lines of the console's log.

    `tell` is called with the page's address on this machine.

    Raises:
        ClusterError: If the release has no console, or if the port cannot be forwarded.
    """
    pod = find_pod(release, "cloud")
    if CONTAINER not in {container.name for container in pod.spec.containers}:
        raise ClusterError(
            f"release '{release.name}' {release.where} has no console; add it: helm upgrade "
            f"{release.name} charts/cloudrc {' '.join(release.helm_flags)} --reuse-values "
            "--set console.enabled=true"
        )
    name = pod.metadata.name
    words = ["logs", f"pod/{name}", f"--container={CONTAINER}", "--follow", "--since=1s"]
    command = [program("kubectl"), *release.flags, *words]
    with forwarded(release, name, [PORT], local=port) as ports:
        tell(f"http://127.0.0.1:{ports[PORT]}")
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            try:
                yield from map(str.strip, process.stdout)
            finally:
                end_process(process)
