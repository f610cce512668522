# SPDX-License-Identifier: Apache-2.0

"""Fly the flights of a sweep as an Indexed Job; each pod prints the results of its flights as rows.

If a pod is lost, Kubernetes starts another pod, and the same flights give the same rows. Therefore
the sweep needs only the Job and a ConfigMap. With a claim or a bucket each pod also keeps its rows
there, and the next pod prints those that it finds, instead of flying again.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from cloudrc.base.errors import RejectedError, to_one_line
from cloudrc.base.outside.document import KeyPath
from cloudrc.base.text import suggest_name
from cloudrc.cluster.client import ClusterError, NoAnswerError, Release, chart_folder
from cloudrc.cluster.jobs import (
    JobReader,
    create_job,
    delete_job,
    failure_of,
    find_job,
    read_example,
)
from cloudrc.config.problems import problem_at

if TYPE_CHECKING:
    from cloudrc.config.resolved import ResolvedExperiment

COMPONENT = "sweep"
"""Label `component` of the Jobs and pods of sweeps, and name of their container."""
FILE = "flights.json.gz"
"""Key in the ConfigMap under which the flights are stored."""
VOLUME = "flights"
"""Volume of the pods with this ConfigMap."""
REMEDIES = {
    **dict.fromkeys(
        ("exceeded quota", "usage per", "Insufficient"),
        "then repeat the command, with less: --cpu, --cpu-limit, --memory or fewer --shards",
    ),
    "persistentvolumeclaim": "make the claim, or repeat the command with another: --claim",
    "PodSecurity": "then repeat the command, with the rights that it asks for: --set-job",
    "was deleted": "repeat the command: it flies what is missing",
}
"""Words about a Job whose pods do not run -> what a user can do."""
OUT_OF_MEMORY = (
    "it used more memory than the limit of its container (OOMKilled); "
    "raise it, such as --memory 1Gi, or fly shorter missions"
)
"""How a pod has ended whose flight needs too much memory."""
FAILED_SHARE = 10
"""The Job ends early once more than one shard of so many has failed: then all would."""
LEVELS = ("V1JobSpec", "V1PodSpec", "V1Container")
"""Kinds of what has the fields of a Job."""
OF_CONTAINER = ("resources", "securityContext")
"""Fields of both a pod and its container that apply to the container if it can have them."""
STORE = "/rows"
"""Folder in which the pods mount the claim."""


class PodSettings(NamedTuple):
    """The pods that a sweep asks for."""

    shards: int  # number of pods
    image: str | None  # with the simulator; None: that of the chart's example
    cpu: str  # CPU request of a pod, such as "500m"
    queue: str | None = None  # of Kueue
    parallelism: int | None = None  # number of pods at once; None: all
    cpu_limit: str | None = None
    memory: str | None = None  # request and limit; None: those of the chart's example
    claim: str | None = None  # PersistentVolumeClaim that keeps the rows
    bucket: str | None = None  # folder of a bucket that keeps the rows, such as s3://lab/sweeps
    changes: Mapping[KeyPath, Any] = {}  # path of a field of the Job -> value

    def place(self, name: str) -> str | None:
        """Return where the pods of a Job keep their rows; None: in their logs alone."""
        above = self.bucket or (STORE if self.claim else "")
        return f"{above.rstrip('/')}/{name}" if above else None


def image_for(points: Iterable[ResolvedExperiment]) -> str | None:
    """Return the image that the experiments of a sweep need; None: that of the chart's example.

    A camera needs the one that the chart's values name for it.
    """
    codecs = {each.camera.codec for each in points if each.camera is not None}
    if "h264" in codecs:
        text = "needs PyAV, which the image of pods does not have; choose jpeg, or name one of your"
        raise problem_at("camera.codec", f"h264 {text} own that has it: --image")
    if not codecs:
        return None
    chart = chart_folder()
    image = yaml.safe_load((chart / "values.yaml").read_text("utf-8"))["image"]
    own, version = image["worldCamera"], yaml.safe_load((chart / "Chart.yaml").read_text("utf-8"))
    name = "/".join(filter(None, (image["registry"], own["repository"])))
    tag = image["tag"] or version["appVersion"]
    return f"{name}@{own['digest']}" if own["digest"] else f"{name}:{tag}"


def unknown_field(changes: Iterable[KeyPath]) -> str:
    """Say which of the paths is no field of the Job, and a similar field; "" if each is one."""
    from kubernetes import client

    for path in changes:
        if not _level_of(path):
            fields = [
                name for kind in LEVELS for name in getattr(client, kind).attribute_map.values()
            ]
            text = "neither a Job nor its pod or container has this field"
            hint = suggest_name(path[0], fields)
            return f"{'.'.join(path)}: {text}{hint}"
    return ""


def _level_of(path: KeyPath) -> str:
    """Return which of `LEVELS` has the field of this path; "" if none has it."""
    from kubernetes import client

    def has_field(level: str) -> bool:
        kind: Any = getattr(client, level)
        for part in path:
            names = {name: attribute for attribute, name in kind.attribute_map.items()}
            if part not in names:
                return False
            kind = getattr(client, kind.openapi_types[names[part]], None)
            if kind is None:  # a number, list or mapping
                break
        return True

    order = reversed(LEVELS) if path[0] in OF_CONTAINER else LEVELS
    return next(filter(has_field, order), "")


def start(
    release: Release,
    name: str,
    flights: bytes,
    settings: PodSettings,
    own_files: Iterable[str] = (),
) -> None:
    """Create the Job `name` whose pods fly `flights`, a file made by `flight.trials.plan.pack`.

    A failed Job of this name is replaced; a Job that runs or is complete stays as it is. The Job
    belongs to no Helm release. The pods have `own_files` at the same paths as this machine.

    Raises:
        ClusterError: If the cluster rejects the Job, for example because the sweep is too large.
    """
    if (earlier := find_job(release, name)) is not None:
        if not failure_of(earlier):  # flies, or is complete
            return
        delete_job(release, name)
    files, job = read_example(release, COMPONENT, name)
    files["binaryData"] = {FILE: base64.b64encode(flights).decode()}
    _set_up(job, name, settings)
    pod = job["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    for number, own in enumerate(own_files):
        key = f"own-{number}"
        files["binaryData"][key] = base64.b64encode(Path(own).read_bytes()).decode()
        mount = {"name": VOLUME, "mountPath": own, "subPath": key, "readOnly": True}
        container["volumeMounts"].append(mount)
    for path, value in settings.changes.items():
        node = dict(zip(LEVELS, (job["spec"], pod, container), strict=True))[_level_of(path)]
        for part in path[:-1]:
            node = node.setdefault(part, {})
        node[path[-1]] = value
    create_job(release, job, files, VOLUME, field_validation="Strict")


def _set_up(job: Any, name: str, settings: PodSettings) -> None:
    """Give the Job its number of pods, and the pods what they ask for."""
    shards, spec = settings.shards, job["spec"]
    pod = spec["template"]["spec"]
    (container,) = pod["containers"]
    if settings.queue:
        labels = job["metadata"]["labels"]  # the pods keep theirs
        job["metadata"]["labels"] = {**labels, "kueue.x-k8s.io/queue-name": settings.queue}
    spec |= {"completions": shards, "parallelism": min(settings.parallelism or shards, shards)}
    spec["maxFailedIndexes"] = max(1, shards // FAILED_SHARE)
    container["image"] = settings.image or container["image"]
    container["args"] = [str(shards)]
    requests, limits = container["resources"]["requests"], container["resources"]["limits"]
    requests["cpu"] = settings.cpu
    if settings.cpu_limit:
        limits["cpu"] = settings.cpu_limit
    if settings.memory:
        requests["memory"] = limits["memory"] = settings.memory
    if place := settings.place(name):
        container["args"].append(f"--out={place}")
    if settings.claim:
        claim = {"claimName": settings.claim}
        pod["volumes"].append({"name": "rows", "persistentVolumeClaim": claim})
        container["volumeMounts"].append({"name": "rows", "mountPath": STORE})


def read_lines(release: Release, name: str, tell: Callable[[str], None]) -> Iterator[str]:
    """Yield the lines of a Job's logs until the Job is complete; then delete the Job.

    `tell` receives sentences for the user. A failed Job is not deleted, unless its pods reject the
    flights.

    Raises:
        RejectedError: If a pod rejects the flights, for example because its image has other code.
        ClusterError: If the Job fails, or if a pod will never run.
    """
    failures = list[str]()

    def describe_end(pod: Any, state: Any) -> str:
        words = to_one_line(state.message) or state.reason
        if state.exit_code == RejectedError.exit_code:  # the other pods would, too
            delete_job(release, name)
            raise RejectedError(f"the pods reject the flights: {words}")
        if not state.exit_code:
            return ""
        words = OUT_OF_MEMORY if state.reason == "OOMKilled" else words
        failures.append(f"a pod failed with exit code {state.exit_code}: {words}")
        return failures[-1]

    try:
        yield from JobReader(release, name, tell, describe_end).read()
    except NoAnswerError as error:
        raise NoAnswerError(f"{error}; Job '{name}' goes on without this command") from None
    except ClusterError as error:
        fixes = (fix for words, fix in REMEDIES.items() if words in str(error))
        raise ClusterError("; ".join([str(error), *[*fixes][:1]])) from None
    if ending := failure_of(release.request("get", "jobs", name=name)):
        see = f"see: {release.kubectl} describe job {name}; then repeat the command"
        causes = [f"Job '{name}' failed: {ending}", *failures[-1:], see]
        raise ClusterError("; ".join(causes))
    delete_job(release, name)
