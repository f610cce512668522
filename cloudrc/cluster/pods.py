"""The pods of a release: a component comes in, its pod, or why it does not run, goes out.

Tokens of a release's API: the Secret that its cloud pod mounts, read with the user's rights.

Ports of a pod on this machine: a pod comes in, local ports that lead to it go out.

Brings back what a flight left in the pods: recordings, metrics, logs.

The recordings are open and growing while they are copied: the copy is torn at its end, as that of a
process that was killed is, and as readable.
"""

from __future__ import annotations

import base64
import binascii
import os
import re
import subprocess
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from cloudrc.cluster.client import REQUEST_TIMEOUT, Release, connect
from cloudrc.cluster.tools import (
    ClusterError,
    WaitedTooLongError,
    explained,
    last_words,
    program,
    run,
)

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


VOLUME = "tokens"
"""In the cloud pod and in missions' pods."""
OPERATOR = "operator"
"""Key of the Secret, and name of the file."""


def secret_name(release: Release) -> str:
    """Say which Secret has the tokens.

    Raises:
        ClusterError: If the release has none.
    """
    for volume in find_pod(release, "cloud").spec.volumes or []:
        if volume.name == VOLUME and volume.secret is not None:
            return str(volume.secret.secret_name)
    raise ClusterError(
        f"release '{release.name}' {release.where} mounts no tokens: it is of another version; "
        "upgrade it: helm upgrade"
    )


def operator_token(release: Release) -> str:
    """Read the operator's token; needs the right to get Secrets.

    Raises:
        ClusterError: If it cannot be read; the text has no token in it.
    """
    name = secret_name(release)
    with explained("get secrets", release.where):
        secret = release.core.read_namespaced_secret(
            name, release.namespace, _request_timeout=REQUEST_TIMEOUT
        )
    try:
        return (
            base64.b64decode((secret.data or {})[OPERATOR], validate=True).decode("ascii").strip()
        )
    except (KeyError, ValueError, binascii.Error):
        raise ClusterError(
            f"Secret '{name}' {release.where} has no token under '{OPERATOR}'; "
            "name a file that has it: --token-file"
        ) from None


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
