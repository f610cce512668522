"""Calls of kubectl and helm: results, time limits, and errors in one line."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cloudrc.cluster import pods, tools
from cloudrc.cluster.client import Release
from cloudrc.cluster.release import install
from cloudrc.cluster.tools import ClusterError, ExpiredError, chart_folder
from cloudrc.errors import MissingPrerequisiteError
from tests.cluster.conftest import FakeApi, pod

Pretend = Callable[[str, str], Path]


@pytest.mark.parametrize("name", ["helm", "kubectl"])
def test_a_missing_program_is_named_with_its_page(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(
        MissingPrerequisiteError, match=f"{name} is not installed; install it: http"
    ):
        tools.run(name, ["version"], timeout=1.0)


def test_a_hanging_program_is_ended(pretend: Pretend) -> None:
    pretend("helm", "exec sleep 60")
    with pytest.raises(ExpiredError, match=r"'helm list' took more than 0\.1 s"):
        tools.run("helm", ["list", "--all"], timeout=0.1)


@pytest.mark.parametrize(
    ("stderr", "expected"),
    [
        ("W1120 06:00 warnings.go:70] beware\nError: UPGRADE FAILED: no\n  - way", "no - way"),
        ("error: context is missing", "'helm upgrade' failed: context is missing"),
        ("", "no error message"),
    ],
)
def test_the_error_message_of_a_program_becomes_one_line(
    pretend: Pretend, stderr: str, expected: str
) -> None:
    pretend("helm", f"cat >&2 <<'END'\n{stderr}\nEND\nexit 1")
    with pytest.raises(ClusterError, match=expected) as caught:
        tools.run("helm", ["upgrade"], timeout=5.0)
    assert caught.value.exit_code == 5
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("said", "hint"),
    [
        ("Kubernetes cluster unreachable: Get https://10.0.0.1: refused", "kubectl cluster-info"),
        (
            "chart requires kubeVersion: >=1.29.0-0 which is incompatible with Kubernetes v1.28.3",
            "kind create cluster",
        ),
        ("secrets is forbidden: User me cannot list", "kubectl auth can-i"),
        ("values don't meet the specifications of the schema(s)\n- link: mdoe", "helm show values"),
    ],
)
def test_a_refusal_of_helm_has_a_hint(
    release: Release, pretend: Pretend, said: str, hint: str
) -> None:
    pretend("helm", f"cat >&2 <<'END'\nError: {said}\nEND\nexit 1")
    with pytest.raises(ClusterError, match=hint) as caught:
        install(release, Path("the-chart"), {})
    assert caught.value.exit_code == 5
    assert "\n" not in str(caught.value)
    assert said.split()[0] in str(caught.value)


def test_install_passes_values_to_helm_and_waits_for_pods(
    running: FakeApi, release: Release, pretend: Pretend, tmp_path: Path
) -> None:
    pretend("helm", f'cat > {tmp_path}/values; echo "$@" > {tmp_path}/line')
    install(release, Path("the-chart"), {"experiment": {"seed": 7}}, extra=["--set=a=b"])
    assert json.loads((tmp_path / "values").read_text()) == {"experiment": {"seed": 7}}
    line = (tmp_path / "line").read_text()
    assert line.startswith("upgrade --install cloudrc the-chart --namespace=demo")
    assert "--create-namespace" in line
    assert "--set=a=b" in line


def test_a_port_is_forwarded_while_the_block_runs(
    release: Release, pretend: Pretend, tmp_path: Path
) -> None:
    pretend(
        "kubectl",
        f"echo $$ > {tmp_path}/pid; echo $@ > {tmp_path}/line\n"
        "echo 'Forwarding from 127.0.0.1:40001 -> 9100'\n"
        "echo 'Forwarding from 127.0.0.1:40002 -> 9102'\nexec sleep 60",
    )
    with pods.forwarded(release, "world-1", [9100, 9102]) as ports:
        assert ports == {9100: 40001, 9102: 40002}
        pid = int((tmp_path / "pid").read_text())
        os.kill(pid, 0)
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    assert "--namespace=demo port-forward pod/world-1" in (tmp_path / "line").read_text()


def test_a_failed_port_forward_is_reported(release: Release, pretend: Pretend) -> None:
    pretend("kubectl", "echo 'error: unable to forward port: pod is gone' >&2; exit 1")
    with (
        pytest.raises(ClusterError, match=r"cannot forward ports of pod 'cloud-1'.*pod is gone"),
        pods.forwarded(release, "cloud-1", [8080]),
    ):
        pytest.fail("there is no way")


def test_a_port_forward_has_a_timeout(
    release: Release, pretend: Pretend, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pods, "START_LIMIT", 0.1)
    pretend("kubectl", "exec sleep 60")
    began = time.monotonic()
    with (
        pytest.raises(ExpiredError, match="has not started within"),
        pods.forwarded(release, "cloud-1", [8080]),
    ):
        pytest.fail("there is no way")
    assert time.monotonic() - began < 2.0


def test_an_error_inside_the_block_passes_unchanged(release: Release, pretend: Pretend) -> None:
    pretend("kubectl", "echo 'Forwarding from 127.0.0.1:40001 -> 8080'; exec sleep 60")
    with pytest.raises(KeyError), pods.forwarded(release, "cloud-1", [8080]):
        raise KeyError


def test_a_recording_is_copied_unchanged(
    api: FakeApi, release: Release, pretend: Pretend, tmp_path: Path
) -> None:
    api.put("pods", "demo", pod("world-1", "world"))
    source, target = tmp_path / "source", tmp_path / "world.mcap"
    source.write_bytes(bytes(range(256)) * 100)
    pretend("kubectl", f"echo $@ > {tmp_path}/line; cat {source}")
    pods.fetch_recording(release, "world", target)
    assert target.read_bytes() == source.read_bytes()
    line = (tmp_path / "line").read_text()
    assert "exec world-1 --container=world -- cat /var/lib/cloudrc/world.mcap" in line


def test_the_chart_is_found_in_the_repository_and_in_a_wheel(tmp_path: Path) -> None:
    package = tmp_path / "cloudrc"
    with pytest.raises(MissingPrerequisiteError, match="install cloudrc again"):
        chart_folder(package)
    beside = tmp_path / "charts" / "cloudrc"
    inside = package / "_chart"
    for folder in (beside, inside):
        folder.mkdir(parents=True)
        (folder / "Chart.yaml").touch()
        assert chart_folder(package) == folder
