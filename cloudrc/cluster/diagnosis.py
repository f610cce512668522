# SPDX-License-Identifier: Apache-2.0

"""Find the causes of an ill release, and the remedies, from what its cluster and pods returned.

No function sends a request; `cloudrc.cluster.incidents` observes a release and calls these.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

from cloudrc.base.errors import to_one_line
from cloudrc.base.outside.prometheus import Metrics, total
from cloudrc.cluster.client import COMPONENTS, Release
from cloudrc.cluster.pods import (
    VALUES,
    Finding,
    container_statuses,
    describe_end,
    pod_failure,
)

MISSING = ("not found", "non-existent")
"""Words of Kubernetes about a volume, such as a Secret, that somebody has to make."""
REMEDIES = {
    "exceeded quota": "ask for a larger quota, or set smaller resources of the containers",
    "PodSecurity": "set link.mode=relay, which needs no privileges",
    "storageclass": "name a StorageClass of the cluster: kubectl get storageclasses",
    "persistentvolumeclaim": "make the claim, or name one that exists: recordings.existingClaim",
    "Insufficient": "add a node, or set smaller requests of the containers",
    'secret "': "make the Secret, or correct the value that names it",
    'configmap "': "make the ConfigMap, or correct the value that names it",
}
"""Words of Kubernetes about a pod that does not run -> what to do."""
DNS_REMEDY = (
    "does the cluster's DNS have pods? kubectl --namespace=kube-system get pods -l "
    "k8s-app=kube-dns; may the pods of the release ask it? networkPolicy.dns"
)
"""What to do if a pod cannot resolve a name."""
LOOK_UP = """\
import os, socket, sys
os.environ["RES_OPTIONS"] = "timeout:1 attempts:1"
try:
    socket.getaddrinfo(sys.argv[1], None)
except OSError as error:
    sys.exit(f"{sys.argv[1]}: {error}")
"""
"""Program for Python in a pod: fails within seconds if a name cannot be resolved."""
THROTTLED_MIN = 0.25
"""Smallest share of the scheduler's periods in which a CPU limit that stops a container is told."""
LOOK_AGAIN = 0.02
"""Share of these periods since a start above which a second look shows the present."""
PERIODS_MIN = 5
"""Smallest number of these periods from which the share is computed."""
READY = "cloudrc_ready"
"""Metric: whether an end hears the other end."""
DATAGRAMS = "cloudrc_datagrams_total"
"""Metric: the datagrams of an end by outcome."""
KEY = "secret"
"""Name of the volume with the key of the tunnel."""
UPLINK, DOWNLINK = ("world", "cloud", "uplink"), ("cloud", "world", "downlink")
"""Sender, receiver and name of each direction."""


class Objects(NamedTuple):
    """What the API server has of a release."""

    workloads: Mapping[str, Any]  # component -> Deployment, in a fleet StatefulSet
    pods: Mapping[str, list[Any]]  # component -> its pods, the newest first
    events: Sequence[Any]  # of the namespace

    def said(self, thing: Any, reason: str) -> list[str]:
        """Return what Kubernetes said about an object with this reason, such as FailedMount."""
        uid = thing.metadata.uid
        found = (each for each in self.events if each.involved_object.uid == uid)
        return [to_one_line(each.message) for each in found if each.reason == reason]


Pages = Mapping[tuple[str, str], Metrics]
"""Component and container -> its metrics; of one robot."""


def remedy(words: str, otherwise: str = "") -> str:
    """Return what to do about a pod that does not run, from what Kubernetes says of it."""
    return next((text for part, text in REMEDIES.items() if part in words), otherwise)


def why_not_ready(objects: Objects, component: str) -> Finding | None:
    """Return why a component is not ready; None if it is. "missing": it can never be ready."""
    name = f"{component} pod"
    workload, found = objects.workloads[component], objects.pods[component]
    for condition in workload.status.conditions or []:  # for example Pod Security or a quota
        if condition.type == "ReplicaFailure" and condition.status == "True":
            return Finding(name, "missing", to_one_line(condition.message))
    for pod in found:
        if why := pod_failure(pod):
            return why._replace(state="missing")
    status, wanted = workload.status, workload.spec.replicas
    if len(found) < wanted and (denied := objects.said(workload, "FailedCreate")):
        return Finding(name, "warn", denied[-1])  # of a StatefulSet, which has no such condition
    is_observed = (status.observed_generation or 0) >= workload.metadata.generation
    if not (is_observed and len(found) >= wanted == status.updated_replicas == status.replicas):
        return Finding(name, "warn", "its pod is being created")
    states = (_pod_state(objects, pod) for pod in found[:wanted])
    return next(filter(None, states), None)


