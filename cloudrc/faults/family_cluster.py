"""Faults in a Kubernetes cluster: pods deleted, a partition, a loaded cloud, a rotated Secret.

They need a release that flies nothing; the command line says where it is.
"""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np

from cloudrc.cluster.access import Release
from cloudrc.cluster.deploy import wait_ready
from cloudrc.cluster.jobs import read_job
from cloudrc.cluster.pods import find_pod, list_pods
from cloudrc.faults.family_real import pause
from cloudrc.faults.real_cluster import (
    ENDS,
    LIMIT,
    delete,
    finish,
    flying,
    guard,
    holds,
    kubectl,
    recording,
    release_there,
    until,
)
from cloudrc.faults.scenario import Mode, Outcome, Scenario
from cloudrc.messages import GuardState
from cloudrc.tunnel.keys import Key, KeySet, parse, write

CLUSTER: Mode = "cluster"
KEY_FOLDER = "/etc/cloudrc-secret"
PARTITION = 5.0
"""How long nothing reaches world [s]."""
BURN = "import time\nend = time.monotonic() + 10\nwhile time.monotonic() < end: pass"


def _pod_killed(seed: int) -> Outcome:
    """Deleted by force: its processes get SIGKILL at once."""
    outcome, release = Outcome(), release_there()
    name = flying(release, 2)
    delete(release, "cloud", "--force", "--grace-period=0")
    until("the robot holds", lambda: guard(release) is GuardState.HOLD, 15.0)
    back = until("the new cloud flies it", lambda: guard(release) is GuardState.TRACK)
    outcome.most("flown again after", back, 60.0, "s")
    finish(outcome, release, name)
    return outcome


def _pod_deleted(seed: int) -> Outcome:
    outcome, release = Outcome(), release_there()
    name = flying(release, 2)
    delete(release, "cloud")
    held = until("the robot holds", lambda: guard(release) is GuardState.HOLD, 60.0)
    outcome.most("HOLD after it was deleted, its grace included", held, 60.0, "s")
    finish(outcome, release, name)
    outcome.least("HOLDs for want of commands", holds(recording(release, "world")), 1)
    return outcome


def _world_deleted(seed: int) -> Outcome:
    outcome, release = Outcome(), release_there()
    name = flying(release, 1)
    delete(release, "world")
    until("the mission's Job has ended", lambda: read_job(release, name).state in ENDS)
    status = read_job(release, name)
    outcome.same("exit code of the Job", -1 if status.exit_code is None else status.exit_code, 1)
    outcome.true("with the code world_restarted", "world_restarted" in status.message)
    wait_ready(release, timeout=LIMIT)
    pause(3.0)
    outcome.true("the new world is on the ground", guard(release) is GuardState.GROUND)
    return outcome


def _partition(seed: int) -> Outcome:
    """A NetworkPolicy lets nothing into the world pod for a while."""
    outcome, release = Outcome(), release_there()
    name = flying(release, 2)
    labels = {
        "app.kubernetes.io/instance": release.name,
        "app.kubernetes.io/component": "world",
    }
    own = _network_policies(release)
    policy = {
        "apiVersion": "networking.k8s.io/v1",
        "kind": "NetworkPolicy",
        "metadata": {"name": f"{release.name}-partition"},
        "spec": {"podSelector": {"matchLabels": labels}, "policyTypes": ["Ingress", "Egress"]},
    }
    try:
        if own:
            kubectl(release, "delete", "networkpolicy", *own)
        kubectl(release, "apply", "--filename=-", given=json.dumps(policy))
        pause(PARTITION)
    finally:  # whatever happens, the release is left as it was
        gone = ("--ignore-not-found", f"{release.name}-partition")
        kubectl(release, "delete", "networkpolicy", *gone)
        for document in own.values():
            kubectl(release, "apply", "--filename=-", given=document)
    finish(outcome, release, name)
    return outcome


def _network_policies(release: Release) -> dict[str, str]:
    """The release's own, which would let the tunnel through beside one that lets nothing."""
    selector = f"--selector=app.kubernetes.io/instance={release.name}"
    found = json.loads(kubectl(release, "get", "networkpolicy", selector, "--output=json"))
    return {item["metadata"]["name"]: json.dumps(_bare(item)) for item in found["items"]}


def _bare(item: dict[str, Any]) -> dict[str, Any]:
    """An object as it can be applied again."""
    metadata = {name: item["metadata"].get(name) for name in ("name", "labels", "annotations")}
    metadata = {name: value for name, value in metadata.items() if value}
    kept = {name: item[name] for name in ("apiVersion", "kind", "spec")}
    return kept | {"metadata": metadata}


