"""Jobs of missions on the fake API server: created, followed, listed, deleted."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from cloudrc.cluster import jobs
from cloudrc.cluster.client import Release
from cloudrc.cluster.jobs import delete_job, follow, list_jobs, logs, read_job, run_job
from cloudrc.cluster.tools import ClusterError, ExpiredError
from tests.cluster.conftest import FakeApi, pod

MISSION = {"name": "short", "start": "spawn", "waypoints": [{"position_m": [0, 0, 1]}]}


def end(api: FakeApi, name: str, kind: str, **condition: str) -> None:
    ended = {"type": kind, "status": "True", **condition}
    api.get("jobs", name)["status"] = {"conditions": [ended]}


def start_pod(api: FakeApi, name: str, **given: Any) -> None:
    """Create the pod of a Job as Kubernetes does."""
    uid = api.get("jobs", name)["metadata"]["uid"]
    api.put("pods", "demo", pod(f"{name}-x", "mission", labels={jobs.UID_LABEL: uid}, **given))


def terminated(exit_code: int, message: str) -> dict[str, Any]:
    return {"terminated": {"exitCode": exit_code, "message": message}}


def at_look(api: FakeApi, number: int, action: Callable[[], None]) -> None:
    """Call `action` at the n-th request for the Job."""
    original, looks = api.answer, iter(range(1, 1000))
    lock = threading.Lock()

    def answer(method: str, path: str, body: Any) -> tuple[int, Any]:
        with lock:
            if method == "GET" and "/jobs/" in path and next(looks) == number:
                action()
        return original(method, path, body)

    api.answer = answer  # type: ignore[method-assign]


def test_a_job_uses_image_and_api_of_the_release(running: FakeApi, release: Release) -> None:
    status = run_job(release, MISSION, name="first", limit=60.0)
    assert status.state == "pending"
    job, plan = running.get("jobs", "first"), running.get("configmaps", "first")
    (container,) = job["spec"]["template"]["spec"]["containers"]
    assert container["image"] == "cloudrc/cloud:0.1.0"
    assert "--api=http://cloudrc-api:8080" in container["args"]
    assert json.loads(plan["data"]["mission.yaml"]) == MISSION
    assert plan["metadata"]["ownerReferences"][0]["uid"] == status.uid


def test_a_job_has_owner_and_placement_of_its_release(running: FakeApi, release: Release) -> None:
    cloud = running.get("deployments", "cloudrc-cloud")
    where = {"nodeSelector": {"disk": "fast"}, "tolerations": [{"key": "lab"}]}
    cloud["spec"]["template"] = {"spec": {**where, "containers": []}}
    run_job(release, MISSION, name="first")
    job = running.get("jobs", "first")
    (owner,) = job["metadata"]["ownerReferences"]
    assert (owner["kind"], owner["uid"]) == ("Deployment", cloud["metadata"]["uid"])
    assert where.items() <= job["spec"]["template"]["spec"].items()


def test_a_job_of_a_release_with_a_long_name_is_short_enough(
    running: FakeApi, release: Release
) -> None:
    for body in list(running.objects.values()):
        body["metadata"].setdefault("labels", {})["app.kubernetes.io/instance"] = "r" * 53
    status = run_job(replace(release, name="r" * 53), MISSION)
    assert len(status.name) <= 63 - len("-xxxxx")


def test_a_job_without_a_name_gets_an_unused_one(running: FakeApi, release: Release) -> None:
    names = {run_job(release, MISSION).name for _ in range(5)}
    assert len(names) == 5


def test_a_job_passes_pod_security_restricted(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first")
    spec = running.get("jobs", "first")["spec"]["template"]["spec"]
    (container,) = spec["containers"]
    assert spec["automountServiceAccountToken"] is False
    assert spec["securityContext"]["runAsNonRoot"] is True
    assert spec["securityContext"]["runAsUser"] >= 10000
    assert spec["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
    assert container["securityContext"]["capabilities"] == {"drop": ["ALL"]}
    assert container["securityContext"]["readOnlyRootFilesystem"] is True
    assert container["securityContext"]["allowPrivilegeEscalation"] is False


def test_a_job_is_tried_once_and_has_time_limits(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first", limit=60.0)
    spec = running.get("jobs", "first")["spec"]
    assert spec["backoffLimit"] == 0
    assert 60 < spec["activeDeadlineSeconds"] <= 300
    assert spec["ttlSecondsAfterFinished"] > 0
    assert spec["template"]["spec"]["restartPolicy"] == "Never"


def test_the_jobs_uid_is_the_missions_key(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first")
    (container,) = running.get("jobs", "first")["spec"]["template"]["spec"]["containers"]
    (variable,) = container["env"]
    assert f"--key=$({variable['name']})" in container["args"]
    path = variable["valueFrom"]["fieldRef"]["fieldPath"]
    assert path == "metadata.labels['batch.kubernetes.io/controller-uid']"


def test_only_a_queued_job_waits(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="impatient")
    run_job(release, MISSION, name="patient", queue=True)

    def arguments(name: str) -> list[str]:
        return running.get("jobs", name)["spec"]["template"]["spec"]["containers"][0]["args"]

    assert "--queue" not in arguments("impatient")
    assert "--queue" in arguments("patient")


@pytest.mark.parametrize(
    ("kind", "code", "state"), [("Complete", 0, "complete"), ("Failed", 1, "failed")]
)
def test_follow_writes_each_line_once_and_returns_the_verdict(
    running: FakeApi, release: Release, kind: str, code: int, state: str
) -> None:
    run_job(release, MISSION, name="first")

    def fly() -> None:
        start_pod(running, "first")
        running.logs["first-x"] = "waypoint 1 of 2 reached\n"

    def land() -> None:
        start_pod(running, "first", state=terminated(code, "the\nverdict"))
        running.logs["first-x"] = "waypoint 1 of 2 reached\nwaypoint 2 of 2 reached\n"
        end(running, "first", kind)

    at_look(running, 2, fly)
    at_look(running, 5, land)
    lines: list[str] = []
    ended = follow(release, "first", lines.append, timeout=10.0)
    assert lines == ["waypoint 1 of 2 reached", "waypoint 2 of 2 reached"]
    assert (ended.state, ended.exit_code, ended.message) == (state, code, "the verdict")


def test_follow_has_a_timeout(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first")
    with pytest.raises(ExpiredError, match=r"'first' has not ended within 0\.05 s"):
        follow(release, "first", print, timeout=0.05)


def test_follow_ends_at_once_if_the_image_is_missing(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first")
    start_pod(running, "first", state={"waiting": {"reason": "ErrImagePull"}}, ready=False)
    with pytest.raises(ClusterError, match=r"cannot start: the image.*make kind-load"):
        follow(release, "first", print, timeout=10.0)


def test_follow_ends_if_the_pod_is_refused(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first")
    event = {
        "metadata": {"name": "first.1"},
        "involvedObject": {"kind": "Job", "name": "first"},
        "type": "Warning",
        "reason": "FailedCreate",
        "message": "violates PodSecurity",
    }
    running.put("events", "demo", event)
    with pytest.raises(ClusterError, match="violates PodSecurity"):
        follow(release, "first", print, timeout=10.0)


def test_a_job_past_its_deadline_names_the_deadline(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first")
    end(running, "first", "Failed", reason="DeadlineExceeded", message="...")
    assert "activeDeadlineSeconds" in read_job(release, "first").message


def test_jobs_are_listed_with_their_state_oldest_first(running: FakeApi, release: Release) -> None:
    for name in ("one", "two", "three"):
        run_job(release, MISSION, name=name)
    end(running, "one", "Complete")
    start_pod(running, "two")
    found = [(status.name, status.state) for status in list_jobs(release)]
    assert found == [("one", "complete"), ("two", "flying"), ("three", "pending")]


def test_a_deleted_job_is_gone(running: FakeApi, release: Release) -> None:
    run_job(release, MISSION, name="first")
    delete_job(release, "first")
    with pytest.raises(ClusterError, match='"first" not found'):
        logs(release, "first")


def test_a_missing_permission_is_reported(running: FakeApi, release: Release) -> None:
    running.refuse["POST", "jobs"] = 403, "jobs.batch is forbidden"
    with pytest.raises(ClusterError, match="can-i create jobs") as caught:
        run_job(release, MISSION)
    assert caught.value.exit_code == 5


def test_a_job_needs_a_release(api: FakeApi, release: Release) -> None:
    with pytest.raises(ClusterError, match="no release"):
        run_job(release, MISSION)