def is_ready(pod: Any) -> bool:
    """Return whether all containers of a pod are ready."""
    return any(
        each.type == "Ready" and each.status == "True" for each in pod.status.conditions or []
    )


def _pod_state(objects: Objects, pod: Any) -> Finding | None:
    """Return why a pod is not ready; None if it is. "missing": it can never be ready."""
    name = pod.metadata.name
    if is_ready(pod):
        return None
    if pod.status.phase == "Pending":
        if failed := [*objects.said(pod, "FailedMount"), *_claims_wait(objects, pod)]:
            is_fatal = any(words in failed[-1] for words in MISSING)
            return Finding(name, "missing" if is_fatal else "warn", failed[-1])
    waiting = [each.name for each in container_statuses(pod) if not each.ready]
    if waiting:
        return Finding(name, "warn", f"container {' and '.join(waiting)} is not ready yet")
    if pod.status.phase == "Pending":
        return Finding(name, "warn", "it starts")
    # Kubernetes, not the kubelet, has taken the readiness from a pod whose containers are ready.
    text = f"its node '{pod.spec.node_name}' does not answer, see: kubectl get nodes"
    return Finding(name, "warn", text)


def _claims_wait(objects: Objects, pod: Any) -> Iterator[str]:
    """Yield why the claims of a pod get no volume, such as a StorageClass that does not exist."""
    volumes = [each.persistent_volume_claim for each in pod.spec.volumes or []]
    claims = {each.claim_name for each in volumes if each}
    for event in objects.events:
        about = event.involved_object
        if event.reason == "ProvisioningFailed" and about.name in claims:
            yield f"claim '{about.name}' gets no volume: {to_one_line(event.message)}"


def ended_containers(component: str, pod: Any) -> Iterator[tuple[Any, Any, str]]:
    """Yield status, last end and a sentence about it for each container of a pod that ended."""
    for status in container_statuses(pod):
        ended = status.last_state and status.last_state.terminated
        if ended:
            how = describe_end(status.name, ended)
            yield status, ended, f"container '{status.name}' of the {component} pod {how}"


def diagnose(
    release: Release,
    objects: Objects,
    robots: Sequence[tuple[Pages, Pages]] = (),
    unresolved: Sequence[str] = (),
) -> list[Finding]:
    """List the causes for which a release does not fly, or not well; [] if it is healthy.

    What follows from another cause is left out, such as a container that is not ready because it
    hears nothing.

    Args:
        release: The release, for the commands in the remedies.
        objects: What the API server has of it.
        robots: The metrics of each robot, read twice with some seconds between.
        unresolved: Names of pods whose link cannot resolve the name of the other end.
    """
    found, waits = list[Finding](), list[Finding]()
    see = f"see: {release.kubectl} describe pods -l app.kubernetes.io/instance={release.name}"
    for component in objects.workloads:
        name = f"{component} pod"
        if ends := [*_ends(release, objects, component)]:
            found += ends
            continue
        if why := why_not_ready(objects, component):
            if fix := remedy(str(why)):  # it needs a person, even if Kubernetes tries again
                why = Finding(name, "missing", str(why), fix)
            is_fatal = why.state == "missing"
            verb = "cannot run" if is_fatal else "waits"
            one = Finding(name, "missing", f"the {name} {verb}: {why.found}", why.fix or see)
            (found if is_fatal else waits).append(one)
    if unresolved:
        text = f"the link of {' and of '.join(unresolved)} cannot resolve the name of the other end"
        found.append(Finding("DNS", "missing", text, DNS_REMEDY))
    for before, after in robots:
        found += _limits_tell(release, before, after)
        if not unresolved:
            found += _network_tells(release, objects, before, after)
    return [*dict.fromkeys(found or waits)]


def _ends(release: Release, objects: Objects, component: str) -> Iterator[Finding]:
    """Yield the containers that end before they work, or that were killed for their memory."""
    for pod in objects.pods[component]:
        for status, ended, text in ended_containers(component, pod):
            was_killed = ended.reason == "OOMKilled"
            if status.started and not was_killed:
                continue
            log = f"{release.kubectl} logs {pod.metadata.name} -c {status.name} --previous"
            change = release.helm_upgrade(f"{_section(status.name)}.resources.limits.memory=SIZE")
            state: Literal["warn", "missing"] = "warn" if status.started else "missing"
            yield Finding(f"{component} pod", state, text, change if was_killed else f"see: {log}")


