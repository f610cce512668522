"""`cloudrc mission` against the real API: its output and exit codes."""

import json
import re
import threading

import pytest
import yaml

from cloudrc.cli import mission as command
from cloudrc.cli.client import Api, token_reader
from cloudrc.cli.main import main
from cloudrc.cli.output import escape
from cloudrc.errors import BadInputError
from cloudrc.teleop.store import Order
from tests.teleop.conftest import PLAN, A, B, running

FILE = """
description: Two points
start: here
waypoints:
  - {position_m: [1.0, 0.0, 1.0], dwell_s: 0.0}
  - {position_m: [2.0, 0.0, 1.0], dwell_s: 0.0}
"""


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
    def run(*words):
        verb, *rest = words
        return main(["mission", verb, "--api", api.url, *rest])

    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", str(api.token_file))

    return run


def pilot(api, *points):
    """Move the robot to each point once the mission has reached the previous point."""

    def fly():
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


@pytest.mark.parametrize(
    ("flags", "word"), [([], "is still flying"), (["--queue"], "is waiting or flying")]
)
def test_an_interrupted_run_names_the_command_that_cancels_it(flags, word, monkeypatch, capsys):
    monkeypatch.setattr(command.MissionFollower, "follow", _interrupted)
    with running(unix=True) as api:
        if flags:
            api.post_local("/v1/missions", {"waypoints": [{"position_m": [0.5, -1.0, 1.0]}]})
        assert main(["mission", "run", "two.yaml", "--api", api.url, *flags]) == 130
        mine = "m2" if flags else "m1"
        advice = capsys.readouterr().err
        assert advice == f"mission {mine} {word}; cancel it: cloudrc mission cancel {mine}\n"
        assert main([*advice.split("cloudrc ")[1].split(), "--api", api.url]) == 0
        missions = Api(api.url).get("/v1/missions")["missions"]
        ended = {each["id"] for each in missions if each["state"] == "cancelled"}
        assert ended == {mine}, "no other mission"


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


@pytest.mark.parametrize(
    "url", ["here", "unix:", "ftp://h:1", "http://me@h:1", "http://", "http://[::1", "http://h:x"]
)
def test_an_invalid_url_of_the_api_is_an_error(url, capsys):
    assert main(["mission", "status", "--api", url]) == 2
    said = f"cloudrc: error: --api {url}: give http://HOST:PORT or unix:PATH\n"
    assert capsys.readouterr().err == said


def test_the_operators_verbs(api, mission, capsys):
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


def test_list_status_and_logs(api, mission, capsys):
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


def test_emergency_stop_and_acknowledgement(api, mission, capsys):
    api.post("/v1/missions", {"waypoints": [{"position_m": B}]})
    assert mission("estop") == 0
    assert capsys.readouterr().out.endswith("stopped\nmission m1 has failed\n")
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


def test_the_token_file_comes_from_flag_or_environment(api, folder, monkeypatch, capsys):
    hold = ["mission", "hold", "--api", api.url]
    assert main(hold) == 5
    assert "asks for a token; name its file: --token-file FILE" in capsys.readouterr().err
    (folder / "wrong").write_text("not-the-operators-token\n")
    (folder / "wrong").chmod(0o644)
    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", str(folder / "wrong"))
    assert main(hold) == 5
    error = capsys.readouterr().err
    assert "does not know this token" in error
    path = folder / "wrong"
    assert f"warning: {path} can be read by others: chmod 600 {path}\n" in error
    assert main([*hold, "--token-file", str(api.folder.name) + "/reader"]) == 5
    error = capsys.readouterr().err
    assert "may look, not command" in error
    assert "warning" not in error
    assert main([*hold, "--token-file", str(api.token_file)]) == 5
    assert "no mission is under way" in capsys.readouterr().err
    (folder / "wrong").write_text("two words")
    assert main(hold) == 2
    assert "holds no token" in capsys.readouterr().err
    assert main([*hold, "--token-file", "none"]) == 2
    error = capsys.readouterr().err
    assert "--token-file none: No such file or directory" in error
    assert "two words" not in error


def test_without_run_and_cluster_both_remedies_are_named(capsys):
    assert main(["mission", "status"]) == 3
    error = capsys.readouterr().err
    assert "no run flies here (start one: cloudrc run; or name one: --run, --api)" in error
    assert "KUBECONFIG" in error
    assert error.count("\n") == 1


def test_a_missing_verb_or_point_is_refused(capsys):
    assert main(["mission"]) == 2
    assert main(["mission", "goto", "1", "2"]) == 2
    assert main(["mission", "holt"]) == 2
    assert "hold" in capsys.readouterr().err
    assert main(["mission", "goto", "1", "2", "up"]) == 2
    assert "'up' is not a number of metres" in capsys.readouterr().err


def test_events_can_be_followed(api):
    api.post("/v1/missions", {"waypoints": [{"position_m": B}]})
    stream = Api(api.url, token_reader(api.token_file)).events()
    assert [next(stream)["event"] for _ in range(2)] == ["starting", "started"]
    stream.close()


