"""Access the pods of a release: find them, explain failures, forward ports, read tokens and files.

A recording is copied while it grows. The end of the copy may be cut off, as after a kill; the rest
is readable.
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
    ExpiredError,
    explain_errors,
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
"""Reason, in Kubernetes' words, why a container will never run -> kind of failure."""
SECRETS = {
    "secret": ("key", "head -c 32 /dev/urandom"),
    "tokens": ("operator", "openssl rand -hex 32"),
}
"""Volume of the chart's pods -> key that the volume's Secret must have, and a command that makes
the key's content."""
RESTARTS_MAX = 2
"""Largest number of restarts up to which a container may still start [1]."""


def list_pods(release: Release, component: str) -> list[Any]:
    """List the pods of a component, the newest first, without pods that are being deleted."""
    with explain_errors("list pods", release.where):
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
        ClusterError: If no such pod runs; the message says whether the release exists.
    """
    pods = list_pods(release, component)
    for pod in pods:
        if pod.status.phase == "Running":
            return pod
    if pods:
        why = pod_failure(pods[0]) or f"it is {pods[0].status.phase}"
        raise ClusterError(
            f"the {component} pod of release '{release.name}' does not run: {why}; "
            f"see: kubectl {' '.join(release.flags)} describe pod {pods[0].metadata.name}"
        )
    raise _no_release(release)


def require_release(release: Release) -> None:
    """Check that a release exists; its pods need not run.

    Raises:
        ClusterError: If the release does not exist; the message says how to install it.
    """
    with explain_errors("list deployments", release.where):
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
    """Whether all containers of a pod are ready."""
    conditions = pod.status.conditions or []
    return any(c.type == "Ready" and c.status == "True" for c in conditions)


def pod_failure(pod: Any) -> str | None:
    """Describe in one sentence why a pod will never run; return None if the pod may run."""
    for status in _containers(pod):
        why = _container_trouble(status)
        if why:
            return why
    for condition in pod.status.conditions or []:
        if condition.type == "PodScheduled" and condition.status == "False":
            return (
                None if _waits_for_volume(condition) else f"no node takes it: {condition.message}"
            )
    return None


def refusal(release: Release, kind: str, name: str) -> str | None:
    """Describe why the cluster refuses an object's pod, such as a quota; None if it does not."""
    refused = _events(release, kind, name, "FailedCreate")
    return refused[-1] if refused else None


def missing_secret(release: Release, pod: Any) -> str | None:
    """Name the missing Secret for which a pod waits, and how to make it; None without one."""
    if any(status.state.running or status.state.terminated for status in _containers(pod)):
        return None
    messages: list[str] = []
    with suppress(ClusterError):  # the right to read events is not needed to fly
        messages = _events(release, "Pod", pod.metadata.name, "FailedMount")
    for message in messages:
        found = re.search(r'volume "(secret|tokens)".* secret "([^"]+)" not found', message)
        if found and not _has_secret(release, found[2]):
            file, content = SECRETS[found[1]]
            return (
                f"there is no Secret '{found[2]}'; make it: (umask 077; {content} >{file}) && "
                f"kubectl {' '.join(release.flags)} create secret generic {found[2]} "
                f"--from-file={file}"
            )
    return None


def _has_secret(release: Release, name: str) -> bool:
    """Whether a Secret exists now; an event about a missing Secret may be two minutes old."""
    with suppress(ClusterError), explain_errors("get secrets", release.where):
        release.core.read_namespaced_secret(
            name, release.namespace, _request_timeout=REQUEST_TIMEOUT
        )
        return True
    return False


def _events(release: Release, kind: str, name: str, reason: str) -> list[str]:
    """List the messages of those events of an object that have this reason."""
    with explain_errors("list events", release.where):
        events = release.core.list_namespaced_event(
            release.namespace,
            field_selector=f"involvedObject.kind={kind},involvedObject.name={name}",
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    return [event.message for event in events if event.reason == reason]


def _waits_for_volume(condition: Any) -> bool:
    """Whether a pod waits only for a volume that Kubernetes makes on first use."""
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
            f"container '{status.name}' cannot be created: "
            f"{' '.join((waiting.message or '').split())}"
        )
    if kind == "crash" or (status.restart_count or 0) > RESTARTS_MAX:
        return f"container '{status.name}' ends repeatedly{_last_end(status)}"
    return None


