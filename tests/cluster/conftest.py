"""A fake API server, a kubeconfig that leads to it, and programs that only pretend."""

from __future__ import annotations

import base64
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fake_api import FakeApi, deployment, kubeconfig, pod
from link_pods import Cluster, pretended

from cloudrc.cluster import jobs, tools
from cloudrc.cluster import release as deploy
from cloudrc.cluster.client import Release, connect

TOKEN = "operator-token-of-the-release"


@pytest.fixture
def api(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeApi]:
    server = FakeApi()
    path = tmp_path / "kubeconfig"
    path.write_text(kubeconfig(server.url))
    monkeypatch.setattr("kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", str(path))
    monkeypatch.setattr(jobs, "LOOK_PERIOD", 0.01)
    monkeypatch.setattr(tools, "OUTAGE_PERIOD", 0.01)
    monkeypatch.setattr(deploy, "LOOK_PERIOD", 0.01)
    monkeypatch.setattr(deploy, "PATIENCE", 0.0)
    yield server
    server.close()


@pytest.fixture
def release(api: FakeApi) -> Release:
    return connect()


@pytest.fixture
def running(api: FakeApi, release: Release) -> FakeApi:
    """The fake with a release that is ready to fly."""
    for component in ("world", "cloud"):
        api.put("deployments", "demo", deployment(component))
        api.put("pods", "demo", pod(f"{component}-1", component))
    service = {
        "metadata": {"name": "cloudrc-api", "labels": {"app.kubernetes.io/instance": "cloudrc"}},
        "spec": {"ports": [{"name": "api", "port": 8080, "targetPort": "api"}]},
    }
    api.put("services", "demo", service)
    token = base64.b64encode(TOKEN.encode()).decode()
    tokens = {"metadata": {"name": "cloudrc-tokens"}, "data": {"operator": token}}
    api.put("secrets", "demo", tokens)
    return api


@pytest.fixture
def pretend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Make a program that is a shell script; it is found before the real one."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")

    def make(name: str, script: str) -> Path:
        path = folder / name
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)
        return path

    return make


@pytest.fixture
def cluster(tmp_path: Path, pretend: Callable[[str, str], Path]) -> Cluster:
    """A release whose link flies, and a kubectl that knows it."""
    return pretended(tmp_path, pretend)
