"""Faults in a Kubernetes cluster: a partition, a loaded cloud, a lost world, a rotated Secret.

They need a release that flies nothing; the command line says where it is.

Cloud dies or is evicted in a Kubernetes cluster: its container alone, and its whole pod.
"""

from __future__ import annotations

import base64
import json
import os
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress

from cloudrc.cluster.client import Release
from cloudrc.cluster.jobs import read_job
from cloudrc.cluster.pods import find_pod, list_pods
from cloudrc.cluster.release import wait_ready
from cloudrc.cluster.tools import ClusterError, program
from cloudrc.faults.cluster.release import (
    ENDS,
    LIMIT,
    delete,
    finish,
    flying,
    guard,
    kubectl,
    link_as_it_is,
    reading,
    recording,
    release_there,
    set_link,
    until,
)
from cloudrc.faults.held import holds, words
from cloudrc.faults.scenario import Mode, Outcome, Scenario
from cloudrc.messages import GuardState
from cloudrc.tunnel.keys import KEY_SIZE, Key, KeySet, parse, write

CLUSTER: Mode = "cluster"
KEY_FOLDER = "/etc/cloudrc-secret"
PARTITION = 5.0
"""How long nothing gets through [s]."""
BURN = """
import os, time
child, end = os.fork(), time.monotonic() + 10  # one alone might stay below the limit of a whole CPU
while time.monotonic() < end: pass
child and os.waitpid(child, 0)
"""
THROTTLED = "cpu_throttled_periods_total"
LAST_WORD = "INTERRUPTED"


def _world_deleted(seed: int) -> Outcome:
    outcome, release = Outcome(), release_there()
    name = flying(release, 1)
    delete(release, "world")
    until("the mission's Job has ended", lambda: read_job(release, name).state in ENDS)
    status = read_job(release, name)
    outcome.same("exit code of the Job", -1 if status.exit_code is None else status.exit_code, 1)
    outcome.true("with the code world_restarted", "world_restarted" in status.message)
    wait_ready(release, timeout=LIMIT)
    time.sleep(3.0)
    outcome.true("the new world is on the ground", guard(release) is GuardState.GROUND)
    return outcome


def _partition(seed: int) -> Outcome:
    """The link loses everything both ways for a while, and is then as it was.

    A NetworkPolicy would be no partition: most networks let the flows that are there go on.
    """
    outcome, release = Outcome(), release_there()
    before, name = holds(recording(release, "world")), flying(release, 2)
    with link_as_it_is(release) as profile:
        try:
            set_link(release, "uplink.loss=1", "downlink.loss=1")
            time.sleep(PARTITION)
        finally:
            set_link(release, "--profile", str(profile))
    flown = finish(outcome, release, name)
    outcome.least("HOLDs for want of commands", holds(flown) - before, 1)
    return outcome


def _loaded(seed: int) -> Outcome:
    """Something burns the CPU of cloud's own container for 10 s."""
    outcome, release = Outcome(), release_there()
    name = flying(release, 2)
    pod, before = find_pod(release, "cloud").metadata.name, reading(release, "cloud", THROTTLED)
    kubectl(release, "exec", pod, "--container=cloud", "--", "python", "-c", BURN)
    stopped = reading(release, "cloud", THROTTLED) - before
    outcome.least("periods of 100 ms in which the kernel throttled cloud", stopped, 50)
    finish(outcome, release, name)
    return outcome


