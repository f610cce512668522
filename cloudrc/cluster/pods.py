# SPDX-License-Identifier: Apache-2.0

"""Access the pods of a release: find them, explain failures, forward ports, fetch files.

A recording grows while it is copied. Its copy may therefore end in the middle of a record, like the
recording of a killed process; everything before this record is readable.
"""

from __future__ import annotations

import base64
import os
import re
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple

from cloudrc.base.errors import StateError, TimedOutError, to_one_line
from cloudrc.cluster.client import (
    REQUEST_TIMEOUT,
    ClusterError,
    ExpiredError,
    NoAnswerError,
    Release,
    explain_errors,
    last_words,
    program,
    run,
)
from cloudrc.cluster.releases import CLOUDRC, COMPONENT, INSTANCE, no_release
from cloudrc.flight.machine import STOP_LIMIT, end_process
from cloudrc.results.record import part_before

NO_IMAGE = ("ErrImagePull", "ImagePullBackOff", "ErrImageNeverPull", "InvalidImageName")
NOT_MADE = ("CreateContainerConfigError", "CreateContainerError", "RunContainerError")
CRASHES = ("CrashLoopBackOff", "Error")
"""Kubernetes' reasons why a container will never run."""
VALUES = {
    **{"load": "cloud.backgroundLoad", "ros": "cloud.ros", "nodes": "cloud.ros"},
    "bridge": "ros",
}
"""Container -> section of the chart's values with its resources, if it has another name."""
RESTARTS_MAX = 2
"""Largest number of restarts after which a container is still expected to start."""
TOKENS, OPERATOR = "tokens", "operator"
"""Name of the volume with the API's tokens, and of the file in it with the operator's token."""
API_PORT = 8080
"""TCP port of teleop's API in cloud's pod."""
CONSOLE, CONSOLE_PORT = "console", 8090
"""Container of cloud's pod that serves the console's page, and its port on the pod's loopback
address."""
METRICS = {
    "world": {"world": 9100, "link": 9102},
    "cloud": {"cloud": 9100, "teleop": 9101, "link": 9102},
}
"""Component -> container -> TCP port of the container's metrics."""
INDEX = "apps.kubernetes.io/pod-index"
"""Label of a fleet's pods: the number of the robot."""
CELL = "cell"
"""Component of a fleet's cell, and name of its container."""
DATA = "/var/lib/cloudrc"
"""Folder of the recordings in the pods of world, cloud and cell."""
START_LIMIT = 20.0
"""Time limit for kubectl to start to forward ports [s]."""
LOOK_PERIOD = 0.05
"""Time between two checks of kubectl's output [s]."""
FORWARDER = "Kubernetes port forward proxy"
"""Beginning of the name of the thread of the Kubernetes client that forwards a port."""
_FORWARDING = re.compile(rb"Forwarding from 127\.0\.0\.1:(\d+) -> (\d+)")


class Finding(NamedTuple):
    """What is known about one thing, and how to solve a problem.

    "missing" stops an install or a flight, "warn" does not.
    """

    name: str
    state: Literal["ok", "warn", "missing"]
    found: str
    fix: str = ""

    def __str__(self) -> str:
        return f"{self.found}; {self.fix}" if self.fix else self.found


class NotRunningError(ClusterError):
    """Report that a pod does not run, or cannot be reached."""


def list_pods(release: Release, component: str) -> list[Any]:
    """List the pods of a component, the newest first; omit pods that are being deleted.

    In a fleet these are the pods of all robots, or of `release.robot`. On board, world's pod has
    the container of cloud, too.
    """
    found = release.find("pods", component)
    if component == "cloud" and not found:
        found = [pod for pod in release.find("pods", "world") if has_container(pod, component)]
    number = None if release.robot is None else str(release.robot)
    alive = [
        pod
        for pod in found
        if pod.metadata.deletion_timestamp is None
        and number in (None, pod.metadata.labels.get(INDEX))
    ]
    return sorted(alive, key=lambda pod: str(pod.metadata.creation_timestamp), reverse=True)