def _last_end(status: Any) -> str:
    """Describe exit code and message of the container's last end; "" if unknown."""
    ended = getattr(status.last_state, "terminated", None)
    if ended is None:
        return ""
    message = " ".join((ended.message or "").split())
    return f" (exit code {ended.exit_code})" + (f": {message}" if message else "")


VOLUME = "tokens"
"""Volume with the API's tokens in the pods of cloud and missions."""
OPERATOR = "operator"
"""Key of the operator's token in the Secret, and name of the token's file."""


def secret_name(release: Release) -> str:
    """Find the name of the Secret with the API's tokens.

    Raises:
        ClusterError: If the cloud pod mounts no such Secret.
    """
    for volume in find_pod(release, "cloud").spec.volumes or []:
        if volume.name == VOLUME and volume.secret is not None:
            return str(volume.secret.secret_name)
    raise ClusterError(
        f"release '{release.name}' {release.where} mounts no tokens: it has another version of "
        "the chart; upgrade it: helm upgrade"
    )


def operator_token(release: Release) -> str:
    """Read the operator's token; the user needs the right to get Secrets.

    Raises:
        ClusterError: If the token cannot be read; the message never contains a token.
    """
    name = secret_name(release)
    with explain_errors("get secrets", release.where):
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
            "give a file with it: --token-file"
        ) from None


API_PORT = 8080
"""TCP port of teleop's API in the cloud pod."""
NO_PROXY = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Opens URLs on this machine and ignores proxies that environment variables name."""
START_LIMIT = 20.0
"""Time limit for kubectl to forward the ports [s]."""
STOP_LIMIT = 2.0
"""Time from SIGTERM to SIGKILL in which kubectl can end [s]."""
LOOK_PERIOD = 0.05
"""Time between two looks at kubectl's output [s]."""
_FORWARDING = re.compile(rb"Forwarding from 127\.0\.0\.1:(\d+) -> (\d+)")


@contextmanager
def api_url(context: str | None, namespace: str | None, release: str) -> Iterator[str]:
    """Forward a port to a release's API while the block runs.

    Args:
        context: Context of the kubeconfig; None for the current context.
        namespace: Namespace of the release; None for the namespace of the context.
        release: Name of the Helm release.

    Yields:
        URL of the API, without a slash at the end.

    Raises:
        CloudrcError: If the release does not exist, or if the port cannot be forwarded.
    """
    place = connect(context, namespace, release)
    with forwarded(place, find_pod(place, "cloud").metadata.name, [API_PORT]) as ports:
        yield f"http://127.0.0.1:{ports[API_PORT]}"


@contextmanager
def forwarded(release: Release, pod: str, ports: Sequence[int]) -> Iterator[dict[int, int]]:
    """Forward ports of a pod while the block runs, including ports on its loopback device.

    Args:
        release: Release of the pod.
        pod: Name of the pod.
        ports: Ports in the pod.

    Yields:
        Port in the pod -> port on 127.0.0.1 of this machine.
    """
    command = [program("kubectl"), *release.flags, "port-forward", f"pod/{pod}"]
    command += ["--address=127.0.0.1", *(f":{port}" for port in ports)]
    # Files, not pipes: kubectl writes a line per connection, and a full pipe would block it.
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=errors)
        try:
            _wait_until_open(process, output, len(ports), pod)
            yield _forwarded_ports(output)
        except _NotOpenError:
            errors.seek(0)
            why = last_words(errors.read().decode(errors="replace"))
            raise ClusterError(
                f"cannot forward ports of pod '{pod}' {release.where}: {why}"
            ) from None
        finally:
            _end(process)


class _NotOpenError(Exception):
    """kubectl ended before the ports were forwarded."""


