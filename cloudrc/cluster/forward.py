"""Ports of a pod on this machine: a pod comes in, local ports that lead to it go out."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import IO

from cloudrc.cluster.access import Release, connect
from cloudrc.cluster.errors import ClusterError, WaitedTooLongError
from cloudrc.cluster.pods import find_pod
from cloudrc.cluster.tools import last_words, program

API_PORT = 8080
"""Where teleop serves its API in the cloud pod."""
DIRECTLY = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Opens URLs on this machine, whatever proxy the environment names."""
START_LIMIT = 20.0
"""For kubectl to open the way [s]."""
STOP_LIMIT = 2.0
"""For kubectl to end once it is asked to [s]."""
LOOK_PERIOD = 0.05
"""Between two looks at what kubectl says [s]."""
_OPENED = re.compile(rb"Forwarding from 127\.0\.0\.1:(\d+) -> (\d+)")


@contextmanager
def api_url(context: str | None, namespace: str | None, release: str) -> Iterator[str]:
    """Open the way to a release's API for as long as the block lasts.

    Args:
        context: Of the kubeconfig; None for the current one.
        namespace: None for the context's own.
        release: Name of the Helm release.

    Yields:
        The API's URL, without a slash at its end.

    Raises:
        CloudrcError: If there is no such release or no way to it.
    """
    place = connect(context, namespace, release)
    with forwarded(place, find_pod(place, "cloud").metadata.name, [API_PORT]) as ports:
        yield f"http://127.0.0.1:{ports[API_PORT]}"


@contextmanager
def forwarded(release: Release, pod: str, ports: Sequence[int]) -> Iterator[dict[int, int]]:
    """Forward ports of a pod, also those that it binds to its own loopback only.

    Args:
        release: Where the pod is.
        pod: Its name.
        ports: In the pod.

    Yields:
        Port in the pod -> port on 127.0.0.1 here.
    """
    command = [program("kubectl"), *release.flags, "port-forward", f"pod/{pod}"]
    command += ["--address=127.0.0.1", *(f":{port}" for port in ports)]
    # Files, not pipes: kubectl writes a line per connection, and a full pipe would stop it.
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as complaint:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=complaint)
        try:
            _wait_until_open(process, said, len(ports), pod)
            yield _opened(said)
        except _NotOpenError:
            complaint.seek(0)
            why = last_words(complaint.read().decode(errors="replace"))
            raise ClusterError(f"no way to pod '{pod}' {release.where}: {why}") from None
        finally:
            _end(process)


class _NotOpenError(Exception):
    """The program ended before the way was open."""


def _wait_until_open(
    process: subprocess.Popen[bytes], said: IO[bytes], count: int, pod: str
) -> None:
    until = time.monotonic() + START_LIMIT
    while len(_opened(said)) < count:
        if process.poll() is not None:
            raise _NotOpenError
        if time.monotonic() > until:
            raise WaitedTooLongError(
                f"kubectl port-forward to pod '{pod}' was not open within {START_LIMIT:g} s"
            )
        time.sleep(LOOK_PERIOD)


def _opened(said: IO[bytes]) -> dict[int, int]:
    """Port in the pod -> port here, as far as kubectl has told."""
    text = os.pread(said.fileno(), 4096, 0)
    return {int(there): int(here) for here, there in _OPENED.findall(text)}


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(STOP_LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