class PodWatch:
    """The pods with a label, as the API server tells of their changes."""

    def __init__(self, release: Release, selector: str) -> None:
        """Watch the pods that a label selector selects."""
        self._release, self._selector = release, selector
        self.pods = dict[str, Any]()  # UID -> pod
        self._version: str | None = None  # resource version of the newest change

    def look(self) -> None:
        """Take the changes of about a second; at first, all pods.

        If the API server does not answer, nothing has changed: another request tells the error.
        """
        from kubernetes import client, watch

        changes: Any = watch  # not annotated
        call = client.CoreV1Api(self._release.client).list_namespaced_pod
        where = {"namespace": self._release.namespace, "label_selector": self._selector}
        limits = {"timeout_seconds": 1, "_request_timeout": REQUEST_TIMEOUT}
        given = {**where, **limits, "resource_version": self._version}
        try:
            with explain_errors("watch pods", self._release.where):
                for change in changes.Watch().stream(call, **given):
                    self._take(change["type"], change["object"])
        except ExpiredError:  # nothing happened for minutes: begin again with all pods
            self.pods, self._version = {}, None
        except NoAnswerError:
            pass

    def _take(self, kind: str, pod: Any) -> None:
        self._version = pod.metadata.resource_version
        self.pods[pod.metadata.uid] = pod
        if kind == "DELETED":
            del self.pods[pod.metadata.uid]


def find_pod(release: Release, component: str) -> Any:
    """Find the newest running pod of a component; else raise a NotRunningError with the cause."""
    pods = list_pods(release, component)
    if (robots := len({pod.metadata.labels.get(INDEX) for pod in pods})) > 1:
        raise StateError(f"{release} has {robots} robots; name one: --robot K")
    for pod in pods:
        if pod.status.phase == "Running":
            return pod
    kind, workload = find_workload(release, component)
    why = (pod_failure(pods[0]) or f"it is {pods[0].status.phase}") if pods else "there is none"
    raise NotRunningError(
        f"the {component} pod of {release} does not run: {why}; "
        f"see: {release.kubectl} describe {kind.lower()} {workload.metadata.name}"
    )


def workloads(release: Release) -> dict[str, Any]:
    """Find the Deployments of a release by component, those of a fleet are StatefulSets.

    Raise a ClusterError if the release does not exist.
    """
    selector = f"{CLOUDRC},{INSTANCE}={release.name}"
    for kind in ("deployments", "statefulsets"):
        if found := release.request("list", kind, label_selector=selector):
            return {each.metadata.labels[COMPONENT]: each for each in found}
    raise no_release(release)


def find_workload(release: Release, component: str) -> tuple[str, Any]:
    """Find the Deployment of a component, or its StatefulSet in a fleet; return kind and object.

    On board, cloud is in that of world. Raise a ClusterError if the release does not exist.
    """
    for found in release.find("deployments", component):
        return "Deployment", found
    for each in (component, "world"):
        for found in release.find("statefulsets", each):
            return "StatefulSet", found
    raise no_release(release)


def fleet_size(release: Release) -> int:
    """Return the number of robots of a fleet; 0 if the release is none."""
    return sum(each.spec.replicas for each in release.find("statefulsets", "world"))


def has_container(pod: Any, name: str) -> bool:
    """Return whether a pod has a container of this name."""
    return name in {container.name for container in pod.spec.containers}


def pod_failure(pod: Any) -> Finding | None:
    """Return why a pod cannot run; None if it may run. "warn": it can if a node takes it."""
    for status in container_statuses(pod):
        if failure := _container_failure(status):
            return failure
    for condition in pod.status.conditions or []:
        message = condition.message or ""
        # Kubernetes makes some volumes only on first use.
        waits_for_volume = "volume" in message and "unbound" in message
        if (condition.type, condition.status) == ("PodScheduled", "False") and not waits_for_volume:
            return Finding(pod.metadata.name, "warn", f"no node takes it: {message}")
    return None


