"""Which cluster and release is meant, and how it is said that there is none."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from cloudrc.cluster.client import Release, connect
from cloudrc.cluster.pods import find_pod, list_pods
from cloudrc.cluster.tools import ClusterError
from cloudrc.errors import MissingPrerequisiteError
from tests.cluster.conftest import FakeApi, kubeconfig, pod

ROOT = Path(__file__).resolve().parents[2]


def test_the_current_context_gives_the_namespace(api: FakeApi) -> None:
    assert connect().namespace == "demo"


def test_flags_win(api: FakeApi) -> None:
    release = connect("elsewhere", "mine", "paper")
    assert release == Release("elsewhere", "mine", "paper")
    assert release.flags == ["--context=elsewhere", "--namespace=mine"]
    assert release.helm_flags == ["--kube-context=elsewhere", "--namespace=mine"]


def test_a_context_without_a_namespace_means_default(api: FakeApi) -> None:
    assert connect("elsewhere").namespace == "default"


def test_an_unknown_context_is_named_with_those_there_are(api: FakeApi) -> None:
    with pytest.raises(MissingPrerequisiteError, match=r"no context 'x'.*elsewhere, here"):
        connect("x")


@pytest.mark.parametrize("text", [None, "", "contexts: 3", ":\n  - x: ["])
def test_without_a_kubeconfig_one_sentence_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | None
) -> None:
    path = tmp_path / "config"
    if text is not None:
        path.write_text(text)
    monkeypatch.setattr("kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", str(path))
    with pytest.raises(MissingPrerequisiteError, match="kind create cluster") as caught:
        connect()
    assert caught.value.exit_code == 3
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        (None, "No such file or directory: .*login-to-nowhere"),
        ("echo no token >&2; exit 7", "returned 7"),
        ("echo '{}'", "exec"),
    ],
    ids=["missing", "failing", "giving nothing"],
)
def test_a_failing_login_program_is_the_only_thing_reported(
    tmp_path: Path, script: str | None, words: str
) -> None:
    """In a process of its own: here pytest listens to what is logged."""
    program = tmp_path / "login-to-nowhere"
    if script is not None:
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
    config = yaml.safe_load(kubeconfig("http://127.0.0.1:9"))
    version = "client.authentication.k8s.io/v1"
    login = {"apiVersion": version, "command": str(program), "interactiveMode": "Never"}
    config["users"][0]["user"] = {"exec": login}
    (tmp_path / "config").write_text(yaml.safe_dump(config))
    done = subprocess.run(
        [sys.executable, "-m", "cloudrc", "mission", "list", "-n", "demo"],
        env={**os.environ, "KUBECONFIG": str(tmp_path / "config"), "PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 3, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("cloudrc: error: cannot log in to the cluster in namespace 'demo'")
    assert re.search(words, line)


def test_a_cluster_that_does_not_answer_is_said_in_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "config"
    path.write_text(kubeconfig("http://127.0.0.1:9"))  # discard: nobody listens
    monkeypatch.setattr("kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", str(path))
    with pytest.raises(ClusterError, match=r"does not answer.*refused.*kubectl") as caught:
        list_pods(connect(), "cloud")
    assert caught.value.exit_code == 5
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("code", "said", "expected"),
    [
        (401, "Unauthorized", "log in"),
        (403, "pods is forbidden: User me cannot list", "kubectl auth can-i list pods"),
        (500, "etcd\nis gone", "etcd is gone"),
    ],
)
def test_a_refusal_names_cause_and_next_command(
    api: FakeApi, release: Release, code: int, said: str, expected: str
) -> None:
    api.refuse["GET", "pods"] = code, said
    with pytest.raises(ClusterError, match=expected) as caught:
        list_pods(release, "cloud")
    assert "\n" not in str(caught.value)


def test_no_release_is_said_with_the_way_to_one(api: FakeApi, release: Release) -> None:
    with pytest.raises(ClusterError, match=r"no release 'cloudrc' in namespace 'demo'; install it"):
        find_pod(release, "cloud")


def test_the_newest_pod_counts_and_one_that_ends_does_not(api: FakeApi, release: Release) -> None:
    for name in ("old", "new", "ending"):
        api.put("pods", "demo", pod(name, "cloud"))
    api.get("pods", "ending")["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:59Z"
    assert find_pod(release, "cloud").metadata.name == "new"


def test_pods_of_another_release_are_not_seen(api: FakeApi, release: Release) -> None:
    other = pod("other", "cloud", labels={"app.kubernetes.io/instance": "other"})
    api.put("pods", "demo", other)
    assert list_pods(release, "cloud") == []