def _rotated(seed: int) -> Outcome:
    """The key in the Secret is rotated; both pods read it when their kubelet does.

    The new key stays: nobody can guess it, not from the seed either, as none may who does not have
    the Secret.
    """
    outcome, release = Outcome(), release_there()
    secret = _key_secret(release)
    found = json.loads(kubectl(release, "get", "secret", secret, "--output=json"))
    old = parse(base64.b64decode(found["data"]["key"]))
    new = KeySet(Key(os.urandom(KEY_SIZE)), old.current)
    encoded = base64.b64encode(write(new).encode()).decode()
    kubectl(release, "patch", "secret", secret, f"--patch={json.dumps({'data': {'key': encoded}})}")
    before = holds(recording(release, "world"))
    for _ in range(4):  # a Secret reaches a pod within two minutes
        flown = finish(outcome, release, flying(release, 1))
    outcome.most("HOLDs while the pods read it", holds(flown) - before, 1)
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
    """The Job's pod is deleted in flight: with its last word it cancels the mission."""
    outcome, release = Outcome(), release_there()
    name = flying(release, 2)
    command = [program("kubectl"), *release.flags, "logs", "--follow", f"job/{name}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as reader:
        assert reader.stdout is not None
        reader.stdout.readline()  # from here on it is read: once the pod is gone, so is its log
        kubectl(release, "delete", "pod", f"--selector=batch.kubernetes.io/job-name={name}")
        last = reader.stdout.read().splitlines()[-1:]
    outcome.true(f"the Job ends with {LAST_WORD}", bool(last) and last[0].startswith(LAST_WORD))
    until("the mission is cancelled", lambda: _events(release)[-1:] == ["cancelled"], 60.0)
    outcome.true("the robot holds", guard(release) is GuardState.HOLD)
    finish(outcome, release, flying(release, 1))
    outcome.same("pods of world", len(list_pods(release, "world")), 1)
    return outcome


def _events(release: Release) -> list[str]:
    """What has happened to the mission ordered last, as cloud has recorded it."""
    events: list[str] = recording(release, "cloud")["/mission"]["event"].tolist()
    starts = [n for n, event in enumerate(events) if event == "started"]
    return events[starts[-1] :] if starts else []


PODS = (
    Scenario(
        2,
        "partition",
        "the link loses everything both ways for 5 s",
        "HOLD by 252 ms, the mission goes on",
        "samples",
        "guard HOLD",
        _partition,
        CLUSTER,
    ),
    Scenario(
        16,
        "cloud-throttled",
        "something burns the CPU of cloud's container for 10 s, so that the kernel throttles it",
        "stalls ride inside the age limit, else HOLD",
        "none",
        "cloudrc_cpu_throttled_periods_total",
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
        "the mission is cancelled, the robot holds, the next mission is flown to its end",
        "the rest of that mission",
        "INTERRUPTED: the Job was stopped",
        _operator_lost,
        CLUSTER,
    ),
    Scenario(
        38,
        "secret-rotated",
        "a new key is put into the Secret beside the old one",
        "one short HOLD while the pods read it one after the other",
        "none",
        "fault 'key': new key",
        _rotated,
        CLUSTER,
    ),
)


KILL = "import resource; resource.prlimit(1, resource.RLIMIT_CPU, (1, 1))"
"""SIGKILL of a container's first process from within, which no other process in it may send: the
kernel does once the CPU time of a process [s] is over its limit, and cloud's has long been."""
ENDS_IN = 2.0
"""Time for a pod that is asked to end, and for its robot to hold [s].
Source: docs/reference/faults.md, "F33"."""
COMMANDS_IN = 2.0
"""Time for a new cloud to command [s]. Source: docs/reference/faults.md, "F13"."""
POD_START = 10.0
"""Kubernetes' own part of it where the image is on the node [s], for a pod that ends at the end of
its grace, too: from the pod's deletion to the flight 6.3 to 9.5 s were measured on kind with 2 busy
CPUs."""
CONTAINER_START = 5.0
"""Likewise in a pod that stays [s]: the kubelet looks for what has ended once a second. Killed a
second time within 10 minutes a container has to wait for 10 s, but here its pod goes next."""


def _cloud_killed(seed: int) -> Outcome:
    outcome = Outcome()
    wants, _ = _killed(outcome, "container", _kill_container, CONTAINER_START)
    outcome.least("container: HOLDs for want of commands", wants, 1)
    wants, said = _killed(outcome, "pod", _kill_pod, POD_START)
    text = "pod: HOLDs for want of commands or by teleop's word, that at the mission's end included"
    outcome.least(text, wants + said, 2)
    return outcome


def _killed(
    outcome: Outcome, what: str, kill: Callable[[Release], None], start: float
) -> tuple[int, int]:
    """Fly a mission in which cloud is killed; `start` is Kubernetes' time for a new one [s].

    Returns:
        How often the robot has held for want of commands, and how often by teleop's word.
    """
    release = release_there()
    before = recording(release, "world")
    name, sessions = flying(release, 2), _sessions(release)
    kill(release)
    back = until("a new cloud has a session", lambda: _sessions(release) > sessions)
    back += until("it flies the robot", lambda: guard(release) is GuardState.TRACK)
    outcome.most(f"{what}: flown again after", back, COMMANDS_IN + start, "s")
    flown = finish(outcome, release, name)
    return holds(flown) - holds(before), words(flown) - words(before)


def _kill_container(release: Release) -> None:
    """SIGKILL of cloud's own process: its pod, teleop and the link stay."""
    pod = find_pod(release, "cloud").metadata.name
    with suppress(ClusterError):  # what says it is killed, too
        kubectl(release, "exec", pod, "--container=cloud", "--", "python", "-c", KILL)


def _kill_pod(release: Release) -> None:
    """Deleted by force: the kubelet still has its processes asked to end, 2 s before SIGKILL.

    Source: Kubernetes, `minimumGracePeriodInSeconds` of the kubelet's runtime manager.
    """
    delete(release, "cloud", "--force", "--grace-period=0")


def _sessions(release: Release) -> float:
    return reading(release, "world", "session_epoch")


def _pod_deleted(seed: int) -> Outcome:
    """Deleted with its grace: its processes get SIGTERM at once, and hold the robot."""
    outcome, release = Outcome(), release_there()
    before, name = words(recording(release, "world")), flying(release, 2)
    delete(release, "cloud")
    held = until("the robot holds", lambda: guard(release) is GuardState.HOLD)
    outcome.most("HOLD after", held, ENDS_IN, "s")
    back = until("the new cloud flies it", lambda: guard(release) is GuardState.TRACK)
    outcome.most("flown again after", held + back, ENDS_IN + COMMANDS_IN + POD_START, "s")
    said = words(finish(outcome, release, name)) - before
    outcome.least("HOLDs by teleop's word, that at the mission's end included", said, 2)
    return outcome


KILLS = (
    Scenario(
        13,
        "cloud-killed",
        "SIGKILL of cloud's container alone; in another mission the cloud pod is deleted by force",
        "HOLD by 252 ms, of a pod by teleop's last word if it comes before; the new one commands "
        "in 2 s and what Kubernetes needs to start it; the mission goes on where it was",
        "cloud's memory",
        "mission resumed",
        _cloud_killed,
        CLUSTER,
    ),
    Scenario(
        14,
        "cloud-evicted",
        "the cloud pod is deleted with its grace",
        "HOLD in 2 s by teleop's last word, the new pod commands in 2 s and what Kubernetes needs "
        "to start it; the mission goes on where it was",
        "none",
        "mission resumed",
        _pod_deleted,
        CLUSTER,
    ),
)


SCENARIOS = (
    *PODS,
    *KILLS,
)