def _loaded(seed: int) -> Outcome:
    """Something burns the CPU of cloud's own container for 10 s."""
    outcome, release = Outcome(), release_there()
    name = flying(release, 2)
    pod = find_pod(release, "cloud").metadata.name
    kubectl(release, "exec", pod, "--container=cloud", "--", "python", "-c", BURN)
    finish(outcome, release, name)
    return outcome


def _rotated(seed: int) -> Outcome:
    """The Secret gets a new key beside the old one; both pods read it when their kubelet does."""
    outcome, release = Outcome(), release_there()
    secret = _key_secret(release)
    found = json.loads(kubectl(release, "get", "secret", secret, "--output=json"))
    old = parse(base64.b64decode(found["data"]["key"])).current
    new = KeySet(Key(np.random.default_rng(seed).bytes(32)), old)
    encoded = base64.b64encode(write(new).encode()).decode()
    kubectl(release, "patch", "secret", secret, f"--patch={json.dumps({'data': {'key': encoded}})}")
    before = holds(recording(release, "world"))
    for _ in range(4):  # a Secret reaches a pod within two minutes
        finish(outcome, release, flying(release, 1))
    held = holds(recording(release, "world")) - before
    outcome.same("HOLDs while the pods read it", held, 0)
    told = [_told(release, component, new.current.name) for component in ("world", "cloud")]
    outcome.true("both ends have the new key", all(told))
    return outcome


def _key_secret(release: Release) -> str:
    """The Secret that cloud mounts its key from."""
    spec = find_pod(release, "cloud").spec
    cloud = next(each for each in spec.containers if each.name == "cloud")
    mounted = {mount.name for mount in cloud.volume_mounts if mount.mount_path == KEY_FOLDER}
    return next(str(v.secret.secret_name) for v in spec.volumes if v.name in mounted)


def _told(release: Release, component: str, key: str) -> bool:
    texts = recording(release, component)["/fault"]["text"].tolist()
    return any(f"new key {key}" in text for text in texts)


def _operator_lost(seed: int) -> Outcome:
    """The Job's pod goes away in flight: the mission is not its own."""
    outcome, release = Outcome(), release_there()
    name = flying(release, 2)
    kubectl(release, "delete", "pod", f"--selector=batch.kubernetes.io/job-name={name}")
    until("the robot lands or holds at its goal", lambda: guard(release) is GuardState.HOLD)
    bodies = recording(release, "world")["/contact"]["body"].tolist()
    outcome.same("pipe contacts", sum(body.startswith("pipe") for body in bodies), 0)
    events = recording(release, "cloud")["/mission"]["event"].tolist()
    outcome.same("the last event of the mission is its end", events[-1] == "done", True)
    outcome.same("pods of world", len(list_pods(release, "world")), 1)
    return outcome


SCENARIOS = (
    Scenario(
        2,
        "partition",
        "a NetworkPolicy lets nothing into or out of the world pod for 5 s",
        "HOLD by 252 ms, the mission goes on",
        "samples",
        "guard HOLD",
        _partition,
        CLUSTER,
    ),
    Scenario(
        13,
        "cloud-killed",
        "the cloud pod is deleted by force, without grace",
        "HOLD by 252 ms, the new pod takes the mission up where it was",
        "cloud's memory",
        "mission resumed",
        _pod_killed,
        CLUSTER,
    ),
    Scenario(
        14,
        "cloud-evicted",
        "the cloud pod is deleted with its grace",
        "HOLD, the new pod takes the mission up where it was",
        "none",
        "mission resumed",
        _pod_deleted,
        CLUSTER,
    ),
    Scenario(
        16,
        "cloud-throttled",
        "something burns the CPU of cloud's container for 10 s",
        "stalls ride inside the age limit, else HOLD",
        "none",
        "cloudrc_cpu_throttled_seconds_total",
        _loaded,
        CLUSTER,
    ),
    Scenario(
        17,
        "world-restarted",
        "the world pod is deleted",
        "the new world stays on the ground",
        "the flight in progress",
        "mission failed: world_restarted",
        _world_deleted,
        CLUSTER,
    ),
    Scenario(
        33,
        "operator-lost",
        "the pod of the mission's Job is deleted",
        "the mission is flown to its end",
        "none",
        "-",
        _operator_lost,
        CLUSTER,
    ),
    Scenario(
        38,
        "secret-rotated",
        "a new key is put into the Secret beside the old one",
        "no HOLD while the pods read it one after the other",
        "none",
        "fault 'key': new key",
        _rotated,
        CLUSTER,
    ),
)
