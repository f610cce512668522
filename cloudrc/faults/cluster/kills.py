"""Cloud dies or is evicted in a Kubernetes cluster: its container alone, and its whole pod."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from cloudrc.cluster.client import Release
from cloudrc.cluster.pods import find_pod
from cloudrc.cluster.tools import ClusterError
from cloudrc.faults.cluster.pods import CLUSTER
from cloudrc.faults.cluster.release import (
    delete,
    finish,
    flying,
    guard,
    kubectl,
    reading,
    recording,
    release_there,
    until,
)
from cloudrc.faults.held import holds, words
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.messages import GuardState

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


SCENARIOS = (
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