def _container_failure(status: Any) -> Finding | None:
    """Return why a container will never run; None if it may run."""
    waiting, ended = status.state.waiting, status.last_state and status.last_state.terminated
    reason, container = waiting.reason if waiting else "", f"container '{status.name}'"
    if reason in NO_IMAGE:
        text = f"the image {status.image} of {container} is not on the node and cannot be pulled"
        fix = (
            "name one that the nodes can pull: --set image.registry=... --set image.tag=... "
            "(a sweep: --image), or load your own into kind: make kind-load"
        )
        return Finding(container, "missing", f"{text} ({reason})", fix)
    if reason in NOT_MADE:
        text = f"{container} cannot be created: {to_one_line(waiting.message)}"
        return Finding(container, "missing", text)
    if reason in CRASHES or (status.restart_count or 0) > RESTARTS_MAX:
        end = f": it {describe_end(status.name, ended)}" if ended else ""
        text, _, fix = end.partition("; ")  # of cloudrc's error, in the log of the pod
        return Finding(container, "missing", f"{container} ends repeatedly{text}", fix)
    return None


def describe_end(container: str, ended: Any) -> str:
    """Describe the end of a container; `ended` is its state `terminated`."""
    if ended.reason == "OOMKilled":
        key = f"{VALUES.get(container, container)}.resources.limits.memory"
        return f"was killed, because it used more memory than its limit: raise {key}"
    error = (ended.message or "").rpartition("cloudrc: error: ")[2]
    words = to_one_line(error.strip().rpartition("\n")[2])
    return f"ended with exit code {ended.exit_code}" + (f": {words}" if words else "")


def events_of(release: Release, thing: Any, reason: str) -> list[str]:
    """Return what Kubernetes said about an object with this reason, such as FailedMount."""
    selector = f"involvedObject.uid={thing.metadata.uid},reason={reason}"
    found = release.request("list", "events", field_selector=selector)
    return [to_one_line(event.message) for event in found]


def container_statuses(pod: Any) -> list[Any]:
    """List the statuses of a pod's containers, init containers first."""
    return [*(pod.status.init_container_statuses or []), *(pod.status.container_statuses or [])]


def operator_token(release: Release) -> str:
    """Read the operator's token; the user needs the permission to get Secrets.

    No error message contains the token.
    """
    volumes = find_workload(release, "cloud")[1].spec.template.spec.volumes
    name = next(volume.secret.secret_name for volume in volumes if volume.name == TOKENS)
    secret = release.request("get", "secrets", name=name)
    try:
        token = base64.b64decode((secret.data or {})[OPERATOR], validate=True)
        return token.decode("ascii").strip()
    except (KeyError, ValueError):
        raise ClusterError(
            f"Secret '{name}' {release.where} has no token under '{OPERATOR}'; "
            "give a file with it: --token-file"
        ) from None


@contextmanager
def forwarded(
    release: Release, pod: str, ports: Sequence[int], local: int = 0
) -> Iterator[dict[int, int]]:
    """Forward ports of a pod, loopback ports included, during the `with` block.

    If `ports` has one port, `local` is its port on this machine; 0 selects a free port.

    Yields:
        Port in the pod -> port on 127.0.0.1 of this machine.
    """
    command = [program("kubectl"), *release.flags, "port-forward", f"pod/{pod}"]
    command += ["--address=127.0.0.1", *(f"{local or ''}:{port}" for port in ports)]
    # Files, not pipes: kubectl writes a line per connection, and a full pipe would block it.
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=errors)
        try:
            until = time.monotonic() + START_LIMIT
            while len(found := _forwarded_ports(output)) < len(ports):
                if process.poll() is not None:
                    errors.seek(0)
                    where, why = f"pod '{pod}' {release.where}", last_words(errors.read())
                    raise NotRunningError(f"cannot forward ports of {where}: {why}")
                if time.monotonic() > until:
                    raise TimedOutError(
                        f"kubectl port-forward to pod '{pod}' has not started within "
                        f"{START_LIMIT:g} s; does its node answer? See: kubectl get nodes"
                    )
                time.sleep(LOOK_PERIOD)
            yield found
        finally:
            end_process(process)


