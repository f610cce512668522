# SPDX-License-Identifier: Apache-2.0

"""Failures of pods are explained, ports and pages forwarded, tokens read and never printed."""

import os
import re

import pytest

from cloudrc.base.errors import TimedOutError
from cloudrc.cluster import pods
from cloudrc.cluster.client import ClusterError
from cloudrc.cluster.flight import wait_ready
from cloudrc.cluster.pods import list_pods, operator_token, pod_failure
from tests.cluster.conftest import OUT_OF_MEMORY, TOKEN, deployment, pod, waiting


def unscheduled(message):
    return [{"type": "PodScheduled", "status": "False", "message": message}]


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"state": waiting("ImagePullBackOff")}, "cloudrc/cloud:0.1.0.*make kind-load"),
        (
            {"state": waiting("CrashLoopBackOff"), "last": OUT_OF_MEMORY},
            r"'cloud' ends repeatedly: it was killed.*raise cloud\.resources\.limits\.memory",
        ),
        ({"conditions": unscheduled("0/1 nodes: Insufficient cpu")}, "no node takes it.*cpu"),
        ({"conditions": unscheduled("pod has unbound immediate volume claims")}, "^$"),
    ],
)
def test_a_failure_of_a_pod_is_explained(api, release, given, expected):
    api.put("pods", pod("cloud-1", "cloud", ready=False, phase="Pending", **given))
    said = str(pod_failure(list_pods(release, "cloud")[0]) or "")
    assert re.search(expected, said)
    assert "\n" not in said


REFUSED = {"type": "ReplicaFailure", "status": "True", "message": "violates PodSecurity"}


@pytest.mark.parametrize(
    ("body", "error", "words"),
    [
        (deployment("cloud", updatedReplicas=0), TimedOutError, "its pod is being created"),
        (deployment("cloud", conditions=[REFUSED]), ClusterError, "violates PodSecurity"),
        (
            pod("world-1", "world", ready=False, state=waiting("ImagePullBackOff")),
            ClusterError,
            "the world pod cannot run: the image",
        ),
    ],
)
def test_the_wait_for_a_release_ends_with_the_cause(running, release, body, error, words):
    wait_ready(release, timeout=0.0)
    running.put("pods" if "phase" in body["status"] else "deployments", body)
    with pytest.raises(error, match=words):
        wait_ready(release, timeout=0.03)


def test_a_pod_that_loses_its_readiness_with_its_node_names_the_node(running, release):
    lost = pod("world-1", "world")
    lost["spec"] = {**lost["spec"], "nodeName": "worker-2"}
    lost["status"]["conditions"][0]["status"] = "False"
    running.put("pods", lost)
    with pytest.raises(TimedOutError, match="its node 'worker-2' does not answer"):
        wait_ready(release, timeout=0.0)


def test_a_part_before_that_cannot_be_fetched_is_not_taken_for_missing(
    running, release, pretend, tmp_path
):
    pretend("kubectl", 'case "$*" in *before*) echo error: node gone >&2; exit 1 ;; esac')
    with pytest.raises(ClusterError, match="node gone"):
        pods.fetch_recording(release, "world", tmp_path / "world.mcap")


def test_a_secret_that_does_not_exist_is_named(running, release):
    running.put("pods", pod("cloud-1", "cloud", ready=False, phase="Pending"))
    message = 'MountVolume.SetUp failed for volume "secret" : secret "lab-key" not found'
    running.tell_of("pods", "cloud-1", reason="FailedMount", message=message)
    said = r'the cloud pod cannot run: .* "lab-key" not found; see'
    with pytest.raises(ClusterError, match=said):
        wait_ready(release, timeout=1.0)


def test_a_secret_without_a_token_is_named_and_not_shown(running, release):
    assert operator_token(release) == TOKEN
    running.get("secrets", "cloudrc-tokens")["data"] = {"operator": "//4gc2VjcmV0"}
    with pytest.raises(ClusterError, match=r"'cloudrc-tokens' .* has no token under") as refused:
        operator_token(release)
    assert "secret'" not in str(refused.value)


def test_ports_are_forwarded_while_the_block_runs(release, pretend, monkeypatch, tmp_path):
    pretend(
        "kubectl",
        f"echo $$ > {tmp_path}/pid; echo $@ > {tmp_path}/line\n"
        "echo 'Forwarding from 127.0.0.1:40001 -> 9100'\n"
        "echo 'Forwarding from 127.0.0.1:40002 -> 9102'\nexec sleep 60",
    )
    with pods.forwarded(release, "world-1", [9100, 9102]) as ports:
        assert ports == {9100: 40001, 9102: 40002}
        pid = int((tmp_path / "pid").read_text())
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert "--namespace=demo port-forward pod/world-1" in (tmp_path / "line").read_text()
    monkeypatch.setattr(pods, "START_LIMIT", 0.5)
    for script, error, words in (
        ("echo 'error: pod is gone' >&2; exit 1", ClusterError, "of pod 'cloud-1'.*pod is gone"),
        ("exec sleep 60", TimedOutError, "has not started within 0.5 s"),
    ):
        pretend("kubectl", script)
        with pytest.raises(error, match=words), pods.forwarded(release, "cloud-1", [8080]):
            pytest.fail("there is no way")


KUBECTL = """\
case "$*" in
*port-forward*) echo "Forwarding from 127.0.0.1:4321 -> 8090"; exec sleep 60;;
*logs*--container=console*) echo "console: http://127.0.0.1:8090"; echo "link set uplink.loss=0.1";;
esac
"""


def test_the_page_is_forwarded_and_its_log_is_read(api, release, pretend):
    made = pod("cloud-1", "cloud")
    made["spec"]["containers"].append({"name": "console"})
    api.put("pods", made)
    pretend("kubectl", KUBECTL)
    told = []
    lines = list(pods.follow_page(release, 0, told.append))
    assert told == ["http://127.0.0.1:4321"]
    assert lines[-1] == "link set uplink.loss=0.1"
