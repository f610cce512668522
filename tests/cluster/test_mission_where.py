"""`cloudrc mission` selects the run on this machine or a release in the cluster."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.drivers import local
from tests.cluster.conftest import FakeApi

Printed = pytest.CaptureFixture[str]
IN_CLUSTER = "no missions in namespace 'demo'"


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture
def flies_here(tmp_path: Path) -> Iterator[None]:
    """A run on this machine whose API accepts connections and never answers."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(f"{tmp_path}/silent.sock")
        server.listen()
        with local.announced(tmp_path / "runs" / "latest", f"unix:{tmp_path}/silent.sock"):
            yield


@pytest.fixture
def was_killed(tmp_path: Path) -> None:
    """A killed run that has left its files."""
    with local.announced(tmp_path / "runs" / "latest", f"unix:{tmp_path}/silent.sock"):
        (file,) = local.places()[0].iterdir()
        left = file.read_text()
    file.write_text(left)
    file.chmod(0o600)


@pytest.fixture
def no_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cloudrc.cli.client.REQUEST_TIMEOUT", 0.05)


@pytest.mark.usefixtures("flies_here", "no_patience")
def test_the_local_run_is_the_default(running: FakeApi, capsys: Printed) -> None:
    assert main(["mission", "list"]) == 5
    assert "silent.sock" in capsys.readouterr().err
    assert running.seen == []


@pytest.mark.usefixtures("flies_here", "no_patience")
@pytest.mark.parametrize("flags", [["--release", "cloudrc"], ["-n", "demo"], ["--context", "here"]])
def test_a_flag_of_the_cluster_selects_the_cluster(
    running: FakeApi, capsys: Printed, flags: list[str]
) -> None:
    assert main(["mission", "list", *flags]) == 0
    assert IN_CLUSTER in capsys.readouterr().out


@pytest.mark.usefixtures("flies_here", "no_patience")
def test_the_plugin_of_kubectl_selects_the_cluster(
    running: FakeApi, capsys: Printed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["/usr/local/bin/kubectl-cloudrc", "mission", "list"])
    assert main() == 0
    assert IN_CLUSTER in capsys.readouterr().out


def test_a_killed_run_is_ignored(running: FakeApi, was_killed: None, capsys: Printed) -> None:
    assert main(["mission", "list"]) == 0
    assert IN_CLUSTER in capsys.readouterr().out


def test_a_killed_run_without_a_cluster_is_no_run(
    was_killed: None, capsys: Printed, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    nowhere = str(tmp_path / "none")
    monkeypatch.setattr("kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", nowhere)
    assert main(["mission", "status"]) == 3
    (line,) = capsys.readouterr().err.splitlines()
    assert "no run flies here" in line
    assert "KUBECONFIG" in line