def _forwarded_ports(output: IO[bytes]) -> dict[int, int]:
    text = os.pread(output.fileno(), 4096, 0)
    return {int(remote): int(local) for local, remote in _FORWARDING.findall(text)}


def follow_page(release: Release, port: int, tell: Callable[[str], None]) -> Iterator[str]:
    """Forward the console's web page to `port` of 127.0.0.1; yield the lines of the console's log.

    Port 0 selects a free port. `tell` is called with the page's URL on this machine.

    Raises:
        ClusterError: If the release has no console, or if the port cannot be forwarded.
    """
    pod = find_pod(release, "cloud")
    if not has_container(pod, CONSOLE):
        add = release.helm_upgrade("console.enabled=true")
        raise ClusterError(f"{release} has no console; add it: {add}")
    name = pod.metadata.name
    words = ["logs", f"pod/{name}", f"--container={CONSOLE}", "--follow", "--since=1s"]
    command = [program("kubectl"), *release.flags, *words]
    with forwarded(release, name, [CONSOLE_PORT], local=port) as ports:
        tell(f"http://127.0.0.1:{ports[CONSOLE_PORT]}")
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            try:
                yield from map(str.strip, process.stdout)
            finally:
                end_process(process)


def fetch_recording(release: Release, component: str, target: Path) -> None:
    """Copy the recording of "world" or "cloud" from its pod to a file, the part before beside it.

    `component` is also the name of the container.
    """
    pod = find_pod(release, component).metadata.name
    path = Path(DATA, f"{component}.mcap")
    copy_file(release, pod, component, str(path), target)
    if list_files(release, pod, component, str(part_before(path))):
        copy_file(release, pod, component, str(part_before(path)), part_before(target))


def list_files(release: Release, pod: str, container: str, path: str) -> list[str]:
    """List the files of a folder in a container, or the file `path` itself; [] if it is missing."""
    words = ["exec", pod, f"--container={container}", "--", "sh", "-c", f"ls {path} || true"]
    return run("kubectl", [*release.flags, *words]).split()


def copy_file(release: Release, pod: str, container: str, path: str, target: Path) -> None:
    """Copy the file at `path` in a container of a pod to a file of this machine."""
    words = [*release.flags, "exec", pod, f"--container={container}", "--", "cat", path]
    with target.open("wb") as file:
        run("kubectl", words, stdout=file)


def fetch_logs(release: Release, component: str) -> dict[str, str]:
    """Read the logs of a component's pod: container -> text."""
    pod = find_pod(release, component)
    return {
        container.name: pod_log(release, pod.metadata.name, container.name)
        for container in [*(pod.spec.init_containers or []), *pod.spec.containers]
    }


def pod_log(release: Release, pod: str, container: str, last: int | None = None) -> str:
    """Return the log of a container; with `last`, return only the log of the last `last` [s]."""
    since = {} if last is None else {"since_seconds": last}
    return str(release.request("get", "pods/log", name=pod, container=container, **since))


def read_page(release: Release, pod: str, port: int) -> str:
    """Read the metrics at a port of a pod, over one connection through the API server."""
    from kubernetes import client, stream

    call = client.CoreV1Api(release.client).connect_get_namespaced_pod_portforward
    with explain_errors("forward ports", release.where):
        forward = stream.portforward(call, pod, release.namespace, ports=str(port))
        connection = HTTPConnection(pod, port)
        connection.sock = forward.socket(port)
        connection.sock.settimeout(REQUEST_TIMEOUT)
        try:
            connection.request("GET", "/metrics")
            return connection.getresponse().read().decode()
        finally:
            connection.close()  # so that the client's thread ends
            for thread in threading.enumerate():
                if thread.name.startswith(FORWARDER):
                    thread.join(STOP_LIMIT)
            forward.websocket.shutdown()  # the thread does not, if the server ends first
