"""Survey a cluster before an install: permissions, admission, quota, nodes, images.

The pods of the chart are sent to the API server as a dry run, so that Pod Security, LimitRanges and
quotas judge them themselves. A small pod on each node, which is deleted again, shows whether the
images are there.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from math import ceil
from typing import Any, Literal, NamedTuple

import yaml

from cloudrc.cluster.client import (
    ClusterError,
    NotFoundError,
    Release,
    chart_folder,
    run,
)
from cloudrc.cluster.pods import pod_failure
from cloudrc.cluster.releases import COMPONENT
from cloudrc.errors import to_one_line

NEEDED = {
    "": "pods services configmaps secrets serviceaccounts persistentvolumeclaims",
    "apps": "deployments statefulsets",
    "batch": "jobs",
    "networking.k8s.io": "networkpolicies",
}
"""API group -> the objects that an install, an upgrade and a mission create, change and delete."""
VERBS = ("create", "patch", "delete")
ALSO = (
    ("", "watch", "pods"),
    ("", "get", "pods/log"),
    ("", "create", "pods/portforward"),
    ("", "create", "pods/exec"),
    ("", "list", "events"),
)
"""Further permissions, of the commands that fly and look: API group, verb, object."""
PROBE_LIMIT = 60.0
"""Time limit for the probe of all nodes [s], in which a node may pull both images."""
LOOK_PERIOD = 0.5
"""Time between two looks at the probes [s]."""
RESOURCES = {
    "requests": {"cpu": "30m", "memory": "40Mi"},
    "limits": {"cpu": "500m", "memory": "96Mi"},
}
"""Resources of each container of a probe."""
RESTRICTED = {
    "allowPrivilegeEscalation": False,
    "capabilities": {"drop": ["ALL"]},
    "runAsNonRoot": True,
    "seccompProfile": {"type": "RuntimeDefault"},
}
"""Rights of each container of a probe: every level of Pod Security admits them."""


class Finding(NamedTuple):
    """What the survey found about one thing, and how to solve a problem.

    "missing" stops an install, "warn" does not.
    """

    name: str
    state: Literal["ok", "warn", "missing"]
    found: str
    fix: str = ""


def survey(release: Release, values: Sequence[str] = ()) -> Iterator[Finding]:
    """Check whether the chart can be installed as this release; yield one finding after another.

    `values` are options of helm that set the chart's values, such as "--set=link.mode=relay". Raise
    a ClusterError if the server does not answer.
    """
    yield (allowed := permissions(release))
    if allowed.state != "ok":
        return
    rendered = render_chart(release, values)
    pods = pods_of_chart(rendered)
    for component, spec in pods.items():
        yield admission(release, component, spec)
    yield from quotas(release, pods, counts_of_chart(rendered))
    yield from nodes(release, pods)


def permissions(release: Release) -> Finding:
    """Ask the API server what the user may do in the namespace."""
    needed = [
        (group, verb, kind)
        for group, kinds in NEEDED.items()
        for kind, verb in product(kinds.split(), VERBS)
    ]
    denied = []
    for group, verb, kind in (*ALSO, *needed):
        resource, _, subresource = kind.partition("/")
        asked = {"namespace": release.namespace, "group": group, "verb": verb}
        asked |= {"resource": resource, "subresource": subresource}
        body = {"spec": {"resourceAttributes": asked}}
        if not release.request("create", "selfsubjectaccessreviews", body=body).status.allowed:
            denied.append(f"{verb} {kind}")
    if denied:
        fix = "ask the administrator for the ClusterRole 'edit' in this namespace"
        return Finding("permissions", "missing", f"you may not {', '.join(denied)}", fix)
    return Finding("permissions", "ok", f"enough {release.where}")


def render_chart(release: Release, values: Sequence[str]) -> list[Any]:
    """Render the objects of the chart as `helm install` would."""
    arguments = ["template", release.name, str(chart_folder()), *release.helm_flags]
    arguments += ["--dry-run=server", "--validate", *values]  # of the server's version
    return [thing for thing in yaml.safe_load_all(run("helm", arguments)) if thing]


def _specs(rendered: list[Any]) -> dict[str, Any]:
    """Return component -> spec of its Deployment or StatefulSet, of the chart's objects."""
    return {
        thing["metadata"]["labels"][COMPONENT]: thing["spec"]
        for thing in rendered
        if thing["kind"] in ("Deployment", "StatefulSet")
    }


def pods_of_chart(rendered: list[Any]) -> dict[str, dict[str, Any]]:
    """Return component -> spec of its pod."""
    account = {"serviceAccountName": "default"}  # the chart's own accounts do not exist yet
    return {name: spec["template"]["spec"] | account for name, spec in _specs(rendered).items()}


def counts_of_chart(rendered: list[Any]) -> Counter[str]:
    """Return component -> number of its pods: a fleet has one for each robot."""
    return Counter({name: spec["replicas"] for name, spec in _specs(rendered).items()})


def admission(release: Release, component: str, spec: dict[str, Any]) -> Finding:
    """Send a pod of the chart as a dry run: nothing is created."""
    name = f"{component} pod"
    try:
        create_pod(release, component, spec, dry_run="All")
    except NotFoundError as error:
        fix = f"make the namespace: kubectl create namespace {release.namespace}"
        return Finding(name, "missing", to_one_line(str(error)), fix)
    except ClusterError as error:
        fix = "set other values: link.mode=relay for Pod Security, smaller resources for a quota"
        return Finding(name, "missing", to_one_line(str(error)), fix)
    return Finding(name, "ok", "is admitted: Pod Security, LimitRanges and quota agree")


