# SPDX-License-Identifier: Apache-2.0

"""Run Kubernetes Jobs: create, follow and delete them; fly a mission as a Job.

The chart makes the Job of a mission from the release's values, and keeps it in a ConfigMap; the Job
of a sweep has the form of the chart's `examples/sweep-job.yaml`. The container of a mission's Job
posts the mission to the release's API, follows it, and ends with the exit code of its verdict.
"""

from __future__ import annotations

import json
import re
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import ceil
from typing import Any, NamedTuple

import yaml

from cloudrc.base.errors import TimedOutError, to_one_line
from cloudrc.cluster.client import ClusterError, NotFoundError, Release, chart_folder
from cloudrc.cluster.incidents import ReleaseWatch
from cloudrc.cluster.pods import (
    Finding,
    PodWatch,
    container_statuses,
    describe_end,
    events_of,
    find_workload,
    fleet_size,
    pod_failure,
    pod_log,
)
from cloudrc.cluster.releases import COMPONENT as LABEL
from cloudrc.teleop.client import describe_verdict

COMPONENT = "mission"
"""Label `component` of the Jobs, pods and ConfigMaps of missions, and name of their container."""
FILE = "mission.yaml"
"""Key in the ConfigMap under which the mission is stored."""
VOLUME = "mission"
"""Volume of the Job's pod with this ConfigMap."""
KILLED_WATCHER = (137, 143)
"""Exit codes of a watcher that was killed: by SIGKILL, or by SIGTERM."""
UID_LABEL = "batch.kubernetes.io/controller-uid"
"""Label with the Job's UID, which Kubernetes sets on the Job's pods."""
TEMPLATE, TEMPLATE_FILE = "mission-job", "job.yaml"
"""Label `component` of the ConfigMap with the Job of a mission, and key of the Job in it."""
START_ALLOWANCE = 120
"""Time to start the pod and to get the robot's state, added to the mission's time limit [s]."""
QUEUE_ALLOWANCE = 3600
"""Time for earlier missions to end, added to the time limit of a Job that may wait [s]."""
LIMIT_MAX = 86_400
"""Time limit of a mission without a valid time limit [s]. Teleop ends the mission earlier."""
KEEP_FINISHED = 3600
"""Time for which Kubernetes keeps the finished Job of a mission [s]."""
LOOK_PERIOD = 1.0
"""Time between two requests for the state of a Job and its pods [s]."""
OVERLAP = 10
"""Time before the last read of the log of a running pod from which lines are read again [s]."""
TOGETHER, EACH = 10.0, 0.3
"""Time after which the robots of a fleet begin together, and more for each robot [s]: meanwhile
their pods start, and their metrics are read."""
AT = "--at="
"""Flag of the Job's container: the Unix time at which a robot begins [s]."""
NO_LOG = "unable to retrieve container logs for "
"""What the kubelet sends in place of the log of a container that is gone."""
NO_CLAIM = re.compile('persistentvolumeclaim "[^"]*" not found')
"""What Kubernetes says of a pod whose claim does not exist: nobody else makes it."""
DELETE_LIMIT = 40.0
"""Time limit for a deleted Job to end [s]; Kubernetes gives the Job's pods 30 s."""


class Ended(NamedTuple):
    """How a mission's Job ended."""

    exit_code: int  # of the container
    message: str  # verdict in words, or why the Job failed
    codes: tuple[str, ...] = ()  # of the verdict's failures


def read_end(state: Any) -> Ended:
    """Return how the container of a mission ended; `state` is its state `terminated`.

    It leaves its verdict as JSON, as the API's model `Verdict`. Without a verdict, Kubernetes has
    the last lines of its log.
    """
    from cloudrc.teleop.models import Verdict

    try:
        verdict = Verdict.model_validate_json(state.message or "")
    except ValueError:
        return Ended(state.exit_code, to_one_line(state.message))
    codes = tuple(failure.code for failure in verdict.failures)
    return Ended(state.exit_code, to_one_line(describe_verdict(verdict.model_dump())), codes)