def _section(container: str) -> str:
    return VALUES.get(container, container)


def is_suspicious(pages: Pages) -> bool:
    """Return whether a robot's metrics tell of a trouble, so that its counters need a second look.

    An end is ready if it hears the other end.
    """
    for (_, container), page in pages.items():
        deaf = container in COMPONENTS and not total(page, READY)
        is_stopped = _throttled({}, page) > LOOK_AGAIN
        if deaf or total(page, "cloudrc_dns_errors_total") or is_stopped:
            return True
    return False


def _limits_tell(release: Release, before: Pages, after: Pages) -> Iterator[Finding]:
    """Yield the containers of one robot that their CPU limit stops."""
    for (component, container), page in after.items():
        share = _throttled(before.get((component, container), {}), page)
        if share >= THROTTLED_MIN:
            key = f"{_section(container)}.resources.limits.cpu"
            text = f"container '{container}' of the {component} pod is stopped by its CPU limit in"
            fix = f"raise {key}: {release.helm_upgrade(f'{key}=CORES')}"
            yield Finding(f"{component} CPU", "warn", f"{text} {share:.0%} of the time slices", fix)


def _network_tells(
    release: Release, objects: Objects, before: Pages, after: Pages
) -> Iterator[Finding]:
    """Yield what keeps the two ends of one robot from hearing each other."""
    grown = {place: _growth(before.get(place, {}), page) for place, page in after.items()}
    if deaf := [
        place[0]
        for place, counts in grown.items()
        # Forged datagrams do not pass, either, but do not silence the other end.
        if total(counts, DATAGRAMS, outcome="tag") and not total(after[place], READY)
    ]:
        text = f"the {' and the '.join(deaf)} pod rejects what arrives: the other end has"
        yield Finding("key", "missing", f"{text} another key", _same_key(release, objects))
        return
    for direction in (UPLINK, DOWNLINK):
        yield from _blocked(release, grown, *direction)


def _same_key(release: Release, objects: Objects) -> str:
    """Return how both ends get the same key again."""
    ends = {each: objects.workloads[each] for each in COMPONENTS if each in objects.workloads}
    mounted = {
        component: volume.secret.secret_name
        for component, workload in ends.items()
        for volume in workload.spec.template.spec.volumes
        if volume.name == KEY
    }
    if len({*mounted.values()}) > 1:
        told = ", ".join(f"{component} '{name}'" for component, name in mounted.items())
        change = release.helm_upgrade("secret.existingSecret=NAME")
        return f"they mount two Secrets ({told}); give both the same: {change}"
    names = " ".join(f"{_kind(each)}/{each.metadata.name}" for each in ends.values())
    restart = f"{release.kubectl} rollout restart {names}"
    return f"pods read a changed Secret within 2 minutes; at once with a restart of both: {restart}"


def _kind(workload: Any) -> str:
    return "statefulset" if hasattr(workload.spec, "service_name") else "deployment"


def _blocked(
    release: Release, grown: Pages, sender: str, receiver: str, direction: str
) -> Iterator[Finding]:
    """Yield that the network drops what one end sends: nothing at all arrives at the other end."""
    if not {(sender, sender), (receiver, receiver)} <= grown.keys():
        return
    link = grown.get((sender, "link"), {})
    relayed = [count for series, count in link.items() if ("outcome", "forwarded") in series.labels]
    # Without a relay, of netem or in a fleet, the end itself has sent it.
    sent = sum(relayed) if relayed else total(grown[sender, sender], DATAGRAMS, outcome="sent")
    heard = total(grown[receiver, receiver], DATAGRAMS, direction=direction)
    if sent and not heard:
        text = f"UDP from the {sender} pod does not arrive at the {receiver} pod, port 7400"
        fix = f"allow it: {release.kubectl} get networkpolicies; is the other pod's node reached?"
        yield Finding("network", "missing", f"{text} ({direction})", fix)


def _growth(before: Metrics, after: Metrics) -> Metrics:
    """Return by how much each counter has grown; that of a container that began anew began at 0."""
    old = {key: before.get(key, 0.0) for key in after}
    return {key: value - old[key] * (value >= old[key]) for key, value in after.items()}


def _throttled(before: Metrics, after: Metrics) -> float:
    """Return the share of the scheduler's periods that the CPU limit has cut short [1]."""
    grown = _growth(before, after)
    periods = total(grown, "cloudrc_cpu_periods_total")
    return total(grown, "cloudrc_cpu_throttled_periods_total") / max(periods, PERIODS_MIN)
