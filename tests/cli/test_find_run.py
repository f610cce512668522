"""How `cloudrc mission` and `cloudrc link set` find a run on this machine."""

import contextlib
import json
import socket
import sys

import pytest

from cloudrc.cli.main import main
from cloudrc.drivers import local
from tests.teleop.conftest import running

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
    """./runs/latest comes first, then the only other run; of several others, --run names one."""
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
                assert main(["mission", "estop"]) == 0
                assert (len(a.alarms), len(b.alarms), len(here.alarms)) == (1, 1, 1)
                assert capsys.readouterr().err == ""


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
