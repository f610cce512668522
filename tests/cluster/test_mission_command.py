"""`cloudrc mission` in a cluster: its output and exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from tests.cluster.conftest import FakeApi
from tests.cluster.test_jobs import at_look, end, start_pod, terminated

MISSION = """
start: here
time_limit_s: 30
waypoints:
  - {position_m: [0.5, 0.0, 1.0], dwell_s: 0.0}
"""
VERDICT = {0: "SUCCESS: all met", 1: "FAILURE: pipe_contact"}
Printed = pytest.CaptureFixture[str]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.yaml").write_text(MISSION)


def fly(api: FakeApi, code: int = 0) -> int:
    """Call `mission run`; its Job ends with this code."""

    def land() -> None:
        *_, (_, _, job) = (key for key in api.objects if key[0] == "jobs")
        start_pod(api, job, state=terminated(code, VERDICT[code]))
        api.logs[f"{job}-x"] = f"waypoint 1 of 1 reached\n{VERDICT[code]}\n"
        end(api, job, "Failed" if code else "Complete")

    answer = api.answer
    at_look(api, 3, land)
    try:
        return main(["mission", "run", "one.yaml"])
    finally:
        api.answer = answer  # type: ignore[method-assign]


def job_of(printed: str) -> str:
    return printed.splitlines()[0].split()[1]


@pytest.mark.parametrize("code", [0, 1])
def test_run_prints_job_and_log_and_ends_with_the_verdict(
    running: FakeApi, capsys: Printed, code: int
) -> None:
    assert fly(running, code) == code
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.startswith("Job ")
    assert head.endswith(" in namespace 'demo'")
    assert lines == ["waypoint 1 of 1 reached", VERDICT[code]]


def test_list_and_status_show_jobs_with_their_verdicts(running: FakeApi, capsys: Printed) -> None:
    fly(running)
    job = job_of(capsys.readouterr().out)
    assert main(["mission", "list"]) == 0
    head, row = capsys.readouterr().out.splitlines()
    assert head.split() == ["JOB", "STATE", "CREATED", "VERDICT"]
    assert row.split()[:2] == [job, "complete"]
    assert VERDICT[0] in row
    assert main(["mission", "status", job, "-o", "json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["jobs"]
    assert (found["name"], found["state"], found["exit_code"]) == (job, "complete", 0)


def test_an_empty_list_says_how_to_fly(running: FakeApi, capsys: Printed) -> None:
    assert main(["mission", "list"]) == 0
    printed = capsys.readouterr().out
    assert printed.startswith("no missions ")
    assert printed.endswith("; fly one: cloudrc mission run FILE\n")
    assert main(["mission", "logs"]) == 2
    assert capsys.readouterr().err.startswith("cloudrc: error: no missions ")


def test_logs_default_to_the_newest_job(running: FakeApi, capsys: Printed) -> None:
    fly(running, 1)
    first = job_of(capsys.readouterr().out)
    fly(running)
    capsys.readouterr()
    assert main(["mission", "logs"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == VERDICT[0]
    assert main(["mission", "logs", first, "--follow"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == VERDICT[1]


@pytest.mark.parametrize("verb", ["status", "cancel", "logs"])
def test_a_missing_job_is_an_error_of_the_cluster(
    running: FakeApi, capsys: Printed, verb: str
) -> None:
    assert main(["mission", verb, "nothing"]) == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("cloudrc: error: ")
    assert "nothing" in line


def test_a_missing_release_is_reported_with_a_command(api: FakeApi, capsys: Printed) -> None:
    assert main(["mission", "run", "one.yaml"]) == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert "no release" in line
    assert "helm" in line
