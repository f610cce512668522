# SPDX-License-Identifier: Apache-2.0

"""`cloudrc mission` in a cluster: its target, checks, output and exit codes."""

import json
import sys

import pytest

from cloudrc.cluster import flight
from cloudrc.doors.cli.main import main
from cloudrc.doors.missions import read_mission
from cloudrc.results import under_way
from tests.cluster.conftest import TOKEN, missions_of, pod, terminated

WAYPOINTS = "waypoints: [{position_m: [0.5, 0.0, 1.0]}]"
VERDICT = {0: "SUCCESS: all met", 1: "FAILURE: pipe_contact"}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "one.yaml").write_text(WAYPOINTS)
    return tmp_path


@pytest.fixture
def lands(running, monkeypatch):
    """A release whose Jobs succeed as soon as they are followed."""
    original = flight.follow

    def follow(release, name, *given):
        running.start_pod(name, state=terminated(0, "done"))
        running.end(name, "Complete")
        return original(release, name, *given)

    monkeypatch.setattr(flight, "follow", follow)
    return running


@pytest.mark.parametrize("code", [0, 1])
def test_run_prints_the_log_of_its_job_and_ends_with_the_verdict(running, call, code):
    def land():
        ((_, job),) = (key for key in running.objects if key[0] == "jobs")
        running.start_pod(job, state=terminated(code, VERDICT[code]))
        running.logs[f"{job}-x"] = f"waypoint 1 of 1 reached\n{VERDICT[code]}\n"
        running.end(job, "Failed" if code else "Complete")

    running.at_look(3, land)
    head, *lines = call("mission run one.yaml", code=code).out.splitlines()
    assert head.startswith("Job ")
    assert head.endswith(" on release 'cloudrc' in namespace 'demo'")
    assert lines == ["waypoint 1 of 1 reached", VERDICT[code]]


def test_the_job_of_a_detached_mission_is_followed_later(running, call):
    said = call("mission run one.yaml --detach").out.splitlines()
    (job,) = (body["metadata"]["name"] for body in running.jobs())
    assert said[-1] == f"follow it: cloudrc mission attach {job} --namespace=demo --release=cloudrc"
    running.start_pod(job, state=terminated(1, VERDICT[1]))
    running.logs[f"{job}-x"] = f"waypoint 1 of 1 reached\n{VERDICT[1]}\n"
    running.end(job, "Failed")
    for words in ("", job):
        lines = call(f"mission attach {words}", code=1).out.splitlines()
        assert lines == ["waypoint 1 of 1 reached", VERDICT[1]]


def test_the_other_verbs_go_to_the_api_of_the_release(running, teleop, call, as_json, refused):
    assert as_json("mission list")["missions"] == []
    said = call("mission acknowledge").out
    assert said.startswith("release 'cloudrc' in namespace 'demo': acknowledged")
    assert teleop.posted == ["/v1/acknowledge"]
    assert teleop.tokens == {f"Bearer {TOKEN}"}
    running.objects.pop(("secrets", "cloudrc-tokens"))
    assert "secrets" in refused("mission list", code=5)


def test_run_waits_until_the_release_is_ready(lands, call):
    """`helm install` does not wait for the pods."""
    lands.put("pods", pod("cloud-1", "cloud", ready=False, phase="Pending"))
    lands.at_look(4, lambda: lands.put("pods", pod("cloud-1", "cloud")), plural="pods")
    assert "container cloud is not ready yet" in call("mission run pipes").out
    (job,) = lands.jobs()
    deadline = job["spec"]["activeDeadlineSeconds"]
    assert deadline >= 86_400 + 60, "a mission without a time limit gets a day"
    plan = lands.get("configmaps", job["metadata"]["name"])["data"]["mission.yaml"]
    assert json.loads(plan) == read_mission("pipes")


def forget_jobs(api):
    for key in [key for key in api.objects if key[0] == "jobs"]:
        api.objects.pop(key)


@pytest.mark.parametrize(
    ("ended", "words", "code"),
    [
        (None, "mission m4 is cancelled: its Job was deleted", 130),
        ({"outcome": "success", "exit_code": 0, "failures": []}, "SUCCESS: every waypoint", 0),
    ],
)
def test_a_deleted_job_cancels_its_mission_if_it_still_flies(
    running, teleop, call, ended, words, code
):
    def delete():
        about = {"name": "one", "state": "done", "waypoint": 0, "waypoints": 1, "verdict": ended}
        missions = [{**mission, **about} for mission in missions_of(running)]
        teleop.missions = lambda: missions
        forget_jobs(running)

    running.at_look(3, delete)
    assert words in call("mission run one.yaml", code=code).out.splitlines()[-1]
    assert teleop.posted == ([] if ended else ["/v1/missions/m4/cancel"])


@pytest.fixture
def flies_here(tmp_path):
    """A run on this machine whose API does not answer."""
    with under_way.announced(tmp_path / "runs" / "latest", f"unix:{tmp_path}/silent.sock"):
        yield


@pytest.mark.usefixtures("flies_here")
@pytest.mark.parametrize(
    "words",
    [["cloudrc", "mission", "list", "-n", "demo"], ["/bin/kubectl-cloudrc", "mission", "list"]],
)
def test_a_flag_or_the_plugin_of_kubectl_selects_the_cluster(
    running, teleop, capsys, monkeypatch, words
):
    monkeypatch.setattr(sys, "argv", words)
    assert main() == 0
    assert capsys.readouterr().out == "release 'cloudrc' in namespace 'demo': no missions yet\n"
