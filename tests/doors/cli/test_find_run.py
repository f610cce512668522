# SPDX-License-Identifier: Apache-2.0

"""How `cloudrc mission` and `cloudrc link set` find a run on this machine."""

import contextlib
import json
import socket
import sys
import threading

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.doors.cli.where import need_run_here
from cloudrc.results import under_way
from cloudrc.teleop.client import Api
from tests.conftest import wait_until
from tests.teleop.conftest import FAR, running

SET = "link set uplink.loss=0.1"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Work in a folder without a run."""
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    monkeypatch.chdir(folder)
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "none"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return folder


@pytest.fixture
def said(call):
    """Return a function that runs a command and returns what it prints on stderr."""
    return lambda code, line, *more: call(line, *more, code=code).err


@contextlib.contextmanager
def flying(folder):
    """Announce a run that flies in a folder; yield its API."""
    folder.mkdir(parents=True)
    with running(unix=True) as api, under_way.announced(folder, api.url):
        yield api


def test_the_only_run_is_used_and_of_several_one_is_named(tmp_path, elsewhere, said):
    with flying(tmp_path / "a") as a:
        assert said(0, "mission estop") == f"cloudrc: using the run in {tmp_path / 'a'}\n"
        with flying(elsewhere / "runs" / "latest") as here:
            error = said(2, "mission estop")
            assert f"name one: --run {tmp_path / 'a'} or --run runs/latest" in error
            assert (len(a.alarms), len(here.alarms)) == (1, 0)
            assert said(0, "mission estop --run", tmp_path / "a") == ""
    with flying(elsewhere / "runs" / "one"):
        (elsewhere / "runs" / "latest").rmdir()
        (elsewhere / "runs" / "latest").symlink_to("one")
        assert said(0, "mission estop") == ""


def test_the_bridge_never_takes_a_flight_of_another_folder_unless_it_is_named(tmp_path, elsewhere):
    def found(run=None):
        return need_run_here(run, elsewhere=False).folder.resolve()

    other, here = tmp_path / "a", elsewhere / "runs" / "one"
    with flying(other):
        with pytest.raises(BadInputError, match=f"name it: --run {other}$"):
            found()
        assert found(other) == other
        with flying(here):
            assert found() == here


def test_no_command_steers_another_flight_after_yours_has_ended(tmp_path, elsewhere, said):
    latest = elsewhere / "runs" / "latest"
    latest.mkdir(parents=True)
    (latest / "uplink.log").touch()
    for words in ("mission hold", "mission run pipes", SET):
        assert "name another flight: --release" in said(2, words)
    assert "no cluster is configured" in said(3, "mission list"), "it may read in a cluster"
    assert "no cluster is configured" in said(3, "mission hold --release other")
    with flying(tmp_path / "a") as api:
        using = f"cloudrc: using the run in {tmp_path / 'a'}\n"
        assert f"name another flight: --run {tmp_path}/a; " in said(2, "mission estop")
        assert api.alarms == []
        assert said(0, "mission list") == using
        (latest / "uplink.log").unlink()  # as after a run in virtual time, which nobody steers
        assert said(0, "mission estop") == using


def test_each_answer_names_the_run_and_what_the_robot_does(elsewhere, call, as_json):
    with flying(elsewhere / "runs" / "latest") as served:
        api = Api(served.url)
        api.post("/v1/missions", FAR)
        served.until(lambda: api.get("/v1/state")["mission"]["state"] == "flying")

        def cancel_second():
            wait_until(lambda: len(api.get("/v1/missions")["missions"]) == 2)
            api.post("/v1/missions/m2/cancel")

        for words, does in (
            ("hold", "holding at ("),
            ("goto 0.5 -1 1.2", "on the way to (0.5, -1, 1.2); mission m1 (far): held"),
            ("resume", "mission m1 continues; mission m1 (far): flying"),
            ("cancel", "holding at ("),
            ("acknowledge", "acknowledged: the next mission may fly"),
            ("run pipes", "mission m2: starting, waypoints: 7; the robot is set back to its spawn"),
        ):
            if words.startswith("run"):
                threading.Thread(target=cancel_second).start()
            out = call(f"mission {words}", code=130 if words.startswith("run") else 0).out
            assert out.startswith(f"runs/latest: {does}"), words
        for words in ("status", "status m1", "list"):
            assert call(f"mission {words}").out.startswith("runs/latest: "), words
        assert "missions" in as_json("mission list")
        for words, code, why in (("hold", 5, ""), ("goto 0 0 99", 2, "beyond the fence")):
            error = call(f"mission {words}", code=code).err
            assert error.startswith("cloudrc: error: runs/latest: "), error
            assert why in error


def test_no_request_goes_to_a_server_that_a_folder_names(elsewhere, said):
    (elsewhere / "runs" / "latest").mkdir(parents=True)
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        stranger.setblocking(False)
        url = f"http://127.0.0.1:{stranger.getsockname()[1]}"
        (elsewhere / "runs" / "latest" / "api.json").write_text(json.dumps({"url": url}))
        assert "no run flies here" in said(3, "mission estop")
        assert "flies there" in said(2, "mission estop --run runs/latest")
        with pytest.raises(BlockingIOError):
            stranger.accept()


def test_a_local_run_gets_no_token(tmp_path, monkeypatch, call):
    unread = str(tmp_path / "there is none")  # sending it would mean reading it
    monkeypatch.setenv("CLOUDRC_TOKEN_FILE", unread)
    with flying(tmp_path / "out") as api:
        for more in ([], ["--run", tmp_path / "out"], ["--token-file", unread]):
            call("mission estop", *more)
        assert len(api.alarms) == 3
        call("mission estop --api", api.url, code=2)


def test_link_set_finds_the_only_run(elsewhere, said, monkeypatch):
    here = elsewhere / "runs" / "latest"
    (here / "link").mkdir(parents=True)
    with under_way.announced(here, ""):
        assert "runs/latest: no link is up there:" in said(2, SET)
        monkeypatch.setattr(sys, "argv", ["/usr/local/bin/kubectl-cloudrc"])
        error = said(3, SET)
        assert "KUBECONFIG" in error, "the plug-in of kubectl never uses a local run"
    assert f"{here}: no run flies there" in said(2, SET, "--run", here)
    monkeypatch.setenv("PATH", str(elsewhere))  # without kubectl
    assert "no run flies here; start one: cloudrc up; and " in said(3, SET)
