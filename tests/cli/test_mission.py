"""`cloudrc mission` against the real API: its output and exit codes."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cloudrc.cli import mission as command
from cloudrc.cli.client import Api, token_reader
from cloudrc.cli.main import main
from cloudrc.drivers import local
from tests.teleop.conftest import A, B, Running, running

FILE = """
description: Two points
start: here
waypoints:
  - {position_m: [1.0, 0.0, 1.0], dwell_s: 0.0}
  - {position_m: [2.0, 0.0, 1.0], dwell_s: 0.0}
"""


@pytest.fixture
def api() -> Iterator[Running]:
    with running() as one:
        yield one


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "POLL_PERIOD", 0.02)
    monkeypatch.setattr(command, "API_TIMEOUT", 0.5)
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "none"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "two.yaml").write_text(FILE)
    return tmp_path


Command = Callable[..., int]


@pytest.fixture
def mission(api: Running, monkeypatch: pytest.MonkeyPatch) -> Command:
    def run(*words: str) -> int:
        verb, *rest = words
        return main(["mission", verb, "--api", api.url, *rest])

    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", str(api.token_file))

    return run


def pilot(api: Running, *points: tuple[float, float, float]) -> threading.Thread:
    """Move the robot from point to point, each once the mission has reached the previous one."""

    def fly() -> None:
        api.until(lambda: api.get("/v1/state")["mission"] is not None)
        mission_id = api.get("/v1/state")["mission"]["id"]
        path = f"/v1/missions/{mission_id}"
        api.until(lambda: api.get(path)["state"] == "flying")
        for count, point in enumerate(points, 1):
            api.flight.position = point
            api.until(lambda count=count: len(api.get(path)["reached"]) >= count)

    thread = threading.Thread(target=fly)
    thread.start()
    return thread


def test_run_follows_to_the_verdict(
    api: Running, mission: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    thread = pilot(api, A, B)
    assert mission("run", "two.yaml") == 0
    thread.join()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "mission m1: starting, waypoints: 2"
    assert [line for line in lines if "waypoint 1 of 2 reached" in line]
    assert lines[-1] == "SUCCESS: every waypoint reached, every criterion met"


def test_fly_under_one_key_flies_once_and_leaves_its_verdict(
    api: Running,
    mission: Command,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    log = folder / "termination-log"
    log.touch()
    monkeypatch.setattr(command, "TERMINATION_LOG", log)
    thread = pilot(api, A)
    end = threading.Thread(target=lambda: (thread.join(), api.post("/v1/missions/m1/cancel")))
    end.start()
    assert mission("fly", "--mission", "two.yaml", "--key", "uid") == 130
    end.join()
    assert log.read_text() == "INTERRUPTED: cancelled: mission cancelled\n"
    assert mission("fly", "--mission", "two.yaml", "--key", "uid") == 130
    assert capsys.readouterr().out.count("INTERRUPTED") == 2
    assert len(api.get("/v1/missions")["missions"]) == 1


def test_a_stopped_job_cancels_its_mission(
    api: Running, mission: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(self: object, mission_id: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command.MissionFollower, "follow", stopped)
    assert mission("fly", "--mission", "two.yaml") == 130
    assert api.state_of("m1") == "cancelled"


def test_a_second_mission_is_refused_and_names_the_first(
    api: Running, mission: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    api.post("/v1/missions", {"waypoints": [{"position_m": B}]})
    assert mission("fly", "--mission", "two.yaml") == 5
    assert "mission m1 is" in capsys.readouterr().err


def test_a_mission_that_cannot_be_flown_ends_with_2(
    mission: Command, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "bad.yaml").write_text("waypoints: [{position_m: [99, 0, 1]}, {position: [0, 0, 1]}]")
    assert mission("run", "bad.yaml") == 2
    error = capsys.readouterr().err
    assert "waypoints.1.position" in error
    assert "Traceback" not in error
    (folder / "steps.yaml").write_text("steps: {count: 3}")
    assert mission("run", "steps.yaml") == 2
    assert mission("run", "no-such-mission") == 2
    assert "pipes" in capsys.readouterr().err


def test_an_api_that_is_not_there_ends_with_4_or_5(capsys: pytest.CaptureFixture[str]) -> None:
    away = ["--api", "http://127.0.0.1:9"]
    assert main(["mission", "status", *away]) == 5
    assert main(["mission", "fly", "--mission", "two.yaml", *away]) == 4
    captured = capsys.readouterr()
    assert captured.err.count("Connection refused") == 2
    assert captured.out.count("waiting") == 1


@pytest.mark.parametrize(
    "url",
    ["here", "unix:", "ftp://h:1", "http://me@h:1", "http://", "http://[::1", "http://h:x"],
)
def test_an_invalid_url_of_the_api_is_an_error(
    url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mission", "status", "--api", url]) == 2
    said = f"cloudrc: error: --api {url}: give http://HOST:PORT or unix:PATH\n"
    assert capsys.readouterr().err == said


def test_the_operators_verbs(
    api: Running, mission: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert mission("status") == 0
    assert "no mission is under way" in capsys.readouterr().out
    assert mission("cancel") == 2
    assert mission("hold") == 5
    api.post("/v1/missions", {"name": "far", "waypoints": [{"position_m": [0.5, -2.0, 1.0]}]})
    api.until(lambda: api.state_of("m1") == "flying")
    for verb, word in (("hold", "held"), ("goto", "held"), ("resume", "flying")):
        points = ["0.5", "-1", "1.2"] if verb == "goto" else []
        assert mission(verb, *points) == 0
        assert f"mission m1 (far): {word}" in capsys.readouterr().out
    assert mission("goto", "0.5", "0", "1") == 5  # the mission is flying
    assert mission("cancel") == 0
    assert mission("goto", "0", "0", "99") == 2
    assert "beyond the fence" in capsys.readouterr().err


def test_list_status_and_logs(
    api: Running, mission: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert mission("list") == 0
    assert capsys.readouterr().out == "no missions yet\n"
    api.post("/v1/missions", {"name": "far", "waypoints": [{"position_m": [0.5, -2.0, 1.0]}]})
    api.until(lambda: api.state_of("m1") == "flying")
    assert mission("list") == 0
    assert capsys.readouterr().out.splitlines()[1].split() == ["m1", "far", "flying", "0/1"]
    assert mission("list", "-o", "json") == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["schemaVersion"], document["missions"][0]["id"]) == (1, "m1")
    assert mission("status") == 0
    said = capsys.readouterr().out
    assert "robot at (0.00, 0.00, 0.10) m, seen 0." in said
    assert re.search(r"^guard TRACK for 0\.\d s: fresh command$", said, re.MULTILINE)
    assert said.splitlines()[-1] == "next: the robot flies its mission"
    assert mission("status", "m1", "-o", "json") == 0
    assert json.loads(capsys.readouterr().out)["events"][1]["event"] == "started"
    for words in (["logs"], ["logs", "m1"]):
        assert mission(*words) == 0
        assert "mission started from the spawn" in capsys.readouterr().out
    assert mission("status", "m9") == 5
    assert "no mission 'm9'" in capsys.readouterr().err


def test_the_local_run_is_found_and_needs_no_token(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with running(unix=True) as api:
        with local.announced(folder / "runs" / "latest", api.url):
            assert main(["mission", "status"]) == 0
            assert "no mission is under way" in capsys.readouterr().out
            api.post_local("/v1/missions", {"waypoints": [{"position_m": [0.5, -2.0, 1.0]}]})
            assert main(["mission", "estop"]) == 0
        said = capsys.readouterr().out
        assert said.splitlines() == [
            "emergency stop: sent, and repeated until the rotors have stopped",
            "mission m1 has failed",
        ]


def test_emergency_stop_and_acknowledgement(
    api: Running, mission: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert mission("estop") == 0
    assert api.alarms
    api.until(lambda: api.get("/v1/state")["seen"]["guard"] == "ESTOP")
    assert mission("run", "two.yaml") == 5
    assert "cloudrc mission acknowledge" in capsys.readouterr().err
    assert mission("status") == 0
    said = capsys.readouterr().out.splitlines()
    assert re.search(r" m, seen 0\.\d\d s ago$", said[-3])
    assert re.fullmatch(r"guard ESTOP for \d+\.\d s: emergency stop", said[-2])
    after = "the rotors are stopped; find the cause, then: cloudrc mission acknowledge"
    assert said[-1] == f"next: {after}"
    assert mission("acknowledge") == 0
    api.until(lambda: api.get("/v1/state")["seen"]["guard"] == "GROUND")
    assert capsys.readouterr().out.splitlines() == [
        "acknowledged: the next mission may fly; a landing close to the ground is completed first",
        "after a stop or a touchdown the robot takes off only once it is at rest, and at least "
        "0.5 m inside the fence",
    ]


def test_the_token_file_comes_from_flag_or_environment(
    api: Running,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["mission", "hold", "--api", api.url]
    assert main(command) == 5
    assert "asks for a token; name its file: --token-file FILE" in capsys.readouterr().err
    (folder / "wrong").write_text("not-the-operators-token\n")
    (folder / "wrong").chmod(0o644)
    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", str(folder / "wrong"))
    assert main(command) == 5
    error = capsys.readouterr().err
    assert "does not know this token" in error
    path = folder / "wrong"
    assert f"warning: {path} can be read by others: chmod 600 {path}\n" in error
    assert main([*command, "--token-file", str(api.folder.name) + "/reader"]) == 5
    error = capsys.readouterr().err
    assert "may look, not command" in error
    assert "warning" not in error
    assert main([*command, "--token-file", str(api.token_file)]) == 5
    assert "no mission is under way" in capsys.readouterr().err
    (folder / "wrong").write_text("two words")
    assert main(command) == 2
    assert "holds no token" in capsys.readouterr().err
    assert main([*command, "--token-file", "none"]) == 2
    error = capsys.readouterr().err
    assert "--token-file none: No such file or directory" in error
    assert "two words" not in error


def test_without_run_and_cluster_both_remedies_are_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["mission", "status"]) == 3
    error = capsys.readouterr().err
    assert "no run flies here" in error
    assert "KUBECONFIG" in error
    assert error.count("\n") == 1


def test_a_missing_verb_or_point_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["mission"]) == 2
    assert main(["mission", "goto", "1", "2"]) == 2
    assert main(["mission", "holt"]) == 2
    assert "hold" in capsys.readouterr().err
    assert main(["mission", "goto", "1", "2", "up"]) == 2
    assert "'up' is not a number of metres" in capsys.readouterr().err


def test_events_can_be_followed(api: Running) -> None:
    api.post("/v1/missions", {"waypoints": [{"position_m": B}]})
    stream = Api(api.url, token_reader(api.token_file)).events()
    assert [next(stream)["event"] for _ in range(2)] == ["starting", "started"]
    stream.close()


def test_a_shipped_mission_is_read_by_its_name() -> None:
    mission = command.read_mission("pipes")
    assert (mission["name"], len(mission["waypoints"])) == ("pipes", 7)