def create_pod(release: Release, name: str, spec: dict[str, Any], **how: Any) -> str:
    """Create a pod with a new name, and return the name."""
    name = f"cloudrc-doctor-{name}-{secrets.token_hex(3)}"
    metadata = {"name": name, "labels": {"app.kubernetes.io/name": "cloudrc-doctor"}}
    release.request("create", "pods", body={"metadata": metadata, "spec": spec}, **how)
    return name


def quotas(
    release: Release, pods: dict[str, dict[str, Any]], counts: Counter[str]
) -> Iterator[Finding]:
    """Compare the requests and limits of all pods together with what each quota has left.

    `counts` are component -> number of its pods.
    """
    from kubernetes import utils

    amount: Any = utils.parse_quantity  # not annotated
    needed = _needed(pods, counts, amount)
    for quota in release.request("list", "resourcequotas"):
        name, hard = f"quota {quota.metadata.name}", quota.status.hard or {}
        used = Counter(quota.status.used or {})
        lacks = [
            f"{_shown(key, needed[key])} {key}: {used[key]} of {hard[key]} are used"
            for key in needed.keys() & hard.keys()
            if needed[key] > amount(hard[key]) - amount(used[key])
        ]
        if lacks:
            fix = "ask for a larger quota, or set smaller resources of the containers"
            yield Finding(name, "missing", f"the release needs {'; '.join(sorted(lacks))}", fix)
        else:
            yield Finding(name, "ok", "has enough left for one release")


def _shown(key: str, amount: Any) -> str:
    """Return an amount of a quota's resource as Kubernetes writes it: CPU in m, memory in Mi."""
    if "cpu" in key:
        return f"{ceil(amount * 1000)}m"
    return f"{ceil(amount / 2**20)}Mi" if "memory" in key else f"{amount}"


def _needed(
    pods: dict[str, dict[str, Any]], counts: Counter[str], amount: Callable[[Any], Any]
) -> Counter[str]:
    """Return what all pods together need: name as in a quota, such as requests.cpu -> amount."""
    needed = Counter[str]()
    for component, spec in pods.items():
        for container in [*spec.get("initContainers", []), *spec["containers"]]:
            for kind, amounts in container.get("resources", {}).items():
                for resource, text in amounts.items():
                    needed[f"{kind}.{resource}"] += counts[component] * amount(text)
    needed |= {"cpu": needed["requests.cpu"], "memory": needed["requests.memory"]}
    needed |= {"pods": counts.total(), "count/pods": counts.total()}
    return needed


def nodes(release: Release, pods: dict[str, dict[str, Any]]) -> Iterator[Finding]:
    """Start a probe on each node that takes pods; say what it found, and delete it."""
    names = schedulable_nodes(release)
    if names is None:
        yield Finding("nodes", "warn", "you may not list nodes: one probe on any node", "")
    probes = dict[str, str]()
    try:
        for node in names if names is not None else [""]:
            probes[node] = start_probe(release, node, pods)
        until = time.monotonic() + PROBE_LIMIT
        for node, pod in probes.items():
            yield _finding(release, node or "any", pod, until)
    except ClusterError as error:
        yield Finding("nodes", "warn", f"no probe: {error}", "solve the problems above")
    finally:
        for pod in probes.values():
            try:
                release.request("delete", "pods", name=pod, grace_period_seconds=0)
            except ClusterError:
                pass  # it ends by itself


def schedulable_nodes(release: Release) -> list[str] | None:
    """List the nodes that take pods without a toleration; None if the user may not list nodes."""
    try:
        found = release.request("list", "nodes")
    except ClusterError:
        return None
    return [
        node.metadata.name
        for node in found
        if not node.spec.unschedulable
        and not any(taint.effect in ("NoSchedule", "NoExecute") for taint in node.spec.taints or [])
    ]


def start_probe(release: Release, node: str, pods: dict[str, dict[str, Any]]) -> str:
    """Create a probe with the images of `pods`: component -> spec; return its name."""
    containers = [
        {
            "name": component,
            "image": pod["containers"][0]["image"],
            "imagePullPolicy": "IfNotPresent",
            "command": ["true"],
            "resources": RESOURCES,
            "securityContext": RESTRICTED,
        }
        for component, pod in pods.items()
    ]
    spec = {
        "restartPolicy": "Never",
        "automountServiceAccountToken": False,
        "containers": containers,
        "imagePullSecrets": pods["cloud"].get("imagePullSecrets", []),
        **({"nodeName": node} if node else {}),
    }
    return create_pod(release, "node", spec)


def _finding(release: Release, node: str, pod: str, until: float) -> Finding:
    """Wait for a probe until the time `until` [s, monotonic]; say what it shows about its node."""
    name, why = f"node {node}", ""
    while time.monotonic() < until:
        found = release.request("get", "pods", name=pod)
        if found.status.phase == "Succeeded":
            return Finding(name, "ok", "has the images")
        if found.status.phase == "Failed":
            return Finding(name, "missing", "its probe failed", f"kubectl describe pod {pod}")
        if why := pod_failure(found):
            return Finding(name, "missing", why, "make kind-load, or --set image.registry=...")
        time.sleep(LOOK_PERIOD)
    return Finding(name, "warn", why or "its probe has not ended", "kubectl get events")
