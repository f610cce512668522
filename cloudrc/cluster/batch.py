"""Fly the flights of a sweep as an Indexed Job; each pod prints the results of its flights as rows.

If a pod is lost, Kubernetes starts another pod, and the same flights give the same rows. Therefore
the sweep needs only the Job and a ConfigMap, and no volume.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from cloudrc.cluster.client import ClusterError, Release
from cloudrc.cluster.jobs import (
    JobReader,
    create_job,
    delete_job,
    failure_of,
    find_job,
    read_example,
)
from cloudrc.errors import BadInputError, to_one_line

COMPONENT = "sweep"
"""Label `component` of the Jobs and pods of sweeps, and name of their container."""
FILE = "flights.json.gz"
"""Key in the ConfigMap under which the flights are stored."""
REMEDY = "repeat the command, perhaps with a smaller request, --cpu 500m, or with fewer --shards"
"""What a user can do if the cluster does not run the pods."""
OUT_OF_MEMORY = (
    "it used more memory than the limit of its container (OOMKilled); "
    "fly shorter missions, or without --on"
)
"""How a pod has ended whose flight needs too much memory."""


class PodSettings(NamedTuple):
    """The pods that a sweep asks for."""

    shards: int  # number of pods
    image: str | None  # with the simulator; None: that of the chart's example
    cpu: str  # CPU request of a pod, such as "500m"
    queue: str | None = None  # of Kueue


def start(release: Release, name: str, flights: bytes, settings: PodSettings) -> None:
    """Create the Job `name` whose pods fly `flights`, a file made by `trials.plan.pack`.

    A failed Job of this name is replaced; a Job that runs or is complete stays as it is. The Job
    belongs to no Helm release.

    Raises:
        ClusterError: If the cluster refuses the Job, for example because the sweep is too large.
    """
    shards, image, cpu, queue = settings
    if (earlier := find_job(release, name)) is not None:
        if not failure_of(earlier):  # flies, or is complete
            return
        delete_job(release, name)
    files, job = read_example(release, COMPONENT, name)
    if queue:
        labels = job["metadata"]["labels"]  # the pods keep theirs
        job["metadata"]["labels"] = {**labels, "kueue.x-k8s.io/queue-name": queue}
    job["spec"] |= {"completions": shards, "parallelism": shards}
    (container,) = job["spec"]["template"]["spec"]["containers"]
    container["image"] = image or container["image"]
    container["args"] = [str(shards)]
    container["resources"]["requests"]["cpu"] = cpu
    files["binaryData"] = {FILE: base64.b64encode(flights).decode()}
    create_job(release, job, files)


def read_lines(release: Release, name: str, tell: Callable[[str], None]) -> Iterator[str]:
    """Yield the lines of a Job's logs until the Job is complete; then delete the Job.

    `tell` receives sentences for the user. A failed Job is not deleted, unless its pods refuse the
    flights.

    Raises:
        BadInputError: If a pod refuses the flights, for example because its image has other code.
        ClusterError: If the Job fails, or if a pod will never run.
    """
    failures = list[str]()

    def describe_end(state: Any) -> str:
        words = to_one_line(state.message) or state.reason
        if state.exit_code == BadInputError.exit_code:  # the other pods refuse them, too
            delete_job(release, name)
            raise BadInputError(f"the pods refuse the flights: {words}")
        if not state.exit_code:
            return ""
        words = OUT_OF_MEMORY if state.reason == "OOMKilled" else words
        failures.append(f"a pod failed with exit code {state.exit_code}: {words}")
        return failures[-1]

    try:
        yield from JobReader(release, name, tell, describe_end).read()
    except ClusterError as error:
        raise ClusterError(f"{error}; {REMEDY}") from None
    if ending := failure_of(release.request("get", "jobs", name=name)):
        see = f"see: {release.kubectl} describe job {name}; then repeat the command"
        causes = [f"Job '{name}' failed: {ending}", *failures[-1:], see]
        raise ClusterError("; ".join(causes))
    delete_job(release, name)
