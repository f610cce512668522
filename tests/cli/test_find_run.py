"""How `cloudrc mission` and `cloudrc link set` find a run on this machine."""

import contextlib
import json
import socket
import sys
import threading

import pytest

from cloudrc.cli.client import Api
from cloudrc.cli.main import main
from cloudrc.drivers import local
from tests.teleop.conftest import running

ESTOP = ["mission", "estop"]
STOP = "emergency stop: sent, and repeated until the rotors have stopped"
SET = ["link", "set", "uplink.loss=0.1"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Work in a folder without a run."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "none"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return folder


@contextlib.contextmanager
def flying(folder):
    """Announce a run that flies in a folder; yield its API."""
    folder.mkdir(parents=True)
    with running(unix=True) as api, local.announced(folder, api.url):
        yield api


def test_an_emergency_stop_finds_the_run(tmp_path, elsewhere, capsys):
    """The only run is used; of several runs, even with ./runs/latest, --run names one."""
    with flying(tmp_path / "a") as a:
        assert main(["mission", "estop"]) == 0
        assert capsys.readouterr().err == f"cloudrc: using the run in {tmp_path / 'a'}\n"
        with flying(tmp_path / "b") as b:
            assert main(["mission", "estop"]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            for name in "ab":
                assert f"--run {tmp_path / name}" in line
            assert (len(a.alarms), len(b.alarms)) == (1, 0)
            assert main(["mission", "estop", "--run", str(tmp_path / "b")]) == 0
            with flying(elsewhere / "runs" / "latest") as here:
                assert main(["mission", "estop"]) == 2
                assert "--run runs/latest" in capsys.readouterr().err
                assert (len(a.alarms), len(b.alarms), len(here.alarms)) == (1, 1, 0)
    with flying(elsewhere / "runs" / "one"):
        (elsewhere / "runs" / "latest").rmdir()
        (elsewhere / "runs" / "latest").symlink_to("one")
        assert main(["mission", "estop"]) == 0
        assert capsys.readouterr() == (f"runs/one: {STOP}\n", "")


def test_no_command_steers_another_flight_after_yours_has_ended(tmp_path, elsewhere, capsys):
    def said(code, *words):
        assert main(list(words)) == code
        return capsys.readouterr().err

    latest = elsewhere / "runs" / "latest"
    latest.mkdir(parents=True)
    (latest / "relay.log").touch()
    for words in (["mission", "hold"], ["mission", "run", "pipes"], SET):
        assert "runs/latest has ended; name another flight: --release" in said(2, *words)
    assert "no cluster is configured" in said(3, "mission", "list"), "it may read in a cluster"
    assert "no cluster is configured" in said(3, "mission", "hold", "--release", "other")
    with flying(tmp_path / "a") as api:
        assert f"has ended; name another flight: --run {tmp_path}/a; " in said(2, *ESTOP)
        assert api.alarms == []
        assert said(0, "mission", "list") == f"cloudrc: using the run in {tmp_path / 'a'}\n"
        assert said(0, *ESTOP, "--run", str(tmp_path / "a")) == ""
        (latest / "relay.log").unlink()  # as after a run in virtual time, which nobody steers
        assert said(0, *ESTOP) == f"cloudrc: using the run in {tmp_path / 'a'}\n"
        assert len(api.alarms) == 2


def test_each_answer_names_the_run_and_what_the_robot_does(elsewhere, capsys):
    with flying(elsewhere / "runs" / "latest") as served:
        api, far = Api(served.url), {"name": "far", "waypoints": [{"position_m": [0.5, -2.0, 1.0]}]}
        api.post("/v1/missions", far)
        served.until(lambda: api.get("/v1/state")["mission"]["state"] == "flying")
        for words, does in (
            ("hold", "holding at ("),
            ("goto 0.5 -1 1.2", "flying to (0.5, -1, 1.2); mission m1 (far): held"),
            ("resume", "flying to waypoint 1 of 1; mission m1 (far): flying"),
            ("cancel", "holding at ("),
            ("acknowledge", "acknowledged: the next mission may fly"),
            ("run pipes", "mission m2: starting, waypoints: 7; the robot is set back to its spawn"),
        ):
            if words.startswith("run"):
                threading.Timer(0.5, lambda: api.post("/v1/missions/m2/cancel")).start()
            assert main(["mission", *words.split()]) in (0, 130)
            assert capsys.readouterr().out.startswith(f"runs/latest: {does}"), words
        for words in ("status", "status m1", "list"):
            assert main(["mission", *words.split()]) == 0
            assert capsys.readouterr().out.startswith("runs/latest: "), words
        assert main(["mission", "list", "-o", "json"]) == 0
        assert "missions" in json.loads(capsys.readouterr().out)
        for words, code in (("hold", 5), ("goto 0 0 99", 2)):
            assert main(["mission", *words.split()]) == code
            refused = capsys.readouterr().err
            assert refused.startswith("cloudrc: error: runs/latest: "), refused


def test_the_console_names_a_run_as_it_was_given(tmp_path, capsys):
    with flying(tmp_path / "a"), flying(tmp_path / "b"):
        assert main(["console", "runs/nope"]) == 2
        assert "error: runs/nope: no run flies there" in capsys.readouterr().err
        assert main(["console"]) == 2
        assert f"choose one: {tmp_path / 'a'} or {tmp_path / 'b'}" in capsys.readouterr().err


def test_no_request_goes_to_a_server_that_a_folder_names(elsewhere, capsys):
    (elsewhere / "runs" / "latest").mkdir(parents=True)
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        stranger.setblocking(False)
        url = f"http://127.0.0.1:{stranger.getsockname()[1]}"
        (elsewhere / "runs" / "latest" / "api.json").write_text(json.dumps({"url": url}))
        for words, code in (([], 3), (["--run", "runs/latest"], 2)):
            assert main(["mission", "estop", *words]) == code
            assert "flies" in capsys.readouterr().err
        with pytest.raises(BlockingIOError):
            stranger.accept()


def test_a_local_run_gets_no_token(tmp_path, monkeypatch):
    unread = str(tmp_path / "there is none")  # sending it would mean reading it
    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", unread)
    with flying(tmp_path / "out") as api:
        for more in ([], ["--run", str(tmp_path / "out")], ["--token-file", unread]):
            assert main(["mission", "estop", *more]) == 0
        assert len(api.alarms) == 3
        assert main(["mission", "estop", "--api", api.url]) == 2


def with_link(folder):
    """Make the folder of a run whose relay has just started, and announce it."""
    (folder / "link").mkdir(parents=True)
    return local.announced(folder)


def test_link_set_finds_the_only_run_and_ignores_a_killed_one(
    tmp_path, elsewhere, capsys, monkeypatch
):
    def said(code, *words):
        assert main([*SET, *words]) == code
        return capsys.readouterr().err

    here = elsewhere / "runs" / "latest"
    with with_link(tmp_path / "a"), local.announced(tmp_path / "without a link"):
        found = f"cloudrc: using the run in {tmp_path / 'a'}\ncloudrc: error: {tmp_path / 'a'}: "
        assert said(2).startswith(f"{found}no link is up there (yet); wait for the start")
        with with_link(tmp_path / "b"):
            several = said(2)
        for name in "ab":
            assert f"--run {tmp_path / name}" in several
    with with_link(here):
        assert "runs/latest: no link is up there (yet)" in said(2)
        monkeypatch.setattr(sys, "argv", ["/usr/local/bin/kubectl-cloudrc", *SET])
        assert main() == 3, "the plug-in of kubectl never uses a local run"
        assert "KUBECONFIG" in capsys.readouterr().err
    assert f"--run {here}: no run flies there" in said(2, "--run", str(here))
    monkeypatch.setenv("PATH", str(elsewhere))  # without kubectl
    assert "no run flies here (start one: cloudrc run; or name one: --run)" in said(3)
