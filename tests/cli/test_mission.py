"""`cloudrc mission` against the real API: its output and exit codes."""

import json
import threading

import pytest

from cloudrc.cli import mission as command
from cloudrc.cli.client import Api, token_reader
from cloudrc.cli.main import main
from tests.teleop.conftest import A, B, running

FILE = """
description: Two points
start: here
waypoints:
  - {position_m: [1.0, 0.0, 1.0], dwell_s: 0.0}
  - {position_m: [2.0, 0.0, 1.0], dwell_s: 0.0}
"""


FAR = {"name": "far", "waypoints": [{"position_m": [0.5, -2.0, 1.0]}]}


@pytest.fixture
def api():
    with running() as one:
        yield one


@pytest.fixture(autouse=True)
def quick(folder, monkeypatch):
    monkeypatch.setattr(command, "POLL_PERIOD", 0.02)
    monkeypatch.setattr(command, "API_TIMEOUT", 0.5)
    monkeypatch.setenv("KUBECONFIG", str(folder / "none"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    (folder / "two.yaml").write_text(FILE)


@pytest.fixture
def mission(api, monkeypatch):
    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", str(api.token_file))
    return lambda verb, *rest: main(["mission", verb, "--api", api.url, *rest])


def pilot(api, *points):
    """Move the robot to each point once the mission has reached the previous point."""

    def fly():
        api.until(lambda: api.get("/v1/state")["mission"])
        api.until(lambda: api.state_of("m1") == "flying")
        for count, point in enumerate(points, 1):
            api.flight.position = point
            api.until(lambda count=count: len(api.get("/v1/missions/m1")["reached"]) >= count)

    thread = threading.Thread(target=fly)
    thread.start()
    return thread


def test_run_follows_to_the_verdict(api, mission, capsys):
    thread = pilot(api, A, B)
    assert mission("run", "two.yaml") == 0
    thread.join()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "mission m1: starting, waypoints: 2"
    assert [line for line in lines if "waypoint 1 of 2 reached" in line]
    assert lines[-1] == "SUCCESS: every waypoint reached, every criterion met"


def test_fly_under_one_key_flies_once_and_leaves_its_verdict(
    api, mission, folder, monkeypatch, capsys
):
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


def _interrupted(*arguments):
    raise KeyboardInterrupt


def test_a_stopped_job_cancels_its_mission(api, mission, monkeypatch, capsys):
    api.post("/v1/missions", {"waypoints": [{"position_m": B}]})
    assert mission("fly", "--mission", "two.yaml") == 5
    assert "mission m1 is" in capsys.readouterr().err
    monkeypatch.setattr(command.MissionFollower, "follow", _interrupted)
    assert mission("fly", "--mission", "two.yaml", "--queue") == 130
    assert api.state_of("m2") == "cancelled"


def test_an_interrupted_run_names_the_command_that_cancels_it(api, mission, monkeypatch, capsys):
    monkeypatch.setattr(command.MissionFollower, "follow", _interrupted)
    for mine, *flags in (["m1"], ["m2", "--queue"]):
        assert mission("run", "two.yaml", *flags) == 130
        advice = capsys.readouterr().err
        assert advice == f"mission {mine} goes on; cancel it: cloudrc mission cancel {mine}\n"
    assert mission("cancel", "m2") == 0
    assert (api.state_of("m1") != "cancelled", api.state_of("m2")) == (True, "cancelled")


def test_a_mission_that_cannot_be_flown_ends_with_2(mission, folder, capsys):
    (folder / "bad.yaml").write_text("waypoints: [{position_m: [99, 0, 1]}, {position: [0, 0, 1]}]")
    assert mission("run", "bad.yaml") == 2
    error = capsys.readouterr().err
    assert "waypoints.1.position" in error
    assert "Traceback" not in error
    (folder / "steps.yaml").write_text("steps: {count: 3}")
    assert mission("run", "steps.yaml") == 2
    assert mission("run", "no-such-mission") == 2
    assert "pipes" in capsys.readouterr().err


def test_an_api_that_is_not_there_ends_with_4_or_5(capsys):
    away = ["--api", "http://127.0.0.1:9"]
    assert main(["mission", "status", *away]) == 5
    assert main(["mission", "fly", "--mission", "two.yaml", *away]) == 4
    captured = capsys.readouterr()
    assert captured.err.count("Connection refused") == 2
    assert captured.out.count("waiting") == 1


def test_an_invalid_url_of_the_api_is_an_error(capsys):
    for url in ("here", "unix:", "ftp://h:1", "http://me@h:1", "http://[::1", "http://h:x"):
        assert main(["mission", "status", "--api", url]) == 2
        assert f"--api {url}: give http://HOST:PORT or unix:PATH\n" in capsys.readouterr().err


def test_the_operators_verbs(api, mission, capsys):
    assert mission("status") == 0
    assert "no mission is under way" in capsys.readouterr().out
    assert (mission("cancel"), mission("hold")) == (2, 5)
    api.fly(FAR)
    assert mission("goto", "0.5", "0", "1") == 5  # the mission is flying
    for words, word in (("hold", "held"), ("goto 0.5 -1 1.2", "held"), ("resume", "flying")):
        assert mission(*words.split()) == 0
        assert f"mission m1 (far): {word}" in capsys.readouterr().out
    assert mission("cancel") == 0
    assert mission("goto", "0", "0", "99") == 2
    assert "beyond the fence" in capsys.readouterr().err


def test_list_status_and_logs(api, mission, capsys):
    def said(*words):
        assert mission(*words) == 0
        return capsys.readouterr().out

    assert said("list") == "no missions yet\n"
    api.fly(FAR)
    assert said("list").splitlines()[1].split() == ["m1", "far", "flying", "0/1"]
    document = json.loads(said("list", "-o", "json"))
    assert (document["schemaVersion"], document["missions"][0]["id"]) == (1, "m1")
    assert said("status").splitlines()[-1] == "next: the robot flies its mission"
    assert json.loads(said("status", "m1", "-o", "json"))["events"][1]["event"] == "started"
    assert said("logs") == said("logs", "m1") != ""
    assert mission("status", "m9") == 5
    assert "no mission 'm9'" in capsys.readouterr().err
    events = Api(api.url, token_reader(api.token_file)).events()
    assert [next(events)["event"] for _ in range(2)] == ["starting", "started"]
    events.close()


def test_emergency_stop_and_acknowledgement(api, mission, capsys):
    api.fly(FAR)
    assert mission("estop") == 0
    assert capsys.readouterr().out.endswith("stopped\nmission m1 has failed\n")
    assert api.alarms
    api.until(lambda: api.get("/v1/state")["seen"]["guard"] == "ESTOP")
    for words, code in (("run two.yaml", 5), ("status", 0)):
        assert mission(*words.split()) == code
        assert "find the cause, then: cloudrc mission acknowledge" in "".join(capsys.readouterr())
    assert mission("acknowledge") == 0
    api.until(lambda: api.get("/v1/state")["seen"]["guard"] == "GROUND")


def test_the_token_file_comes_from_flag_or_environment(api, folder, monkeypatch, capsys):
    def hold(code, *words):
        assert main(["mission", "hold", "--api", api.url, *words]) == code
        return capsys.readouterr().err

    wrong, folder_of_tokens = folder / "wrong", api.token_file.parent
    assert "asks for a token; name its file: --token-file FILE" in hold(5)
    wrong.write_text("not-the-operators-token\n")
    wrong.chmod(0o644)
    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", str(wrong))
    error = hold(5)
    assert "does not know this token" in error
    assert f"warning: {wrong} can be read by others: chmod 600 {wrong}\n" in error
    error = hold(5, "--token-file", str(folder_of_tokens / "reader"))
    assert "may look, not command" in error
    assert "warning" not in error
    assert "no mission is under way" in hold(5, "--token-file", str(api.token_file))
    wrong.write_text("two words")
    error = hold(2)
    assert "holds no token" in error
    assert "two words" not in error
    assert "--token-file none: No such file or directory" in hold(2, "--token-file", "none")


SEEN = {"position_m": [1.0, 2.0, 0.7], "rtt_s": 0.09, "guard": "TRACK", "cause": "fresh command"}
OLD = {**SEEN, "age_s": 3.2, "guard_for_s": None, "next_step": "wait"}
NEW = {**SEEN, "age_s": 0.02, "guard_for_s": 4.5, "next_step": "the robot flies"}


@pytest.mark.parametrize(
    ("seen", "cloud_age", "lines"),
    [
        (OLD, 0.1, ["no telemetry for 3.2 s; last message from cloud: 0.1 s ago",
                    "last seen at (1.00, 2.00, 0.70) m, guard TRACK: fresh command", "next: wait"]),
        (NEW, 0.02, ["robot at (1.00, 2.00, 0.70) m, seen 0.02 s ago, round trip 90 ms",
                     "guard TRACK for 4.5 s: fresh command", "next: the robot flies"]),
        (None, None, ["no telemetry from the robot yet; is the link up? "
                      "last message from cloud: never"]),
    ],
    ids=["not heard", "heard", "never heard"],
)  # fmt: skip
def test_old_values_of_the_robot_are_marked_as_old(seen, cloud_age, lines, monkeypatch, capsys):
    state = {"mission": None, "queue": ["m2", "m3"], "seen": seen, "cloud_age_s": cloud_age}
    monkeypatch.setattr(Api, "get", lambda api, path: state)
    assert main(["mission", "status", "--api", "unix:there"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == ["waiting: m2, m3", *lines]
