# SPDX-License-Identifier: Apache-2.0

"""Survey a cluster before an install: permissions, values, admission, quota, nodes, images, DNS.

The pods of the chart are sent to the API server as a dry run, so that Pod Security, LimitRanges and
quotas judge them themselves. A small pod on each node, which is deleted again, shows whether the
images are there and whether names are resolved.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import yaml

from cloudrc.base.errors import CloudrcError, to_one_line
from cloudrc.cluster.client import (
    ClusterError,
    NotFoundError,
    Release,
    chart_folder,
    run,
)
from cloudrc.cluster.diagnosis import DNS_REMEDY, LOOK_UP, remedy
from cloudrc.cluster.pods import Finding, container_statuses, pod_failure
from cloudrc.cluster.releases import COMPONENT

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
CONFIGURED = "experiment.yaml", "profile.yaml"
"""Keys of the chart's ConfigMaps: the experiment, and the profile of the link."""
NAMED = {
    "configMap": ("ConfigMap", "name", "configmaps", "robot.configMap, scene.configMap"),
    "secret": (
        *("Secret", "secretName", "secrets"),
        "secret.existingSecret, teleop.tokens.existingSecret",
    ),
    "persistentVolumeClaim": (
        *("PersistentVolumeClaim", "claimName", "persistentvolumeclaims"),
        "recordings.existingClaim, teleop.journal.existingClaim",
    ),
}
"""Kind of a pod's volume -> kind of the object that it names, key of the name, kind of objects in
requests, and the values that name one of the user."""
DEFAULT_CLASS = "storageclass.kubernetes.io/is-default-class"
"""Annotation of the StorageClass of claims that name none."""
IN_CLUSTER = "kubernetes.default.svc"
"""A name that each cluster resolves."""
DRAWS = "python -c 'from cloudrc.doors.cli.doctor import draw; draw()' > /dev/termination-log"
"""Shell command of a container that tells how long it takes to draw a picture."""
LOOKS_UP = ["python", "-I", "-S", "-c", LOOK_UP, IN_CLUSTER]
"""Command of a container that fails if it cannot resolve this name."""
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
    yield from experiments(rendered)
    yield from named_objects(release, rendered, pods)
    yield from storage_classes(release, rendered)
    for component, spec in pods.items():
        yield admission(release, component, spec)
    yield from quotas(release, pods, counts_of_chart(rendered))
    yield from nodes(release, pods, draws=_has_camera(rendered))


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


def _configured(rendered: list[Any]) -> dict[str, str]:
    """Return the files of the experiment and of the link profile that the pods get."""
    files = dict[str, str]()
    for thing in rendered:
        if thing["kind"] == "ConfigMap":
            files |= {key: thing["data"][key] for key in CONFIGURED if key in thing["data"]}
    return files


def _has_camera(rendered: list[Any]) -> bool:
    """Return whether the robot's camera works in the experiment of the chart."""
    experiment = yaml.safe_load(_configured(rendered).get(CONFIGURED[0], "")) or {}
    return experiment.get("camera") is not None


def experiments(rendered: list[Any]) -> Iterator[Finding]:
    """Load the experiment and the link of the chart, as the pods will."""
    from cloudrc.config.load import load_experiment, load_link
    from cloudrc.config.resolved import absolute_paths

    files = _configured(rendered)
    if len(files) < len(CONFIGURED):
        return
    experiment, profile = CONFIGURED
    if paths := absolute_paths(yaml.safe_load(files[experiment])):
        yield Finding("experiment", "ok", f"{', '.join(paths)}: files of the pods, not looked at")
        return
    with TemporaryDirectory(prefix="cloudrc-") as name:
        folder = Path(name)
        for key, text in files.items():
            (folder / key).write_text(text, encoding="utf-8")
        try:
            load_experiment(folder / experiment)
            load_link(folder / profile, folder / experiment)
        except CloudrcError as error:
            text = to_one_line(str(error).replace(f"{folder}/", ""))
            fix = "correct it in the values, below experiment or link"
            yield Finding("experiment", "missing", text, fix)
            return
    yield Finding("experiment", "ok", "can be flown")


def named_objects(
    release: Release, rendered: list[Any], pods: dict[str, dict[str, Any]]
) -> Iterator[Finding]:
    """Look for the objects that the pods mount and that the chart does not make."""
    made = {(thing["kind"], thing["metadata"]["name"]) for thing in rendered}
    volumes = [volume for spec in pods.values() for volume in spec.get("volumes", [])]
    for source, (kind, key, plural, values) in NAMED.items():
        given = [volume[source] for volume in volumes if source in volume]
        names = {each[key] for each in given if not each.get("optional")}
        for name in sorted(name for name in names if (kind, name) not in made):
            try:
                release.request("get", plural, name=name)
                yield Finding(f"{kind} {name}", "ok", "exists")
            except NotFoundError:
                text = f"there is none {release.where}"
                fix = f"make it, or correct the value that names it: {values}"
                yield Finding(f"{kind} {name}", "missing", text, fix)
            except ClusterError as error:
                yield Finding(f"{kind} {name}", "warn", f"not looked at: {error}")


