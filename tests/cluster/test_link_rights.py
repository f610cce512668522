"""The rights that `cloudrc link set` needs, and the Role among the chart's examples."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from cloudrc.cli.main import main
from tests.cluster.conftest import PROFILE, Cluster, FakeApi, kubeconfig, pod

ROLE = Path(__file__).parents[2] / "charts" / "cloudrc" / "examples" / "link-set-role.yaml"
LINE = ["link", "set", "downlink.delay_ms=120", "-n", "demo"]
VERBS = {"POST": "create", "PATCH": "patch"}
KUBECTL_NEEDS = {
    "get configmaps,pods --selector": {("configmaps", "list"), ("pods", "list")},
    "patch configmap NAME": {("configmaps", "get"), ("configmaps", "patch")},
    "exec NAME": {("pods", "get"), ("pods/exec", "create")},
}
"""Command of kubectl, from `short` -> rights that it needs."""


def allowed() -> set[tuple[str, str]]:
    """Return the rights of the Role: resource and verb."""
    rules = yaml.safe_load(ROLE.read_text())["rules"]
    return {(what, verb) for rule in rules for what in rule["resources"] for verb in rule["verbs"]}


def short(line: str) -> str:
    """Shorten a command line of kubectl to the words that decide its rights."""
    words = [word for word in line.partition(" -- ")[0].split() if word != "--stdin"]
    plain = [word for word in words if not word.startswith("-")]
    if plain[0] == "get":
        assert len(plain) == 2, "by selector, not by name"
        return " ".join([*plain, *(word.split("=")[0] for word in words if "--sel" in word)])
    return " ".join([*plain[:-1], "NAME"])


def test_the_role_allows_just_what_its_commands_need(cluster: Cluster) -> None:
    assert main(LINE) == 0
    commands = {short(line) for line in cluster.asked()}
    assert set().union(*(KUBECTL_NEEDS[command] for command in commands)) == allowed()


class Server(FakeApi):
    """An API server that records the rights of each request; it refuses `pods/exec`."""

    def __init__(self) -> None:
        super().__init__()
        self.rights: set[tuple[str, str]] = set()

    def answer(self, method: str, path: str, body: Any) -> tuple[int, Any]:
        place = path.partition("?")[0]
        if not (found := re.search(r"/namespaces/demo/(\w+)(?:/[^/]+)?(/exec)?$", place)):
            return _discovered(place)
        named = place.count("/") > 5
        verb = VERBS.get(method) or ("get" if named else "list")
        self.rights.add((found[1] + (found[2] or ""), verb))
        if found[2]:
            return 403, {"kind": "Status", "status": "Failure", "message": "no exec", "code": 403}
        code, said = super().answer(method, path, body)
        kind = {"pods": "Pod", "configmaps": "ConfigMap"}[found[1]]
        head = {"apiVersion": "v1", "kind": kind}
        if not named:
            items = [head | one for one in said["items"]]
            return code, {"apiVersion": "v1", "kind": f"{kind}List", "items": items}
        return code, head | said


def _discovered(place: str) -> tuple[int, Any]:
    """Answer kubectl's discovery of resources."""
    kinds = {"pods": "Pod", "configmaps": "ConfigMap"}
    listed = [
        {"name": name, "kind": kind, "namespaced": True, "verbs": ["get", "list", "patch"]}
        for name, kind in kinds.items()
    ]
    pages = {
        "/version": {"major": "1", "minor": "33", "gitVersion": "v1.33.0"},
        "/api": {"kind": "APIVersions", "versions": ["v1"]},
        "/apis": {"kind": "APIGroupList", "apiVersion": "v1", "groups": []},
        "/api/v1": {"kind": "APIResourceList", "groupVersion": "v1", "resources": listed},
    }
    return 200, pages[place]


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    found = Server()
    (tmp_path / "kubeconfig").write_text(kubeconfig(found.url))
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "kubeconfig"))
    monkeypatch.setenv("HOME", str(tmp_path))  # kubectl caches its discovery there
    yield found
    found.close()


def test_kubectl_needs_just_what_the_role_allows(server: Server) -> None:
    if shutil.which("kubectl") is None:
        pytest.skip("kubectl is missing: https://kubernetes.io/docs/tasks/tools/")
    for component in ("world", "cloud"):
        server.put("pods", "demo", pod(f"{component}-1", component))
    labels = {"app.kubernetes.io/name": "cloudrc", "app.kubernetes.io/instance": "cloudrc"}
    metadata = {"name": "cloudrc-link", "labels": labels}
    server.put("configmaps", "demo", {"metadata": metadata, "data": {"profile.yaml": PROFILE}})
    assert main(LINE) == 5, "exec is refused"
    assert "delay_ms: 120" in server.get("configmaps", "cloudrc-link")["data"]["profile.yaml"]
    # kubectl first tries a WebSocket, which is a get, then a create.
    assert server.rights - {("pods/exec", "get")} == allowed()