def run_job(
    release: Release,
    mission: Mapping[str, Any],
    *,
    name: str = "",
    queue: bool = False,
) -> str:
    """Create the Job of a mission, and return its name; the Job runs even if nobody follows it.

    Args:
        release: Release that flies the mission.
        mission: Mission in the API's format: name, start, time_limit_s, waypoints.
        name: Name of the Job; default: an unused name.
        queue: Whether to wait while another mission flies; else the API takes no second one.

    Raises:
        ClusterError: If the cluster denies the Job, or if the release does not exist.
    """
    # A Job's pod has a longer name than the Job; the limit is 63 characters.
    name = name or f"{release.name[:40].rstrip('-.')}-mission-{secrets.token_hex(3)}"
    job = _read_template(release)
    labels = {**release.labels(COMPONENT), "app.kubernetes.io/managed-by": "cloudrc"}
    labels |= job.get("metadata", {}).get("labels", {})  # of Kueue
    owner = owner_of("apps/v1", *find_workload(release, "cloud"))
    job["metadata"] = {"name": name, "labels": labels, "ownerReferences": [owner]}
    given = mission.get("time_limit_s")
    # The API takes a mission with such a limit only.
    limit = ceil(given) if isinstance(given, int | float) and 0 < given <= 1e6 else LIMIT_MAX
    robots = fleet_size(release)  # may have changed since the chart was installed
    together = TOGETHER + EACH * robots if robots else 0.0
    deadline = limit + START_ALLOWANCE + queue * QUEUE_ALLOWANCE + ceil(together)
    job["spec"] |= {"activeDeadlineSeconds": deadline, "ttlSecondsAfterFinished": KEEP_FINISHED}
    arguments = job["spec"]["template"]["spec"]["containers"][0]["args"]
    if queue:
        arguments.append("--queue")
    if robots:
        job["spec"] |= {"completions": robots, "parallelism": robots}
        arguments.append(f"{AT}{ceil(time.time() + together)}")
    data = {FILE: json.dumps(mission, indent=2) + "\n"}
    create_job(release, job, {"apiVersion": "v1", "kind": "ConfigMap", "data": data}, VOLUME)
    return name


def _read_template(release: Release) -> Any:
    """Read the Job of a mission that the chart has made from the release's values."""
    for found in release.find("configmaps", TEMPLATE):
        return yaml.safe_load(found.data[TEMPLATE_FILE])
    raise ClusterError(f"{release} has another version of the chart: {release.helm_upgrade()}")


def read_example(release: Release, component: str, name: str) -> tuple[Any, Any]:
    """Read ConfigMap and Job from the chart's example for a component, such as "sweep".

    Both get the name `name`, and the Job gets the labels of the release.
    """
    text = (chart_folder() / f"examples/{component}-job.yaml").read_text("utf-8")
    files, job = yaml.safe_load_all(text)
    template, labels = job["spec"]["template"], job["metadata"]["labels"]
    # The NetworkPolicies select pods by the labels of the release.
    labels |= {**release.labels(component), "app.kubernetes.io/managed-by": "cloudrc"}
    template["metadata"]["labels"] = labels
    job["metadata"]["name"] = name
    return files, job


def create_job(release: Release, job: Any, files: Any, volume: str, **given: str) -> None:
    """Create a Job, and `files` as a ConfigMap of the same name, which its pods mount as `volume`.

    If the ConfigMap cannot be created, delete the Job. `given` are arguments of the client.
    """
    name = job["metadata"]["name"]
    for each in job["spec"]["template"]["spec"]["volumes"]:
        if each["name"] == volume:  # the others are the release's, or the user's
            each["configMap"]["name"] = name
    created = release.request("create", "jobs", body=job, **given)
    owner = owner_of("batch/v1", "Job", created)
    labels = job["metadata"]["labels"]
    files["metadata"] = {"name": name, "labels": labels, "ownerReferences": [owner]}
    try:
        release.request("create", "configmaps", body=files)
    except ClusterError:  # without its files the Job would wait
        delete_job(release, name)
        raise


def owner_of(version: str, kind: str, owner: Any) -> dict[str, Any]:
    """Make an owner reference: deleting `owner` also deletes the objects with this reference."""
    metadata = owner.metadata
    return {"apiVersion": version, "kind": kind, "name": metadata.name, "uid": metadata.uid}