def storage_classes(release: Release, rendered: list[Any]) -> Iterator[Finding]:
    """Look for the StorageClasses of the claims that the chart makes."""
    claims = [thing for thing in rendered if thing["kind"] == "PersistentVolumeClaim"]
    for spec in _specs(rendered).values():
        claims += spec.get("volumeClaimTemplates", [])
    if not claims:
        return
    try:
        found = release.request("list", "storageclasses")
    except ClusterError:
        yield Finding("StorageClass", "warn", "you may not list StorageClasses: not looked at")
        return
    there = {each.metadata.name for each in found}
    if any((each.metadata.annotations or {}).get(DEFAULT_CLASS) == "true" for each in found):
        there.add(None)
    names = {claim["spec"].get("storageClassName") for claim in claims} - {""}  # "": none is asked
    for name in names - there:
        of = f"StorageClass '{name}'" if name else "default StorageClass"
        known = ", ".join(sorted(filter(None, there))) or "none"
        fix = (
            "name one of the cluster: recordings.storageClassName, teleop.journal.storageClassName"
        )
        yield Finding("StorageClass", "missing", f"no {of}; there are: {known}", fix)
    if names <= there:
        yield Finding("StorageClass", "ok", "that of each claim exists")


def admission(release: Release, component: str, spec: dict[str, Any]) -> Finding:
    """Send a pod of the chart as a dry run: nothing is created."""
    name = f"{component} pod"
    try:
        create_pod(release, component, spec, dry_run="All")
    except NotFoundError as error:
        fix = f"make the namespace: kubectl create namespace {release.namespace}"
        return Finding(name, "missing", to_one_line(str(error)), fix)
    except ClusterError as error:
        text = to_one_line(str(error))
        fix = remedy(text, "set other values, such as smaller resources of the containers")
        return Finding(name, "missing", text, fix)
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


def nodes(
    release: Release, pods: dict[str, dict[str, Any]], *, draws: bool = False
) -> Iterator[Finding]:
    """Start a probe on each node that takes pods; say what it found, and delete it.

    With `draws` it also tells how fast world's pod draws there.
    """
    names = schedulable_nodes(release)
    if names is None:
        yield Finding("nodes", "warn", "you may not list nodes: one probe on any node", "")
    probes = dict[str, str]()
    try:
        for node in names if names is not None else [""]:
            probes[node] = start_probe(release, node, pods, draws=draws)
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


def start_probe(
    release: Release, node: str, pods: dict[str, dict[str, Any]], *, draws: bool
) -> str:
    """Create a probe with the images of `pods`: component -> spec; return its name."""
    containers: dict[str, dict[str, Any]] = {
        component: {
            "name": component,
            "image": pod["containers"][0]["image"],
            "imagePullPolicy": "IfNotPresent",
            "command": LOOKS_UP if component == "cloud" else ["true"],
            "terminationMessagePolicy": "FallbackToLogsOnError",
            "resources": RESOURCES,
            "securityContext": RESTRICTED,
        }
        for component, pod in pods.items()
    }
    if draws:  # with the limits that world will have
        resources = pods["world"]["containers"][0]["resources"]
        containers["world"] |= {"command": ["sh", "-c", DRAWS], "resources": resources}
    spec = {
        "restartPolicy": "Never",
        "automountServiceAccountToken": False,
        "containers": [*containers.values()],
        "imagePullSecrets": pods["cloud"].get("imagePullSecrets", []),
        **({"nodeName": node} if node else {}),
    }
    return create_pod(release, "node", spec)


def _finding(release: Release, node: str, pod: str, until: float) -> Finding:
    """Wait for a probe until the time `until` [s, monotonic]; say what it shows about its node."""
    name = f"node {node}"
    while time.monotonic() < until:
        found = release.request("get", "pods", name=pod)
        if found.status.phase == "Succeeded":
            ends = [each.state.terminated for each in container_statuses(found)]
            said = [to_one_line(end.message) for end in ends if end and end.message]
            return Finding(name, "ok", "; ".join(["has the images", *said]))
        if found.status.phase == "Failed":
            return _failed_probe(release, name, found)
        if why := pod_failure(found):
            return Finding(name, "missing", str(why), "make kind-load, or --set image.registry=...")
        time.sleep(LOOK_PERIOD)
    return Finding(name, "warn", "its probe has not ended", "kubectl get events")


def _failed_probe(release: Release, node: str, pod: Any) -> Finding:
    """Say why the probe of a node has failed."""
    ends = [each.state.terminated for each in container_statuses(pod)]
    words = [to_one_line(end.message) for end in ends if end and end.exit_code]
    if not any(text.startswith(IN_CLUSTER) for text in words):
        return Finding(node, "missing", f"its probe failed: {'; '.join(words)}")
    # A policy of the namespace may forbid the probe what the chart's policies allow to its pods.
    state: Literal["warn", "missing"]
    state = "warn" if release.request("list", "networkpolicies") else "missing"
    return Finding(node, state, f"a pod there cannot resolve a name: {words[0]}", DNS_REMEDY)
