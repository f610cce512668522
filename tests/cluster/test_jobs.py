# SPDX-License-Identifier: Apache-2.0

"""Jobs of missions on the fake API server: created, followed, deleted."""

import json

import pytest

from cloudrc.cluster import jobs
from cloudrc.cluster.client import ClusterError
from cloudrc.cluster.jobs import follow, run_job, why_waiting
from cloudrc.cluster.pods import Finding, list_pods
from tests.cluster.conftest import MISSION, TOKEN, put_template_and_token, waiting


def pod_of(api, name):
    return api.get("jobs", name)["spec"]["template"]["spec"]


def test_a_job_posts_the_mission_to_its_release(running, release):
    assert run_job(release, MISSION, name="first") == "first"
    plan, job = running.get("configmaps", "first"), running.get("jobs", "first")
    assert json.loads(plan["data"]["mission.yaml"]) == MISSION
    assert plan["metadata"]["ownerReferences"][0]["uid"] == job["metadata"]["uid"]
    for found in (job["metadata"], job["spec"]["template"]["metadata"], plan["metadata"]):
        assert release.labels("mission").items() <= found["labels"].items(), "for NetworkPolicies"
    pod = pod_of(running, "first")
    (container,) = pod["containers"]
    assert container["image"] == "cloudrc/cloud:0.1.0"
    assert "--api=http://cloudrc-api:8080" in container["args"]
    assert "--queue" not in container["args"]
    volume = next(v["secret"] for v in pod["volumes"] if v["name"] == "tokens")
    assert volume["secretName"] == "cloudrc-tokens"
    assert TOKEN not in str(job)
    run_job(release, MISSION, name="patient", queue=True)
    assert "--queue" in pod_of(running, "patient")["containers"][0]["args"]


def test_only_the_missions_volume_gets_the_missions_name(running, release):
    """The report needs the release's experiment and link; a user has files of his own."""
    own = [{"name": "own", "configMap": {"name": "mine"}}]
    values = {"recordings": {"storage": "1Gi"}, "mission": {"extraVolumes": own}}
    put_template_and_token(running, values)
    run_job(release, MISSION, name="first")
    volumes = pod_of(running, "first")["volumes"]
    assert {each["name"]: each["configMap"]["name"] for each in volumes if "configMap" in each} == {
        "mission": "first",
        "experiment": "cloudrc-experiment",
        "link": "cloudrc-link",
        "own": "mine",
    }


@pytest.mark.parametrize(("state", "waits"), [("warn", True), ("missing", False)])
def test_the_state_of_a_pod_decides_whether_its_job_waits(
    running, release, monkeypatch, state, waits
):
    run_job(release, MISSION, name="first")
    running.start_pod("first", phase="Pending", ready=False)
    pods, job = list_pods(release, "mission"), release.request("get", "jobs", name="first")
    monkeypatch.setattr(jobs, "pod_failure", lambda pod: Finding("pod", state, "any words"))
    if waits:
        assert why_waiting(release, job, pods) == "waiting: any words"
    else:
        with pytest.raises(ClusterError, match="'first' cannot start: any words; fix this"):
            why_waiting(release, job, pods)


def test_follow_ends_when_the_pod_cannot_run(running, release):
    run_job(release, MISSION, name="first")
    running.tell_of("jobs", "first", reason="FailedCreate", message="violates PodSecurity")
    with pytest.raises(ClusterError, match="violates PodSecurity"):
        follow(release, "first", print)
    running.start_pod("first", phase="Pending", state=waiting("ErrImagePull"), ready=False)
    with pytest.raises(ClusterError, match=r"cannot start: the image.*make kind-load"):
        follow(release, "first", print)