def find_job(release: Release, name: str) -> Any:
    """Return the Job `name`; None if there is no such Job."""
    found = release.request("list", "jobs", field_selector=f"metadata.name={name}")
    return next(iter(found), None)


def job_key(release: Release, name: str) -> str:
    """Return the UID of a Job, which is the key of its mission."""
    return str(release.request("get", "jobs", name=name).metadata.uid)


def delete_job(release: Release, name: str) -> None:
    """Delete a Job with its pods and ConfigMap; the mission of a Job ends later, with its lease."""
    release.request("delete", "jobs", name=name, propagation_policy="Foreground")
    until = time.monotonic() + DELETE_LIMIT
    while find_job(release, name) is not None:
        if time.monotonic() > until:
            raise TimedOutError(
                f"Job '{name}' has not ended {DELETE_LIMIT:g} s after its deletion; "
                f"see: {release.kubectl} describe job {name}"
            )
        time.sleep(LOOK_PERIOD)


def failure_of(job: Any) -> str | None:
    """Return why a Job has failed, "" if it is complete, None if it has not ended."""
    for condition in job.status.conditions or []:
        if condition.status == "True" and condition.type == "Complete":
            return ""
        if condition.status == "True" and condition.type == "Failed":
            where = f" (index {job.status.failed_indexes})" if job.status.failed_indexes else ""
            return f"{condition.reason}: {condition.message}{where}"
    return None


class JobGoneError(ClusterError):
    """Report that a Job does not follow its mission: it was deleted, or has failed."""

    def __init__(self, why: str, key: str) -> None:
        """Store the Job's UID as `key`: it is the key of the Job's mission."""
        super().__init__(why)
        self.key = key


def follow(release: Release, name: str, write: Callable[[str], None]) -> Ended:
    """Follow a mission's Job until it has ended; `write` receives each line of the Job's log.

    `write` also receives a sentence about what happens to the pods of the release. Kubernetes ends
    the Job after the Job's time limit.

    Raises:
        ClusterError: If the Job's pod cannot run; the message names the cause.
        JobGoneError: If the Job was deleted, or has ended without a verdict.
    """
    states, watch = list[Any](), ReleaseWatch(release.patient(write))

    def see_end(pod: Any, state: Any) -> str:
        states.append(state)
        killed = state.reason == "OOMKilled"
        return f"the Job's pod {describe_end(COMPONENT, state)}" if killed else ""

    reader = JobReader(release, name, write, see_end, watch.look)
    for line in reader.read():
        write(line)
    cause = failure_of(reader.job) or ""
    if not states or states[-1].exit_code in KILLED_WATCHER:
        raise JobGoneError(f"its Job has ended without a verdict: {cause}", reader.key)
    ended = read_end(states[-1])
    return ended._replace(message=ended.message or cause)