SEEN = {"position_m": [1.0, 2.0, 0.7], "rtt_s": 0.09, "guard": "TRACK", "cause": "fresh command"}
OLD = {**SEEN, "age_s": 3.2, "guard_for_s": None, "next_step": "wait"}
NEW = {**SEEN, "age_s": 0.02, "guard_for_s": 4.5, "next_step": "the robot flies"}


@pytest.mark.parametrize(
    ("seen", "cloud_age", "lines"),
    [
        (OLD, 0.1, ["robot not heard for 3.2 s (guard TRACK then); cloud heard 0.1 s ago",
                    "last seen at (1.00, 2.00, 0.70) m: fresh command", "next: wait"]),
        (NEW, 0.02, ["robot at (1.00, 2.00, 0.70) m, seen 0.02 s ago, round trip 90 ms",
                     "guard TRACK for 4.5 s: fresh command", "next: the robot flies"]),
        (None, None, ["no telemetry from the robot yet; is the link up? cloud heard never"]),
    ],
    ids=["not heard", "heard", "never heard"],
)  # fmt: skip
def test_old_values_of_the_robot_are_marked_as_old(seen, cloud_age, lines, monkeypatch, capsys):
    state = {"mission": None, "queue": ["m2", "m3"], "seen": seen, "cloud_age_s": cloud_age}
    monkeypatch.setattr(Api, "get", lambda api, path: state)
    assert main(["mission", "status", "--api", "unix:there"]) == 0
    assert capsys.readouterr().out.splitlines()[1:] == ["waiting: m2, m3", *lines]


NAME = "far\x1b[2J\nm9  forged\r\x9b31m\x7f\u202e"
SHOWN = r"far\x1b[2J\nm9  forged\r\x9b31m\x7f\u202e"


def harmless(said):
    """Check that a text shows the name without control characters."""
    return SHOWN in said and all(c.isprintable() or c == "\n" for c in said)


@pytest.fixture
def forged():
    """Yield an API with a stored mission whose name contains control characters."""
    with running(unix=True) as one:
        made = one.bridge.submit(lambda service, now_ns: service.create(Order(PLAN, NAME), now_ns))
        made.result(10.0)
        yield one


def test_a_missions_name_is_shown_without_effect(forged, capsys):
    for words in ("list", "status", "status m1", "hold", "cancel"):
        main(["mission", *words.split(), "--api", forged.url])
        said = capsys.readouterr().out
        assert harmless(said)
        assert [line for line in said.splitlines() if line.startswith("m9")] == []
    for form, read in (("json", json.loads), ("yaml", yaml.safe_load)):
        assert main(["mission", "list", "--api", forged.url, "-o", form]) == 0
        said = capsys.readouterr().out
        assert [c for c in said if (c != "\n" and ord(c) < 32) or 127 <= ord(c) < 160] == []
        assert read(said)["missions"][0]["name"] == NAME
    with pytest.raises(BadInputError) as refused:
        forged.post_local("/v1/missions", {NAME: 2, "waypoints": [{"position_m": [99.0, 0, 1]}]})
    assert harmless(str(refused.value))


def test_events_verdicts_and_pods_are_shown_without_effect(folder, monkeypatch, capsys):
    log = folder / "termination-log"
    log.touch()
    monkeypatch.setattr(command, "TERMINATION_LOG", log)
    event = {"id": 1, "mission": NAME, "time_s": 1.0, "text": NAME}
    failure = {"code": NAME, "text": NAME}
    verdict = {"outcome": NAME, "exit_code": 1, "failures": [failure]}
    posted = {"id": NAME, "state": NAME, "waypoints": 1}
    answer = {"id": NAME, "events": [event], "events_left_out": 3, "verdict": verdict}
    monkeypatch.setattr(Api, "post", lambda api, path, body=None: posted)
    monkeypatch.setattr(Api, "get", lambda api, path: answer)
    assert main(["mission", "fly", "--mission", "pipes", "--api", "unix:there"]) == 1
    assert main(["mission", "run", "pipes", "--api", "unix:there"]) == 1
    assert main(["mission", "logs", "m1", "--api", "unix:there"]) == 0
    out = capsys.readouterr().out
    assert "3 earlier events are not shown" in out
    for said, lines in ((out, 8), (log.read_text(), 1)):
        assert (len(said.splitlines()), harmless(said)) == (lines, True)


@pytest.mark.parametrize("verb", ["status", "cancel", "logs"])
def test_an_invalid_id_is_no_mission(verb, forged, capsys):
    for given in ("\x1b[31m", "m1?x", "m 1", "..", "a/b", "tür", "\udcff", "%", "m1#"):
        assert main(["mission", verb, given, "--api", forged.url]) == 5
        (line,) = capsys.readouterr().err.splitlines()
        assert line.isprintable()
        shown = {"a/b": "Not Found", "\udcff": "no mission '\ufffd'"}
        assert shown.get(given, f"no mission '{escape(given)}'") in line
