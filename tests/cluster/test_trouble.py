"""Failures of pods are explained in one sentence with a remedy; others are waited for."""

from __future__ import annotations

import re
from typing import Any

import pytest

from cloudrc.cluster.client import Release
from cloudrc.cluster.pods import list_pods, pod_failure
from cloudrc.cluster.release import wait_ready
from cloudrc.cluster.tools import ClusterError, ExpiredError
from tests.cluster.conftest import FakeApi, deployment, pod


def waiting(reason: str, message: str = "") -> dict[str, Any]:
    return {"waiting": {"reason": reason, "message": message}}


def unscheduled(message: str) -> list[dict[str, str]]:
    return [{"type": "PodScheduled", "status": "False", "message": message}]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"state": waiting("ImagePullBackOff")}, "cloudrc/cloud:0.1.0.*make kind-load"),
        ({"state": waiting("ErrImageNeverPull")}, "make kind-load"),
        (
            {"state": waiting("CreateContainerConfigError", 'secret "mine" not found')},
            'cannot be created: secret "mine" not found',
        ),
        (
            {
                "state": waiting("CrashLoopBackOff"),
                "last": {"terminated": {"exitCode": 3, "message": "port 9100 is\ntaken"}},
            },
            r"ends repeatedly \(exit code 3\): port 9100 is taken",
        ),
        ({"restarts": 5}, "ends repeatedly"),
        ({"conditions": unscheduled("0/1 nodes: Insufficient cpu")}, "no node takes it.*cpu"),
    ],
)
def test_a_failure_of_a_pod_is_explained(
    api: FakeApi, release: Release, given: dict[str, Any], expected: str
) -> None:
    api.put("pods", "demo", pod("cloud-1", "cloud", ready=False, phase="Pending", **given))
    said = pod_failure(list_pods(release, "cloud")[0])
    assert said is not None
    assert re.search(expected, said)
    assert "\n" not in said


@pytest.mark.parametrize(
    "given",
    [
        {},
        {"state": waiting("ContainerCreating")},
        {"state": waiting("PodInitializing")},
        {"conditions": unscheduled("pod has unbound immediate PersistentVolumeClaims: volume")},
        {"restarts": 1},
    ],
)
def test_a_pod_that_may_still_start_has_no_failure(
    api: FakeApi, release: Release, given: dict[str, Any]
) -> None:
    api.put("pods", "demo", pod("cloud-1", "cloud", ready=False, **given))
    assert pod_failure(list_pods(release, "cloud")[0]) is None


def test_a_ready_release_needs_no_wait(running: FakeApi, release: Release) -> None:
    wait_ready(release, timeout=0.0)


@pytest.mark.parametrize(
    "status",
    [{"updatedReplicas": 0}, {"replicas": 2}, {"observedGeneration": 0}],
    ids=["not updated", "old pod beside it", "not seen yet"],
)
def test_a_ready_old_pod_does_not_count(
    running: FakeApi, release: Release, status: dict[str, int]
) -> None:
    running.put("deployments", "demo", deployment("cloud", **status))
    with pytest.raises(ExpiredError, match="its pod is being created"):
        wait_ready(release, timeout=0.03)


def test_a_timeout_names_what_is_not_ready(running: FakeApi, release: Release) -> None:
    running.put("pods", "demo", pod("world-1", "world", ready=False))
    with pytest.raises(ExpiredError, match="container world is not ready") as caught:
        wait_ready(release, timeout=0.03)
    assert caught.value.exit_code == 4


def test_a_pod_that_will_never_run_ends_the_wait(running: FakeApi, release: Release) -> None:
    state = waiting("ImagePullBackOff")
    running.put("pods", "demo", pod("world-1", "world", ready=False, state=state))
    with pytest.raises(ClusterError, match="the world pod cannot run: the image"):
        wait_ready(release, timeout=60.0)


def test_a_refused_pod_ends_the_wait_with_the_reason(running: FakeApi, release: Release) -> None:
    refused = {"type": "ReplicaFailure", "status": "True", "message": "violates PodSecurity"}
    running.put("deployments", "demo", deployment("cloud", conditions=[refused]))
    with pytest.raises(ClusterError, match="violates PodSecurity"):
        wait_ready(release, timeout=60.0)


def wait_for_secret(running: FakeApi, name: str) -> None:
    """Make world's pod wait for a Secret, with the kubelet's event."""
    state = waiting("ContainerCreating")
    running.put("pods", "demo", pod("world-1", "world", ready=False, state=state))
    said = f'MountVolume.SetUp failed for volume "secret" : secret "{name}" not found'
    event = {"metadata": {"name": "world-1.1"}, "involvedObject": {}, "message": said}
    running.put("events", "demo", {**event, "type": "Warning", "reason": "FailedMount"})


def test_a_missing_secret_ends_the_wait_with_a_command(running: FakeApi, release: Release) -> None:
    wait_for_secret(running, "mine")
    with pytest.raises(
        ClusterError, match="the world pod cannot run: there is no Secret"
    ) as caught:
        wait_ready(release, timeout=5.0)
    assert "kubectl --namespace=demo create secret generic mine --from-file=key" in str(
        caught.value
    )
    assert caught.value.exit_code == 5


def test_a_secret_that_exists_by_now_is_not_missing(running: FakeApi, release: Release) -> None:
    wait_for_secret(running, "cloudrc-tokens")
    with pytest.raises(ExpiredError, match="container world is not ready"):
        wait_ready(release, timeout=0.03)


def test_without_the_right_to_read_events_the_wait_continues(
    running: FakeApi, release: Release
) -> None:
    wait_for_secret(running, "mine")
    running.refuse["GET", "events"] = 403, "events is forbidden"
    with pytest.raises(ExpiredError, match="container world is not ready"):
        wait_ready(release, timeout=0.03)


def test_a_release_of_another_chart_is_reported(api: FakeApi, release: Release) -> None:
    with pytest.raises(ClusterError, match="no Deployment 'world'"):
        wait_ready(release, timeout=1.0)
