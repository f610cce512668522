"""Fly the flights of a sweep as an Indexed Job; each pod prints the results of its flights as rows.

If a pod is lost, Kubernetes starts another pod, and the same flights give the same rows. Therefore
the sweep needs only the Job and a ConfigMap, and no volume.
"""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Iterator
from typing import Any

from cloudrc.cluster.client import ClusterError, Release
from cloudrc.cluster.jobs import create_job, delete_job, failure_of
from cloudrc.cluster.pods import container_statuses, list_pods, pod_failure, pod_log
from cloudrc.errors import to_one_line

COMPONENT = "sweep"
"""Label `component` of the Jobs and pods of sweeps, and name of their container."""
FILE = "flights.json.gz"
RETRIES = 3
"""Largest number of restarts after a pod has failed; pods of a drained node do not count."""
KEEP_FINISHED = 86_400
"""Time for which Kubernetes keeps a finished Job and its logs [s], if nobody fetches the rows."""
LOOK_PERIOD = 2.0
"""Time between two looks at the pods [s]."""
OVERLAP = 10
"""Age of the oldest lines that are read again from the log of a running pod [s]."""
UNSCHEDULED = "no node takes it"
JOB_LABEL = "batch.kubernetes.io/job-name"


def start(
    release: Release,
    name: str,
    flights: bytes,
    shards: int,
    *,
    image: str,
    cpu: str,
    queue: str | None,
) -> None:
    """Create the Job `name` with `shards` pods that fly `flights`.

    A failed Job of this name is replaced; a Job that runs or is complete stays as it is. `flights`
    is a file made by `sweep.plan.pack`, `image` an image with the simulator, `cpu` the CPU request
    of a pod, and `queue` a queue of Kueue. The Job belongs to no Helm release.

    Raises:
        ClusterError: If the cluster refuses the Job, for example because the sweep is too large.
    """
    for job in release.find("jobs", COMPONENT):
        if job.metadata.name == name:
            if not failure_of(job):  # flies, or is complete
                return
            delete_job(release, name, COMPONENT)
    labels = {**release.labels(COMPONENT), "app.kubernetes.io/part-of": "cloudrc"}
    admission = {"kueue.x-k8s.io/queue-name": queue} if queue else {}
    job = {
        "metadata": {"name": name, "labels": {**labels, **admission}},
        "spec": _job_spec(name, shards, image, cpu, labels),
    }
    files = {"binaryData": {FILE: base64.b64encode(flights).decode()}}
    create_job(release, job, files, labels, COMPONENT)


def _job_spec(name: str, shards: int, image: str, cpu: str, labels: dict[str, str]) -> Any:
    container = {
        "name": COMPONENT,
        "image": image,
        "imagePullPolicy": "IfNotPresent",
        "args": ["sweep", "rows", f"/flights/{FILE}", f"--shard=auto/{shards}"],
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "resources": {"requests": {"cpu": cpu, "memory": "256Mi"}, "limits": {"memory": "512Mi"}},
        "volumeMounts": [{"name": "flights", "mountPath": "/flights", "readOnly": True}],
        "terminationMessagePolicy": "FallbackToLogsOnError",
    }
    pod = {
        "restartPolicy": "Never",
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "securityContext": {
            **{"runAsNonRoot": True, "runAsUser": 10001, "runAsGroup": 10001},
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "containers": [container],
        "volumes": [{"name": "flights", "configMap": {"name": name}}],
    }
    disruption = {"type": "DisruptionTarget", "status": "True"}
    codes = {"containerName": COMPONENT, "operator": "In", "values": [2, 3]}
    return {
        "completionMode": "Indexed",
        **{"completions": shards, "parallelism": shards},
        "backoffLimitPerIndex": RETRIES,
        # A drained node costs no retry; bad input fails again however often it is tried.
        "podFailurePolicy": {
            "rules": [
                {"action": "Ignore", "onPodConditions": [disruption]},
                {"action": "FailIndex", "onExitCodes": codes},
            ]
        },
        "ttlSecondsAfterFinished": KEEP_FINISHED,
        "template": {"metadata": {"labels": labels}, "spec": pod},
    }


def read_lines(release: Release, name: str, tell: Callable[[str], None]) -> Iterator[str]:
    """Yield the lines of a Job's logs until the Job is complete; then delete the Job.

    A line may come twice. `tell` receives sentences for the user. A failed Job is not deleted.

    Raises:
        ClusterError: If the Job fails, or if a pod will never run.
    """
    fetched, told = set[str](), set[str]()

    def tell_once(text: str) -> None:
        if text and text not in told:
            told.add(text)
            tell(text)

    ending = None
    while ending is None:
        time.sleep(LOOK_PERIOD)
        ending = failure_of(release.request("get", "jobs", name=name))
        for pod in list_pods(release, COMPONENT):
            if (pod.metadata.labels or {}).get(JOB_LABEL) != name or pod.metadata.uid in fetched:
                continue
            if pod.status.phase == "Pending":
                why = pod_failure(pod)
                if why and not why.startswith(UNSCHEDULED):
                    raise ClusterError(f"Job '{name}' cannot run: {why}; {_remedy(release, name)}")
                tell_once(why and f"some pods wait: {why}")
                continue
            has_ended = pod.status.phase in ("Succeeded", "Failed")
            if has_ended:
                fetched.add(pod.metadata.uid)
                tell_once(_failure(pod))
            yield from _log(release, pod.metadata.name, None if has_ended else OVERLAP)
    if ending:
        raise ClusterError(f"Job '{name}' failed: {ending}; {_remedy(release, name)}")
    delete_job(release, name, COMPONENT)


def _log(release: Release, pod: str, last: int | None) -> list[str]:
    try:
        return pod_log(release, pod, COMPONENT, last).splitlines()
    except ClusterError:  # the pod is gone; its successor flies the same flights
        return []


def _failure(pod: Any) -> str:
    """Return how a pod failed, in one sentence; "" if it succeeded."""
    for container in container_statuses(pod):
        ended = container.state.terminated
        if container.name == COMPONENT and ended and ended.exit_code:
            words = to_one_line(ended.message) or ended.reason
            return f"a pod failed with exit code {ended.exit_code}: {words}"
    return ""


def _remedy(release: Release, name: str) -> str:
    flags = " ".join(release.flags)
    return f"see: kubectl {flags} describe job {name}; then repeat the command"
