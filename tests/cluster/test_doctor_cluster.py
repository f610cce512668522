"""`cloudrc doctor --mode cluster` says "can run" if and only if `cloudrc run` can."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from cloudrc.cli import doctor as checks
from cloudrc.cli import extras, run
from cloudrc.cli.main import main
from cloudrc.cluster.client import OLDEST
from tests.cluster.conftest import FakeApi, kubeconfig

Printed = pytest.CaptureFixture[str]
CHART = Path(__file__).resolve().parents[2] / "charts" / "cloudrc" / "Chart.yaml"
LINE = ["doctor", "--mode", "cluster", "-o", "json"]


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip slow checks that have nothing to do with a cluster."""
    for name in ("mujoco_steps", "udp_loopback", "timer"):
        monkeypatch.setattr(checks, name, lambda name=name: checks.Check(name, "ok", ""))


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Make only the given programs available."""

    def install(*names: str) -> None:
        found = {name: f"/nowhere/{name}" for name in names}
        monkeypatch.setattr(shutil, "which", found.get)

    return install


def doctor(capsys: Printed, code: int, *more: str) -> dict[str, dict[str, Any]]:
    assert main([*LINE, *more]) == code
    report = json.loads(capsys.readouterr().out)
    assert report["ready"] is (code == 0)
    return {check["name"]: check for check in report["checks"]}


def test_a_cluster_elsewhere_needs_neither_docker_nor_kind(
    api: FakeApi, installed: Callable[..., None], capsys: Printed
) -> None:
    installed("helm", "kubectl")
    found = doctor(capsys, 0)
    assert found["cluster"]["found"] == "Kubernetes 1.33 answers"
    for name in ("docker", "kind"):
        assert found[name]["state"] == "warn"
        assert "to make a cluster here" in found[name]["fix"]


@pytest.mark.parametrize("program", ["helm", "kubectl"])
def test_a_missing_program_blocks_the_mode(
    api: FakeApi, installed: Callable[..., None], capsys: Printed, program: str
) -> None:
    installed(*{"helm", "kubectl"} - {program})
    assert doctor(capsys, 3)[program]["state"] == "missing"


def test_docker_without_a_daemon_is_not_ok(
    api: FakeApi, pretend: Callable[[str, str], Path], capsys: Printed
) -> None:
    for name in ("helm", "kubectl", "kind"):
        pretend(name, "true")
    pretend("docker", "echo 'Cannot connect to the Docker daemon' >&2; exit 1")
    found = doctor(capsys, 0)
    assert found["docker"]["state"] == "warn"
    assert "daemon does not answer" in found["docker"]["found"]
    pretend("docker", "echo 28.0.0")
    assert doctor(capsys, 0)["docker"]["state"] == "ok"


def test_a_missing_kubeconfig_blocks_the_mode(
    tmp_path: Path,
    installed: Callable[..., None],
    capsys: Printed,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed("helm", "kubectl")
    nowhere = str(tmp_path / "none")
    monkeypatch.setattr("kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", nowhere)
    found = doctor(capsys, 3)
    assert found["kubeconfig"]["state"] == "missing"
    assert "kind create cluster" in found["kubeconfig"]["fix"]
    assert "cluster" not in found


def test_a_silent_cluster_blocks_the_mode(
    tmp_path: Path,
    installed: Callable[..., None],
    capsys: Printed,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed("helm", "kubectl")
    path = tmp_path / "config"
    path.write_text(kubeconfig("http://127.0.0.1:9"))
    monkeypatch.setattr("kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", str(path))
    cluster = doctor(capsys, 3)["cluster"]
    assert "does not answer" in cluster["found"]
    assert "kubectl cluster-info" in cluster["fix"]


@pytest.mark.parametrize(
    ("minor", "code"), [("28", 3), ("28+", 3), ("29", 0), ("30+", 0), ("100", 0)]
)
def test_a_cluster_that_is_too_old_is_reported(
    api: FakeApi, installed: Callable[..., None], capsys: Printed, minor: str, code: int
) -> None:
    installed("helm", "kubectl")
    api.version["minor"] = minor
    cluster = doctor(capsys, code)["cluster"]
    assert cluster["state"] == ("missing" if code else "ok")
    assert not code or "needs 1.29" in cluster["fix"]


def test_the_context_can_be_selected(
    api: FakeApi, installed: Callable[..., None], capsys: Printed
) -> None:
    installed("helm", "kubectl")
    assert "elsewhere" in doctor(capsys, 0, "--context", "elsewhere")["kubeconfig"]["found"]
    assert doctor(capsys, 3, "--context", "x")["kubeconfig"]["state"] == "missing"


@pytest.mark.parametrize("mode", run.MODES)
def test_a_mode_is_blocked_by_the_extras_that_its_run_needs(mode: str) -> None:
    blocking = {extra for extra in extras.EXTRAS if mode in checks.packages(extra).modes}
    assert blocking == set(run.EXTRAS[mode])


def test_other_modes_do_not_contact_the_cluster(api: FakeApi) -> None:
    names = [check.name for check in checks.all_checks("local")]
    assert "cluster" not in names
    assert "kubeconfig" not in names


def test_the_oldest_version_equals_that_of_the_chart() -> None:
    wanted = yaml.safe_load(CHART.read_text())["kubeVersion"]
    found = re.match(r">=(\d+)\.(\d+)\.0-0 ", wanted)
    assert found is not None
    assert tuple(map(int, found.groups())) == OLDEST
