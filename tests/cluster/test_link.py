"""`cloudrc link set` in a cluster: the change in pods and ConfigMap, its answer and its rights."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from cloudrc.cli.main import main
from cloudrc.cluster.link import APPLY_LIMIT, APPLY_SCRIPT, with_files
from cloudrc.errors import BadInputError
from cloudrc.link.follow import HANDED_FILE, Handed, read_handed, write_handed
from cloudrc.link.state import STATE_FILE, LinkState, publish, to_text
from tests.cluster.conftest import PROFILE, TRACE, Cluster, FakeApi, kubeconfig, pod

Printed = pytest.CaptureFixture[str]
LINE = ["link", "set", "downlink.delay_ms=120", "-n", "demo"]


def test_a_change_reaches_both_pods_and_the_configmap(cluster: Cluster, capsys: Printed) -> None:
    assert main([*LINE, "--context", "kind"]) == 0
    assert yaml.safe_load(cluster.patched()["profile.yaml"]) == {
        "uplink": {"delay_ms": 45.0, "jitter_ms": 25.0},
        "downlink": {"delay_ms": 120.0, "jitter_ms": 25.0},
    }
    change = json.loads(cluster.patched()["change.json"])
    assert (change["cause"], change["restart"]) == ("downlink.delay_ms=120", False)
    for name in ("world-1", "cloud-1"):
        handed = cluster.handed(name)[-1]
        assert handed["files"] == {"profile.yaml": cluster.patched()["profile.yaml"]}
        assert json.loads(handed["change"]) == change
    asked = cluster.asked()
    verbs = [word for line in asked for word in line.split() if word in ("get", "exec", "patch")]
    assert verbs == ["get", "exec", "exec", "patch"], "in force first, then for good"
    assert all(line.startswith("--context=kind --namespace=demo ") for line in asked)
    shown = capsys.readouterr().out.splitlines()
    assert shown[2].split()[:4] == ["downlink", "netem", "120", "ms"]


def test_a_trace_goes_to_the_pods_and_the_configmap(cluster: Cluster, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(TRACE)
    cluster.items[0]["data"] |= {"old.csv": "of a profile before"}
    cluster.tell()
    assert main(["link", "set", f"uplink.trace={tmp_path / 't.csv'}", "--release", "cloudrc"]) == 0
    handed = cluster.handed("world-1")[-1]
    assert set(handed["files"]) == {"profile.yaml", "uplink-t.csv"}
    assert handed["files"]["uplink-t.csv"] == cluster.patched()["uplink-t.csv"] == TRACE


def test_a_local_trace_is_stored_beside_the_profile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my trace.csv").write_text(TRACE)
    setting = [f"uplink.trace={tmp_path / 'my trace.csv'}"]
    made, new = with_files({"profile.yaml": PROFILE}, None, setting)
    assert made.restart
    assert new["uplink-my_trace.csv"] == TRACE
    assert yaml.safe_load(new["profile.yaml"])["uplink"]["trace"] == "uplink-my_trace.csv"
    # The profile now has the name of the file beside it.
    again, newer = with_files({**new, "change.json": "{}"}, None, ["downlink.loss=0.1"])
    assert again.values["uplink"]["trace"] == "uplink-my_trace.csv"
    assert set(newer) == {"profile.yaml"}
    assert not again.restart
    monkeypatch.setattr("cloudrc.cluster.link.SIZE_MAX", 50)
    with pytest.raises(BadInputError, match="a ConfigMap takes 50"):
        with_files({"profile.yaml": PROFILE}, None, setting)


FORBIDDEN = "Error from server (Forbidden): this is forbidden"
LATER = "; the ConfigMap has the change, and the pods apply it within 2 minutes"


def error(capsys: Printed) -> str:
    """Return the one line of an error message."""
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize("gone", [["cloud-1"], ["world-1", "cloud-1"]])
def test_an_unreachable_container_gets_the_change_later(
    cluster: Cluster, capsys: Printed, gone: list[str]
) -> None:
    for name in gone:
        cluster.make("broken", name)
    assert main(LINE) == 5
    said = error(capsys)
    assert said.count("the pod is gone") == len(gone)
    assert said.endswith(LATER)
    assert cluster.kept()


def test_a_change_that_cannot_be_kept_says_where_it_is(cluster: Cluster, capsys: Printed) -> None:
    cluster.refuse("patch", FORBIDDEN)
    assert main(LINE) == 5
    said = error(capsys)
    assert "the ConfigMap is unchanged: 'kubectl patch configmap' failed" in said
    for way in ("uplink", "downlink"):
        assert f"the {way} has the change until its pod is replaced" in said
    cluster.refuse("exec", FORBIDDEN)
    assert main(LINE) == 5
    said = error(capsys)
    assert said.count("this is forbidden") == 3
    assert "has the change" not in said


def test_a_change_that_one_direction_refuses_does_not_last(
    cluster: Cluster, capsys: Printed
) -> None:
    cluster.make("cannot", "cloud-1", "corrupt")
    assert main(["link", "set", "downlink.corrupt=0.5", "uplink.delay_ms=9", "-n", "demo"]) == 2
    assert error(capsys) == (
        "cloudrc: error: the downlink is unchanged: netem cannot do that; the uplink has the "
        "change; the ConfigMap is unchanged, and restarted pods take it"
    )
    assert not cluster.kept()


def test_a_silent_or_strange_container_is_named(cluster: Cluster, capsys: Printed) -> None:
    cluster.make("deaf", "cloud-1")
    assert main(LINE) == 4
    said = error(capsys)
    assert "the downlink did not apply the change within 5 s; see the log" in said
    assert said.endswith(f"container link of pod cloud-1{LATER}")
    (cluster.folder / "state-cloud-1.json").write_text("{}")
    assert main(LINE) == 5
    assert "a link container has another version: not the state of a link" in error(capsys)


def test_a_missing_release_or_pod_is_named(
    cluster: Cluster, running: FakeApi, capsys: Printed
) -> None:
    running.get("pods", "world-1")["status"]["phase"] = "Pending"
    del cluster.items[2]
    cluster.tell()
    assert main(LINE) == 5
    assert "the world pod of release 'cloudrc' does not run" in error(capsys)
    running.objects.clear()
    assert main(LINE) == 5
    assert "no release 'cloudrc'" in error(capsys)


# The script in the link container, with a real `sh`.

NOTE = json.dumps({"number": "b2", "cause": "zwölf", "restart": False})
LONG = "time_s,delay_ms\n" + "0,40\n" * 20_000
DOCUMENT = write_handed(Handed(NOTE, {"profile.yaml": "uplink: {trace: t.csv}\n", "t": LONG}))


def start(folder: Path) -> subprocess.Popen[str]:
    length = str(len(DOCUMENT.encode()))
    command = ["sh", "-c", APPLY_SCRIPT, "sh", str(folder), "b2", length]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)


def tell(folder: Path, **state: str) -> str:
    text = to_text(LinkState("relay", "", "relay", "uplink", {}, "", 1, **state))
    publish(folder / STATE_FILE, text)
    return text


@pytest.mark.parametrize("state", [{"change": "b2"}, {"change": "a1", "refused": "b2"}])
def test_the_script_hands_over_a_change_and_prints_the_state(
    tmp_path: Path, state: dict[str, str]
) -> None:
    tell(tmp_path, change="a1", refused="b22")
    running = start(tmp_path)
    decided = list[str]()

    def sidecar() -> None:
        while not (tmp_path / HANDED_FILE).exists():
            time.sleep(0.005)
        decided.append(tell(tmp_path, **state))

    thread = threading.Thread(target=sidecar)
    thread.start()
    out, err = running.communicate(DOCUMENT, timeout=2 * APPLY_LIMIT)
    thread.join()
    assert (running.returncode, out, err) == (0, decided[0], "")
    assert read_handed((tmp_path / HANDED_FILE).read_text()).change == NOTE
    assert sorted(os.listdir(tmp_path)) == [HANDED_FILE, STATE_FILE], "no draft is left"


@pytest.mark.process
def test_a_silent_sidecar_leaves_the_old_state(tmp_path: Path) -> None:
    told = tell(tmp_path, change="a1")
    out, _ = start(tmp_path).communicate(DOCUMENT, timeout=10 * APPLY_LIMIT)
    assert out == told


@pytest.mark.parametrize(
    ("folder", "given", "words"),
    [(".", DOCUMENT[:-1], "the change arrived incomplete"), ("none", "", "no link runs here")],
)
def test_what_the_script_cannot_hand_over_is_refused(
    tmp_path: Path, folder: str, given: str, words: str
) -> None:
    tell(tmp_path, change="a1")
    running = start(tmp_path / folder)
    _, err = running.communicate(given)
    assert (running.returncode, err) == (2, f"error: {words};\n")
    assert os.listdir(tmp_path) == [STATE_FILE]


# The Role among the chart's examples.

ROLE = Path(__file__).parents[2] / "charts" / "cloudrc" / "examples" / "link-set-role.yaml"
VERBS = {"POST": "create", "PATCH": "patch"}


class Server(FakeApi):
    """An API server that records the rights of each request; it refuses `pods/exec`."""

    def __init__(self) -> None:
        super().__init__()
        self.rights: set[tuple[str, str]] = set()

    def answer(self, method: str, path: str, body: Any) -> tuple[int, Any]:
        place = path.partition("?")[0]
        if not (found := re.search(r"/namespaces/demo/(\w+)(?:/[^/]+)?(/exec)?$", place)):
            return 200, DISCOVERED[place]
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


KINDS = [
    {"name": name, "kind": kind, "namespaced": True, "verbs": ["get", "list", "patch"]}
    for name, kind in {"pods": "Pod", "configmaps": "ConfigMap"}.items()
]
DISCOVERED = {
    "/version": {"major": "1", "minor": "33", "gitVersion": "v1.33.0"},
    "/api": {"kind": "APIVersions", "versions": ["v1"]},
    "/apis": {"kind": "APIGroupList", "apiVersion": "v1", "groups": []},
    "/api/v1": {"kind": "APIResourceList", "groupVersion": "v1", "resources": KINDS},
}
"""Answers to kubectl's discovery of resources."""


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    found = Server()
    (tmp_path / "kubeconfig").write_text(kubeconfig(found.url))
    monkeypatch.setenv("KUBECONFIG", str(tmp_path / "kubeconfig"))
    monkeypatch.setenv("HOME", str(tmp_path))  # kubectl caches its discovery there
    yield found
    found.close()


@pytest.mark.skipif(shutil.which("kubectl") is None, reason="kubectl is missing")
def test_kubectl_needs_just_what_the_role_allows(server: Server) -> None:
    rules = yaml.safe_load(ROLE.read_text())["rules"]
    allowed = {
        (what, verb) for rule in rules for what in rule["resources"] for verb in rule["verbs"]
    }
    for component in ("world", "cloud"):
        server.put("pods", "demo", pod(f"{component}-1", component))
    labels = {"app.kubernetes.io/name": "cloudrc", "app.kubernetes.io/instance": "cloudrc"}
    metadata = {"name": "cloudrc-link", "labels": labels}
    server.put("configmaps", "demo", {"metadata": metadata, "data": {"profile.yaml": PROFILE}})
    assert main(LINE) == 5, "exec is refused"
    assert "delay_ms: 120" in server.get("configmaps", "cloudrc-link")["data"]["profile.yaml"]
    # kubectl first tries a WebSocket, which is a get, then a create.
    assert server.rights - {("pods/exec", "get")} == allowed
