# SPDX-License-Identifier: Apache-2.0

"""A release is selected; requests and programs fail with an error of one line."""

import pytest

from cloudrc.base.errors import MissingPrerequisiteError, TimedOutError
from cloudrc.cluster import client
from cloudrc.cluster.client import ClusterError, Release, connect
from cloudrc.cluster.jobs import follow, run_job
from cloudrc.cluster.pods import find_pod
from tests.cluster.conftest import MISSION, pod, terminated


def test_flags_override_the_kubeconfig(api):
    assert connect().namespace == "demo"
    assert connect("elsewhere").namespace == "default"
    release = connect("elsewhere", "mine", "paper")
    assert release == Release("elsewhere", "mine", "paper")
    assert release.flags == ["--context=elsewhere", "--namespace=mine"]
    assert release.helm_flags == ["--kube-context=elsewhere", "--namespace=mine"]
    assert release.helm_upgrade("link.profile=lte") == (
        "helm upgrade paper charts/cloudrc --kube-context=elsewhere --namespace=mine "
        "--reset-then-reuse-values --set link.profile=lte"
    )
    with pytest.raises(MissingPrerequisiteError, match=r"no context 'x'.*elsewhere, here"):
        connect("x")


def test_the_newest_pod_of_the_release_is_found(api, release):
    with pytest.raises(ClusterError, match=r"no release 'cloudrc' in namespace 'demo'; see all"):
        find_pod(release, "cloud")
    for name in ("old", "new", "ending"):
        api.put("pods", pod(name, "cloud"))
    api.put("pods", pod("other", "cloud", labels={"app.kubernetes.io/instance": "other"}))
    api.get("pods", "ending")["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:59Z"
    assert find_pod(release, "cloud").metadata.name == "new"


def test_only_a_short_outage_is_waited_for(running, release):
    run_job(release, MISSION, name="first")
    running.start_pod("first", state=terminated(0, "done"))
    running.logs["first-x"] = "waypoint 1 of 1 reached\n"
    running.end("first", "Complete")
    for plural, code in (("jobs", 429), ("pods", 500)):
        left, lines = running.away(plural, code, 3), []
        assert follow(release, "first", lines.append).exit_code == 0
        assert (left, lines) == ([], ["waypoint 1 of 1 reached"])
    left = running.away("jobs", 403, 5)
    with pytest.raises(ClusterError, match="leader changed"):
        follow(release, "first", print)
    assert len(left) == 4, "a refusal is not repeated"


@pytest.mark.parametrize(
    ("script", "kind", "expected"),
    [
        ("exec sleep 60", TimedOutError, r"'helm list' took more than 0\.3 s"),
        ("echo 'W1120 06:00 beware\nError: UPGRADE FAILED: no\n  - way'", ClusterError, "no - way"),
        (
            "echo 'error: error dialing backend: dial tcp 172.18.0.2:10250: connection refused'",
            ClusterError,
            "the pod's node does not answer, see: kubectl get nodes",
        ),
    ],
)
def test_the_error_of_a_program_becomes_one_line(pretend, monkeypatch, script, kind, expected):
    monkeypatch.setattr(client, "PROGRAM_LIMIT", 0.3 if "sleep" in script else 10.0)
    pretend("helm", f"exec >&2\n{script}\nexit 1")
    with pytest.raises(kind, match=expected) as caught:
        client.run("helm", ["list", "--all"])
    assert "\n" not in str(caught.value)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(MissingPrerequisiteError, match=r"helm is not installed; .*doctor"):
        client.run("helm", ["version"])
