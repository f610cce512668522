# SPDX-License-Identifier: Apache-2.0

"""`cloudrc mission` against the real API: its output and exit codes."""

import json
import subprocess
import sys
import threading
from unittest.mock import Mock, patch

import pytest

from cloudrc.base.outside.paths import read_token
from cloudrc.doors.cli import mission as command
from cloudrc.teleop.client import Api
from tests.conftest import wait_until
from tests.teleop.conftest import FAR, A, B, running

FILE = """
description: Two points
start: here
waypoints:
  - {position_m: [1.0, 0.0, 1.0], dwell_s: 0.0}
  - {position_m: [2.0, 0.0, 1.0], dwell_s: 0.0}
"""
SUCCESS = {"outcome": "success", "exit_code": 0, "failures": []}
CANCELLED = [{"code": "cancelled", "text": "mission cancelled"}]


@pytest.fixture
def api():
    with running() as one:
        yield one


@pytest.fixture(autouse=True)
def quick(folder, monkeypatch):
    monkeypatch.setattr("cloudrc.doors.missions.POLL_PERIOD", 0.02)
    monkeypatch.setattr(command, "API_TIMEOUT", 0.5)
    monkeypatch.setenv("KUBECONFIG", str(folder / "none"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    (folder / "two.yaml").write_text(FILE)


@pytest.fixture
def mission(api, monkeypatch, call):
    """Return a function that runs `cloudrc mission` with the API, as `call` does."""
    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", str(api.token_file))
    return lambda line, code=0: call(f"mission {line} --api {api.url}", code=code)


def pilot(api, *points):
    """Move the robot to the points of a mission that somebody will order."""

    def fly():
        api.until(lambda: api.get("/v1/state")["mission"])
        api.visit("m1", *points)

    thread = threading.Thread(target=fly)
    thread.start()
    return thread


def test_run_follows_to_the_verdict(api, mission):
    thread = pilot(api, A, B)
    lines = mission("run two.yaml").out.splitlines()
    thread.join()
    assert lines[0] == "mission m1: starting, waypoints: 2"
    assert [line for line in lines if "waypoint 1 of 2 reached" in line]
    assert lines[-1] == "SUCCESS: every waypoint reached, every criterion met"


def test_a_detached_mission_is_followed_later(api, mission):
    said = mission("run two.yaml --detach").out.splitlines()
    assert said[-1] == "follow it: cloudrc mission attach m1"
    with patch.object(command.MissionFollower, "follow", return_value=SUCCESS) as follow:
        mission("attach")
    assert follow.call_args.args == ("m1",), "the current one"
    pilot(api, A, B).join()
    lines = mission("attach m1").out.splitlines()
    assert [line for line in lines if "waypoint 1 of 2 reached" in line]
    assert lines[-1] == "SUCCESS: every waypoint reached, every criterion met"
    assert "no mission is under way" in mission("attach", 2).err


def test_fly_under_one_key_flies_once_and_leaves_its_verdict(api, mission, folder, monkeypatch):
    log = folder / "termination-log"
    log.touch()
    monkeypatch.setattr("cloudrc.doors.cli.output.TERMINATION_LOG", log)
    thread = pilot(api, A)
    end = threading.Thread(target=lambda: (thread.join(), api.post("/v1/missions/m1/cancel")))
    end.start()
    for _ in range(2):
        assert "INTERRUPTED" in mission("fly --mission two.yaml --key uid", 130).out
        left = json.loads(log.read_text())
        assert left == {"outcome": "interrupted", "exit_code": 130, "failures": CANCELLED}
    end.join()
    assert len(api.get("/v1/missions")["missions"]) == 1


@pytest.fixture
def interrupted(monkeypatch):
    """Interrupt each command while it follows its mission."""
    monkeypatch.setattr(command.MissionFollower, "follow", Mock(side_effect=KeyboardInterrupt))


@pytest.mark.usefixtures("interrupted")
def test_ctrl_c_of_somebody_who_flies_a_jobs_mission_by_hand_cancels_it(api, mission):
    api.post("/v1/missions", {"waypoints": [{"position_m": B}]})
    assert "mission m1 is" in mission("fly --mission two.yaml", 5).err
    mission("fly --mission two.yaml --queue", 130)
    assert api.state_of("m2") == "cancelled"


def test_sigterm_leaves_the_mission_to_the_next_watcher(api, mission, folder):
    words = ["mission", "fly", "--mission=two.yaml", "--key=uid", f"--api={api.url}"]
    with subprocess.Popen(
        [sys.executable, "-m", "cloudrc", *words], stdout=subprocess.PIPE, text=True
    ) as watcher:
        wait_until(lambda: api.get("/v1/missions")["missions"], 30.0)
        api.until(lambda: api.state_of("m1") == "flying")
        watcher.terminate()
        assert watcher.wait(10.0) == command.TERMINATED
        assert "goes on" in watcher.stdout.read().splitlines()[-1]
    assert api.state_of("m1") == "flying"
    assert api.flight.teleop.book.find("m1").order.lease == command.LEASE
    threading.Timer(0.2, lambda: api.post("/v1/missions/m1/cancel")).start()
    first = mission("fly --mission two.yaml --key uid --lease 30", 130).out.splitlines()[0]
    assert first == "following mission m1 (two): flying, waypoint 1 of 2"


@pytest.mark.usefixtures("interrupted")
def test_an_interrupted_run_names_the_command_that_cancels_it(api, mission):
    for mine, flag in (("m1", ""), ("m2", "--queue")):
        advice = mission(f"run two.yaml {flag}", 130).err
        assert f"mission {mine} goes on; cancel it: cloudrc mission cancel {mine}\n" in advice
    mission("cancel m2")
    assert (api.state_of("m1") != "cancelled", api.state_of("m2")) == (True, "cancelled")


def test_an_api_that_is_not_there_ends_with_4_or_5(call):
    for verb, code, waits in (("status", 5, 0), ("fly --mission two.yaml", 4, 1)):
        out, error = call(f"mission {verb} --api http://127.0.0.1:9", code=code)
        assert "Connection refused" in error
        assert out.count("waiting") == waits


def test_a_verb_needs_a_mission_in_the_right_state(api, mission):
    assert "no mission is under way" in mission("status").out
    assert "no mission is under way" in mission("cancel", 2).err
    api.fly(FAR)
    mission("goto 0.5 0 1", 5)  # the mission is flying
    assert "[0.5, 0, 0]: beyond the fence" in mission("goto 0.5 0", 2).err


def test_list_status_and_logs(api, mission):
    assert mission("list").out == "no missions yet\n"
    api.fly(FAR)
    assert mission("list").out.splitlines()[2].split() == ["m1", "far", "flying", "0/1"]
    document = json.loads(mission("list -o json").out)
    assert (document["schemaVersion"], document["missions"][0]["id"]) == (1, "m1")
    assert mission("status").out.splitlines()[-1] == "next: the robot follows its mission"
    assert json.loads(mission("status m1 -o json").out)["events"][1]["event"] == "started"
    assert mission("logs").out == mission("logs m1").out != ""
    assert "no mission 'm9'" in mission("status m9", 5).err
    events = Api(api.url, lambda: read_token(api.token_file, "")).events()
    assert [next(events)["event"] for _ in range(2)] == ["starting", "started"]
    events.close()


def test_emergency_stop_and_acknowledgement(api, mission):
    api.fly(FAR)
    assert mission("estop").out.endswith("off\nmission m1 has failed\n")
    assert api.alarms
    api.until(lambda: api.get("/v1/state")["seen"]["guard"] == "ESTOP")
    for words, code in (("run two.yaml", 5), ("status", 0)):
        said = "".join(mission(words, code))
        assert "find the cause, then: cloudrc mission acknowledge" in said
    mission("acknowledge")
    api.until(lambda: api.get("/v1/state")["seen"]["guard"] == "GROUND")


def test_the_token_file_comes_from_flag_or_environment(api, folder, monkeypatch, call):
    def hold(code, flags=""):
        return call(f"mission hold --api {api.url} {flags}", code=code).err

    wrong, reader = folder / "wrong", api.token_file.parent / "reader"
    assert "asks for a token; name its file: --token-file FILE" in hold(5)
    wrong.write_text("not-the-operators-token\n")
    wrong.chmod(0o644)
    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", str(wrong))
    error = hold(5)
    assert "does not know this token" in error
    assert f"warning: {wrong} can be read by others: chmod 600 {wrong}\n" in error
    error = hold(5, f"--token-file {reader}")
    assert "may look, not command" in error
    assert "warning" not in error
    assert "no mission is under way" in hold(5, f"--token-file {api.token_file}")
    wrong.write_text("two words")
    error = hold(2)
    assert f"error: CLOUDRC_TOKEN_FILE={wrong}: a token is 16 to 512 visible" in error
    assert "two words" not in error


def test_old_values_of_the_robot_are_marked_as_old(monkeypatch, call):
    seen = {"position_m": [1.0, 2.0, 0.7], "rtt_s": 0.09, "guard": "TRACK", "cause": "fresh"}
    seen |= {"sensors": [], "age_s": 3.2, "guard_for_s": None, "next_step": "wait"}
    state = {"mission": None, "queue": ["m2", "m3"], "seen": seen, "cloud_age_s": 0.1}
    monkeypatch.setattr(Api, "get", lambda api, path: state)
    assert call("mission status --api unix:there").out.splitlines()[1:] == [
        "waiting: m2, m3",
        "no telemetry for 3.2 s; last message from cloud: 0.1 s ago",
        "last seen 3.2 s ago at (1.00, 2.00, 0.70) m, with the guard in TRACK: fresh",
        "next: wait",
    ]


def test_fly_waits_until_the_robots_of_its_fleet_begin_together(api, mission, monkeypatch):
    clock = Mock(time=lambda: 100.0)
    clock.sleep.side_effect = KeyboardInterrupt
    monkeypatch.setattr(command, "time", clock)
    mission("fly --mission two.yaml --at 112.5", 130)
    clock.sleep.assert_called_once_with(12.5)
    assert api.get("/v1/missions")["missions"] == []


@pytest.mark.parametrize("url", ["ftp://there", "http://", "http://there:99999", "unix:", "there"])
def test_an_address_of_the_api_is_judged_before_the_command(call, url):
    said = call(f"mission status --api {url}", code=2).err
    assert f"argument --api: '{url}' is not http://HOST:PORT[/PATH] or unix:PATH" in said