def _wait_until_open(
    process: subprocess.Popen[bytes], output: IO[bytes], count: int, pod: str
) -> None:
    until = time.monotonic() + START_LIMIT
    while len(_forwarded_ports(output)) < count:
        if process.poll() is not None:
            raise _NotOpenError
        if time.monotonic() > until:
            raise ExpiredError(
                f"kubectl port-forward to pod '{pod}' has not started within {START_LIMIT:g} s"
            )
        time.sleep(LOOK_PERIOD)


def _forwarded_ports(output: IO[bytes]) -> dict[int, int]:
    """Read from kubectl's output: port in the pod -> port on this machine."""
    text = os.pread(output.fileno(), 4096, 0)
    return {int(remote): int(local) for local, remote in _FORWARDING.findall(text)}


def _end(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(STOP_LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


DATA = "/var/lib/cloudrc"
"""Folder of the recordings in the pods of world and cloud."""
METRICS = {
    "world": {"world": 9100, "link": 9102},
    "cloud": {"cloud": 9100, "teleop": 9101, "link": 9102},
}
"""Component -> container -> port of its metrics."""
COPY_LIMIT = 120.0
"""Time limit to copy one recording [s]."""
SCRAPE_LIMIT = 10.0
"""Time limit to read the metrics of one container [s]."""
LOG_LIMIT = 30.0
"""Time limit to read the log of one container [s]."""


def fetch_recording(release: Release, component: str, target: Path) -> None:
    """Copy the present recording of one end.

    Args:
        release: The release.
        component: "world" or "cloud"; also the name of the container.
        target: File to write.

    Raises:
        ClusterError: If there is no such pod or file.
    """
    _copy(release, component, find_pod(release, component).metadata.name, "", target)


def fetch_previous_recording(release: Release, component: str, target: Path) -> bool:
    """Copy the recording that the container made before its last restart.

    Args:
        release: The release.
        component: "world" or "cloud", as in `fetch_recording`.
        target: File to write.

    Returns:
        False if the container has not restarted in its pod.

    Raises:
        ClusterError: If the container has restarted, but no earlier recording exists.
    """
    pod = find_pod(release, component)
    statuses = pod.status.container_statuses or []
    if not any(status.name == component and status.restart_count for status in statuses):
        return False
    _copy(release, component, pod.metadata.name, ".before", target)
    return True


def _copy(release: Release, component: str, pod: str, suffix: str, target: Path) -> None:
    path = f"{DATA}/{component}{suffix}.mcap"
    arguments = [*release.flags, "exec", pod, f"--container={component}", "--", "cat", path]
    with target.open("wb") as file:
        run("kubectl", arguments, timeout=COPY_LIMIT, stdout=file)


def fetch_metrics(release: Release, component: str) -> dict[str, str]:
    """Read the metrics of each container of a pod, in Prometheus' text format.

    Args:
        release: The release.
        component: "world" or "cloud".

    Returns:
        Name of the container -> text.

    Raises:
        ClusterError: If a container does not answer.
    """
    pod, ports = find_pod(release, component).metadata.name, METRICS[component]
    texts = {}
    with forwarded(release, pod, list(ports.values())) as local:
        for container, port in ports.items():
            url = f"http://127.0.0.1:{local[port]}/metrics"
            try:
                with NO_PROXY.open(url, timeout=SCRAPE_LIMIT) as answer:
                    texts[container] = answer.read().decode()
            except (urllib.error.URLError, OSError) as error:
                raise ClusterError(
                    f"cannot read the metrics of container '{container}' of pod '{pod}': {error}"
                ) from error
    return texts


def fetch_logs(release: Release, component: str) -> dict[str, str]:
    """Read the log of each container of a pod.

    Returns:
        Name of the container -> text.
    """
    pod = find_pod(release, component)
    names = [c.name for c in [*(pod.spec.init_containers or []), *pod.spec.containers]]
    texts = {}
    for name in names:
        with explain_errors("get pods/log", release.where):
            texts[name] = release.core.read_namespaced_pod_log(
                pod.metadata.name, release.namespace, container=name, _request_timeout=LOG_LIMIT
            )
    return texts
