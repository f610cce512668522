"""`cloudrc doctor --mode cluster` says "can run" if and only if `cloudrc run` can."""

import json
import shutil
from pathlib import Path

import pytest
import yaml

from cloudrc.cli import doctor as checks
from cloudrc.cli.main import main
from cloudrc.cluster.client import OLDEST
from tests.cluster.conftest import CONFIG_PLACE, kubeconfig

CHART = Path(__file__).resolve().parents[2] / "charts" / "cloudrc" / "Chart.yaml"


@pytest.fixture(autouse=True)
def programs(monkeypatch):
    """Make only these programs available; skip a slow check that is not about a cluster."""
    monkeypatch.setattr(checks, "mujoco_steps", lambda: checks.Check("physics", "ok", ""))
    found = {"helm", "kubectl"}
    monkeypatch.setattr(shutil, "which", lambda name: f"/nowhere/{name}" if name in found else None)
    return found


def doctor(capsys, code, *more):
    assert main(["doctor", "--mode", "cluster", "-o", "json", *more]) == code
    report = json.loads(capsys.readouterr().out)
    assert report["ready"] is (code == 0)
    return {check["name"]: check for check in report["checks"]}


def test_a_cluster_elsewhere_does_not_need_kind(api, programs, capsys):
    found = doctor(capsys, 0)
    assert found["cluster"]["found"] == "Kubernetes 1.33 answers"
    assert found["kind"]["state"] == "warn"
    assert "to make a cluster here" in found["kind"]["fix"]
    assert doctor(capsys, 3, "--context", "x")["kubeconfig"]["state"] == "missing"
    programs.remove("helm")
    assert doctor(capsys, 3)["helm"]["state"] == "missing"


def test_a_cluster_that_cannot_be_reached_blocks_the_mode(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(CONFIG_PLACE, str(tmp_path / "config"))
    (tmp_path / "config").touch()
    assert "no cluster is configured" in doctor(capsys, 3)["kubeconfig"]["found"]
    (tmp_path / "config").write_text(kubeconfig("http://127.0.0.1:9"))
    check = doctor(capsys, 3)["cluster"]
    assert "does not answer" in check["found"]
    assert "kubectl cluster-info" in check["fix"]


@pytest.mark.parametrize(("minor", "code"), [("28+", 3), ("29", 0), ("100", 0)])
def test_a_cluster_that_is_too_old_is_reported(api, capsys, minor, code):
    api.version["minor"] = minor
    cluster = doctor(capsys, code)["cluster"]
    assert cluster["state"] == ("missing" if code else "ok")
    assert not code or "needs 1.29" in cluster["fix"]
    wanted = yaml.safe_load(CHART.read_text())["kubeVersion"]
    assert wanted.startswith(">={}.{}.0-0 ".format(*OLDEST))