class JobReader:
    """Reads the logs of a Job's pods until the Job has ended; says each sentence only once."""

    def __init__(
        self,
        release: Release,
        name: str,
        tell: Callable[[str], None],
        see_end: Callable[[Any, Any], str],
        look: Callable[[], Iterable[str]] = tuple,
        *,
        logs: bool = True,
    ) -> None:
        """Read the Job `name`.

        `see_end` receives each pod that ends and the final state of its container; it returns a
        sentence about it, or "". `tell` receives this sentence, and others if a pod waits for a
        node, or if the log of an ended pod cannot be read. `tell` also receives the sentences that
        `look` returns. Without `logs`, no log is read.
        """
        self._release, self._name, self._tell = release.patient(tell), name, tell
        self._see_end, self._look, self._logs = see_end, look, logs
        self._told, self._read = set[str](), set[str]()  # sentences; UIDs of pods
        self._read_at = dict[str, float]()  # UID of a running pod -> time of its last read [s]
        self._seen = set[int]()  # hashes of lines
        self.key = ""  # UID of the Job
        self.job: Any = None  # as it was seen last

    def read(self) -> Iterator[str]:
        """Yield each different line of the logs of all pods.

        However many pods there are, a look takes four requests, one of them to read the log of one
        running pod, in turn; and each pod that has ended takes one more, once.
        """
        self._look_at_job()
        selector = f"{UID_LABEL}={self.key}"
        watch = PodWatch(self._release, selector)
        while True:
            began = time.monotonic()
            if has_ended := failure_of(self.job) is not None:
                pods = self._release.request("list", "pods", label_selector=selector)
            else:
                watch.look()
                pods = [*watch.pods.values()]
            pods.sort(key=lambda pod: str(pod.metadata.creation_timestamp))
            self._tell_once("waiting: the Job is suspended" if self.job.spec.suspend else "")
            self._tell_once("" if has_ended else why_waiting(self._release, self.job, pods))
            yield from self._read_pods(pods, has_ended=has_ended)
            for sentence in self._look():
                self._tell(sentence)
            if has_ended:
                return
            time.sleep(max(0.0, began + LOOK_PERIOD - time.monotonic()))
            self._look_at_job()

    def _look_at_job(self) -> None:
        try:
            self.job = self._release.request("get", "jobs", name=self._name)
        except NotFoundError:
            if not self.key:
                raise
            raise JobGoneError("its Job was deleted", self.key) from None
        self.key = self.job.metadata.uid
        if self.job.metadata.deletion_timestamp is not None:
            raise JobGoneError("its Job was deleted", self.key)

    def _read_pods(self, pods: list[Any], *, has_ended: bool) -> Iterator[str]:
        """Yield the new lines of the pods that have ended, and of one that runs.

        If the Job `has_ended`, nothing more comes: read all pods to their end.
        """
        running = list[Any]()
        for pod in pods:
            if pod.status.phase == "Pending" or pod.metadata.uid in self._read:
                continue
            ended = self._end_of(pod)
            if ended is None and pod.status.phase == "Running" and not has_ended:
                running.append(pod)
                continue
            self._read.add(pod.metadata.uid)
            self._tell_once(self._see_end(pod, ended) if ended else "")
            yield from self._read_log(pod, None)
        if running:
            pod = min(running, key=lambda each: self._read_at.get(each.metadata.uid, 0.0))
            now, before = time.monotonic(), self._read_at.get(pod.metadata.uid)
            self._read_at[pod.metadata.uid] = now
            last = None if before is None else ceil(now - before) + OVERLAP
            yield from self._read_log(pod, last)

    def _end_of(self, pod: Any) -> Any:
        """Return the final state of the Job's container in a pod; None if it has not ended."""
        # A service mesh may add containers, which end later.
        own = (each for each in container_statuses(pod) if each.name == self._container)
        return next((each.state.terminated for each in own), None)

    @property
    def _container(self) -> str:
        return str(self.job.metadata.labels[LABEL])

    def _read_log(self, pod: Any, last: int | None) -> Iterator[str]:
        """Yield the new lines of the last `last` [s] of a pod's log; None: of the whole log."""
        if not self._logs:
            return
        try:
            log = pod_log(self._release, pod.metadata.name, self._container, last)
        except ClusterError as error:  # the pod may be gone
            self._tell_once(str(error) if last is None else "")
            return
        for line in () if log.startswith(NO_LOG) else log.splitlines():
            if hash(line) not in self._seen:
                self._seen.add(hash(line))
                yield line

    def _tell_once(self, text: str) -> None:
        if text and text not in self._told:
            self._told.add(text)
            self._tell(text)


def why_waiting(release: Release, job: Any, pods: list[Any]) -> str:
    """Return a sentence on why pods of a Job wait; "" if none waits.

    Raise a ClusterError if a pod will never run, or if the cluster denies the pods.
    """
    name = job.metadata.name
    found = [pod_failure(pod) for pod in pods if pod.status.phase == "Pending"]
    if not pods:  # the cluster may deny them, for example for a quota
        denied = events_of(release, job, "FailedCreate")
        found = [Finding(name, "missing", text) for text in denied if text]
    for why in filter(None, found):
        if why.state == "missing" or NO_CLAIM.search(why.found):
            raise ClusterError(
                f"Job '{name}' cannot start: {why}; fix this, then delete the Job: "
                f"{release.kubectl} delete job {name}"
            )
    return next((f"waiting: {why}" for why in found if why), "")
