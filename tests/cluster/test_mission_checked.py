"""`cloudrc mission run` on a cluster: checks and waits before the Job is created."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from cloudrc.cli import mission as command
from cloudrc.cli.main import main
from cloudrc.cluster import jobs as following
from cloudrc.cluster.client import Release
from cloudrc.cluster.jobs import follow_limit, run_job
from cloudrc.cluster.tools import ClusterError
from tests.cluster.conftest import FakeApi, labels, pod
from tests.cluster.test_jobs import MISSION, end, start_pod, terminated

Printed = pytest.CaptureFixture[str]
WAYPOINTS = "waypoints: [{position_m: [0.5, 0.0, 1.0]}]"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def lands(running: FakeApi, monkeypatch: pytest.MonkeyPatch) -> FakeApi:
    """A release whose Jobs succeed as soon as they are followed."""
    original = following.follow

    def follow(release: Release, name: str, *given: Any, timeout: float) -> Any:
        running.objects["jobs", "demo", name]["metadata"]["patience"] = timeout
        start_pod(running, name, state=terminated(0, "done"))
        end(running, name, "Complete")
        return original(release, name, *given, timeout=timeout)

    monkeypatch.setattr(following, "follow", follow)
    return running


def experiment(api: FakeApi, given: dict[str, Any]) -> None:
    """Write the release's experiment as the chart does."""
    data = {"experiment.yaml": yaml.safe_dump(given)}
    metadata = {"name": "cloudrc-experiment", "labels": labels("experiment")}
    api.put("configmaps", "demo", {"metadata": metadata, "data": data})


def made(api: FakeApi) -> list[dict[str, Any]]:
    return [body for (kind, _, _), body in api.objects.items() if kind == "jobs"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"time_limit_s: abc\n{WAYPOINTS}", "time_limit_s: 'abc': must be a number"),
        (f"time_limit_s: .inf\n{WAYPOINTS}", "time_limit_s: inf: must be finite"),
        (f"time_limit_s: .nan\n{WAYPOINTS}", "time_limit_s: nan: must be finite"),
        (f"start: there\n{WAYPOINTS}", "start"),
        ("waypoints: []", "waypoints: none given; give at least one"),
        ("waypoints: [{position: [0, 0, 1]}]", "did you mean position_m"),
        ("waypoints: [{position_m: [0, 0, 99]}]", "waypoints.0.position_m.*beyond the fence"),
        ("waypoints: [{position_m: [-0.5, 2.0, 0.8]}]", "wall of pipe"),
    ],
)
def test_a_mission_that_cannot_be_flown_makes_no_job(
    running: FakeApi, folder: Path, capsys: Printed, text: str, words: str
) -> None:
    (folder / "wrong.yaml").write_text(text)
    assert main(["mission", "run", "wrong.yaml"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("cloudrc: error: wrong.yaml")
    assert re.search(words, said)
    assert made(running) == []


@pytest.mark.parametrize(
    ("mission", "given", "limit"),
    [
        (WAYPOINTS, {"criteria": {"time_limit_s": 300.0}}, 300),
        (f"time_limit_s: 20\n{WAYPOINTS}", {"criteria": {"time_limit_s": 300.0}}, 20),
        (WAYPOINTS, {"seed": 4, "link": {"profile": "lossy"}}, 60),
    ],
    ids=["the experiment's", "its own", "the default"],
)
@pytest.mark.parametrize("queue", [[], ["--queue"]], ids=["at once", "queued"])
def test_a_jobs_deadline_follows_the_missions_time_limit(
    lands: FakeApi, folder: Path, mission: str, given: dict[str, Any], limit: int, queue: list[str]
) -> None:
    experiment(lands, given)
    (folder / "one.yaml").write_text(mission)
    assert main(["mission", "run", "one.yaml", *queue]) == 0
    (job,) = made(lands)
    deadline = job["spec"]["activeDeadlineSeconds"]
    wait = 600 if queue else 0
    assert deadline >= limit + wait + 60
    assert queue or deadline <= limit + 180
    assert job["metadata"]["patience"] > deadline


def test_an_unreadable_experiment_gives_a_long_deadline(lands: FakeApi, folder: Path) -> None:
    lands.refuse["GET", "configmaps"] = 403, "configmaps is forbidden"
    (folder / "one.yaml").write_text(WAYPOINTS)
    assert main(["mission", "run", "one.yaml"]) == 0
    (job,) = made(lands)
    assert job["spec"]["activeDeadlineSeconds"] >= 600


def test_a_huge_limit_is_cut_to_what_kubernetes_accepts() -> None:
    assert follow_limit(1e300, queue=True) < 2**31 + 100


def test_run_waits_until_the_release_is_ready(
    lands: FakeApi, folder: Path, capsys: Printed
) -> None:
    """`helm install` does not wait for the pods."""
    original, looks = lands.answer, 0
    lands.put("pods", "demo", pod("cloud-1", "cloud", ready=False, phase="Pending"))

    def answer(method: str, path: str, body: Any) -> tuple[int, Any]:
        nonlocal looks
        looks += "/pods" in path
        if looks == 4:
            lands.put("pods", "demo", pod("cloud-1", "cloud"))
        return original(method, path, body)

    lands.answer = answer  # type: ignore[method-assign]
    (folder / "one.yaml").write_text(WAYPOINTS)
    assert main(["mission", "run", "one.yaml"]) == 0
    assert "container cloud is not ready yet" in capsys.readouterr().out


def test_the_wait_for_a_release_has_a_timeout(
    running: FakeApi, folder: Path, capsys: Printed
) -> None:
    running.put("pods", "demo", pod("world-1", "world", ready=False))
    (folder / "one.yaml").write_text(WAYPOINTS)
    assert main(["mission", "run", "one.yaml", "--timeout", "0.05"]) == 4
    assert "container world is not ready yet" in capsys.readouterr().err
    assert made(running) == []


def test_a_job_without_its_configmap_is_deleted(running: FakeApi, release: Release) -> None:
    running.refuse["POST", "configmaps"] = 403, "configmaps is forbidden"
    with pytest.raises(ClusterError, match="can-i create configmaps"):
        run_job(release, MISSION, name="first")
    assert made(running) == []


def test_an_interrupted_run_says_that_the_job_continues(
    running: FakeApi, folder: Path, capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: object, **more: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(following, "follow", interrupted)
    (folder / "one.yaml").write_text(WAYPOINTS)
    assert main(["mission", "run", "one.yaml"]) == 130
    (job,) = made(running)
    name = job["metadata"]["name"]
    assert capsys.readouterr().err == (
        f"Job {name} is still running; cancel it: "
        f"cloudrc mission cancel {name} --namespace=demo --release=cloudrc\n"
    )


def test_the_shipped_mission_is_posted_unchanged(lands: FakeApi) -> None:
    assert main(["mission", "run", "pipes"]) == 0
    (job,) = made(lands)
    plan = lands.get("configmaps", job["metadata"]["name"])["data"]["mission.yaml"]
    assert json.loads(plan) == command.read_mission("pipes")
