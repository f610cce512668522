"""A fake Kubernetes API server with objects in memory, a kubeconfig for it, and fake programs.

kmock does not fit: it does not select by label, and its pytest plug-in needs another one that
warns in every run.
"""

from __future__ import annotations

import base64
import itertools
import json
import os
import sys
import threading
import uuid
from collections.abc import Callable, Iterator
from dataclasses import asdict
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
import yaml

from cloudrc.cluster import jobs, tools
from cloudrc.cluster import release as deploy
from cloudrc.cluster.client import Release, connect
from cloudrc.link.state import LinkState, from_text

VERSION_KEYS = (
    "buildDate compiler gitCommit gitTreeState gitVersion goVersion major minor platform".split()
)


def _merge(target: dict[str, Any], patch: dict[str, Any]) -> None:
    """Merge a patch into an object (RFC 7396)."""
    for key, value in patch.items():
        if isinstance(value, dict):
            _merge(target.setdefault(key, {}), value)
        elif value is None:
            target.pop(key, None)
        else:
            target[key] = value


class FakeApi:
    """Objects by (plural, namespace, name); `refuse` maps a method and plural to an error."""

    def __init__(self) -> None:
        self.objects: dict[tuple[str, str, str], dict[str, Any]] = {}
        self.logs: dict[str, str] = {}
        self.refuse: dict[tuple[str, str], tuple[int, str]] = {}
        self.seen: list[str] = []
        self.version = {"major": "1", "minor": "33"}
        self.lock = threading.RLock()
        self._clock = itertools.count()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), self._handler())
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()
        self.url = f"http://127.0.0.1:{self._server.server_port}"

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()

    def put(self, plural: str, namespace: str, body: dict[str, Any]) -> dict[str, Any]:
        metadata = body.setdefault("metadata", {})
        metadata.setdefault("namespace", namespace)
        metadata.setdefault("uid", str(uuid.uuid4()))
        metadata.setdefault("generation", 1)
        stamp = f"2026-01-01T00:00:{next(self._clock) % 60:02d}Z"
        metadata.setdefault("creationTimestamp", stamp)
        body.setdefault("status", {})
        with self.lock:
            self.objects[plural, namespace, metadata["name"]] = body
        return body

    def get(self, plural: str, name: str, namespace: str = "demo") -> dict[str, Any]:
        return self.objects[plural, namespace, name]

    def answer(self, method: str, path: str, body: Any) -> tuple[int, Any]:
        address = urlsplit(path)
        if address.path == "/version/":
            return 200, {**dict.fromkeys(VERSION_KEYS, ""), **self.version}
        parts = address.path.strip("/").split("/")
        namespace, plural, *rest = parts[parts.index("namespaces") + 1 :]
        name, subresource = (*rest, "", "")[:2]
        self.seen.append(f"{method} {plural}{'/' + name if name else ''}")
        if (method, plural) in self.refuse:
            code, message = self.refuse[method, plural]
            return code, {"kind": "Status", "message": message, "code": code}
        with self.lock:
            if method == "POST":
                return 201, self.put(plural, namespace, body)
            if not name:
                selector = parse_qs(address.query).get("labelSelector", [""])[0]
                return 200, {"items": self._select(plural, namespace, selector)}
            if (plural, namespace, name) not in self.objects:
                return 404, {"message": f'{plural} "{name}" not found', "code": 404}
            if subresource == "log":
                return 200, self.logs.get(name, "")
            if method == "PATCH":
                _merge(self.objects[plural, namespace, name], body)
            if method == "DELETE":
                return 200, self.objects.pop((plural, namespace, name))
            return 200, self.objects[plural, namespace, name]

    def _select(self, plural: str, namespace: str, selector: str) -> list[dict[str, Any]]:
        wanted = dict(term.split("=") for term in selector.split(",") if term)
        return [
            body
            for (kind, place, _), body in self.objects.items()
            if (kind, place) == (plural, namespace)
            and wanted.items() <= body["metadata"].get("labels", {}).items()
        ]

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        api = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            disable_nagle_algorithm = True

            def reply(self) -> None:
                length = int(self.headers.get("Content-Length") or 0)
                body = json.loads(self.rfile.read(length)) if length else None
                code, answer = api.answer(self.command, self.path, body)
                data = answer.encode() if isinstance(answer, str) else json.dumps(answer).encode()
                self.send_response(code)
                kind = "text/plain" if isinstance(answer, str) else "application/json"
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            do_GET = do_POST = do_DELETE = do_PATCH = reply  # noqa: N815

            def log_message(self, *words: Any) -> None:
                pass

        return Handler


def kubeconfig(url: str, namespace: str = "demo") -> str:
    """Build a kubeconfig with two contexts: `here`, the current one, and `elsewhere`."""
    contexts = [
        {"name": "here", "context": {"cluster": "fake", "user": "me", "namespace": namespace}},
        {"name": "elsewhere", "context": {"cluster": "fake", "user": "me"}},
    ]
    return yaml.safe_dump(
        {
            "apiVersion": "v1",
            "kind": "Config",
            "clusters": [{"name": "fake", "cluster": {"server": url}}],
            "users": [{"name": "me", "user": {"token": "none"}}],
            "contexts": contexts,
            "current-context": "here",
        }
    )


def labels(component: str, release: str = "cloudrc") -> dict[str, str]:
    return {
        "app.kubernetes.io/name": "cloudrc",
        "app.kubernetes.io/instance": release,
        "app.kubernetes.io/component": component,
    }


def pod(
    name: str,
    component: str,
    *,
    state: dict[str, Any] | None = None,
    ready: bool = True,
    phase: str = "Running",
    **more: Any,
) -> dict[str, Any]:
    """Build a pod with one container in a state that the kubelet writes."""
    status = {
        "name": component,
        "image": "cloudrc/cloud:0.1.0",
        "imageID": "",
        "ready": ready,
        "restartCount": more.pop("restarts", 0),
        "state": state or {"running": {}},
        "lastState": more.pop("last", {}),
    }
    conditions = [{"type": "Ready", "status": str(ready)}, *more.pop("conditions", [])]
    containers = [{"name": "cloud"}, {"name": "teleop", "image": "cloudrc/cloud:0.1.0"}]
    return {
        "metadata": {"name": name, "labels": {**labels(component), **more.pop("labels", {})}},
        "spec": {
            "containers": containers,
            "volumes": [
                {"name": "data", "emptyDir": {}},
                {"name": "tokens", "secret": {"secretName": "cloudrc-tokens"}},
            ],
        },
        "status": {"phase": phase, "conditions": conditions, "containerStatuses": [status]},
    }


def deployment(component: str, **status: Any) -> dict[str, Any]:
    settled = {"observedGeneration": 1, "replicas": 1, "updatedReplicas": 1}
    return {
        "metadata": {"name": f"cloudrc-{component}", "labels": labels(component)},
        "spec": {"selector": {}, "template": {}},
        "status": {**settled, **status},
    }


PROFILE = "uplink: {delay_ms: 45, jitter_ms: 25}\ndownlink: {delay_ms: 45, jitter_ms: 25}\n"
TRACE = "time_s,delay_ms\n0,40\n1,60\n"
LABEL = "app.kubernetes.io/component"
KUBECTL = """
import json, pathlib, sys
folder, words = pathlib.Path(sys.argv[1]), sys.argv[2:]
verb = next(word for word in words if word in ("get", "patch", "exec"))
with (folder / "asked").open("a") as asked:
    print(" ".join(" ".join(words).split()), file=asked)
refused = folder / f"refuse-{verb}"
if refused.exists():
    sys.exit(refused.read_text())
if verb == "get":
    print((folder / "items.json").read_text())
elif verb == "patch":
    (folder / "patched.json").write_text(sys.stdin.read())
else:
    pod = words[words.index("exec") + 2]
    broken, number = folder / f"broken-{pod}", str(len(list(folder.glob(f"handed-{pod}-*"))))
    if broken.exists() and broken.read_text() in ("", number):
        sys.exit("Error from server: the pod is gone")
    document = json.loads(sys.stdin.read())
    (folder / f"handed-{pod}-{number}.json").write_text(json.dumps(document))
    change = json.loads(document["change"])
    place = folder / f"state-{pod}.json"
    state, cannot = json.loads(place.read_text()), folder / f"cannot-{pod}"
    if cannot.exists() and cannot.read_text() in document["files"]["profile.yaml"]:
        state |= {"refused": change["number"], "refusal": "netem cannot do that"}
    elif not (folder / f"deaf-{pod}").exists():
        state |= {"change": change["number"], "cause": change["cause"]}
    place.write_text(json.dumps(state))
    print(json.dumps(state))
"""


def item(kind: str, name: str, component: str, **rest: Any) -> dict[str, Any]:
    stamp = "2026-01-01T00:00:00Z"
    metadata = {"name": name, "labels": {LABEL: component}, "creationTimestamp": stamp}
    return {"kind": kind, "metadata": metadata, **rest}


class Cluster:
    """The cluster of the fake kubectl, and a record of its calls."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        running = {"status": {"phase": "Running"}}
        self.items = [
            item("ConfigMap", "demo-link", "link", data={"profile.yaml": PROFILE}),
            item("ConfigMap", "demo-experiment", "shared", data={"experiment.yaml": "{}"}),
            item("Pod", "world-1", "world", **running),
            item("Pod", "cloud-1", "cloud", **running),
            item("Pod", "cloud-0", "cloud", **running),
        ]
        self.items[-1]["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:01Z"
        for pod, way in (("world-1", "uplink"), ("cloud-1", "downlink")):
            asked = {"delay": 0.12}
            state = asdict(LinkState("netem", "", "auto", way, {}, "", 1, asked=asked))
            (folder / f"state-{pod}.json").write_text(json.dumps(state))
        self.tell()

    def tell(self) -> None:
        (self.folder / "items.json").write_text(json.dumps({"items": self.items}))

    def refuse(self, verb: str, text: str) -> None:
        (self.folder / f"refuse-{verb}").write_text(text)

    def patched(self) -> dict[str, str]:
        data: dict[str, str] = json.loads((self.folder / "patched.json").read_text())["data"]
        return data

    def make(self, what: str, pod: str, how: str = "") -> None:
        """Make a pod `deaf`, `broken` (at its Nth call), or one that `cannot` apply a text."""
        (self.folder / f"{what}-{pod}").write_text(how)

    def handed(self, pod: str) -> list[dict[str, Any]]:
        """Return the changes that a pod received, the newest last."""
        paths = sorted(self.folder.glob(f"handed-{pod}-*.json"))
        return [json.loads(path.read_text()) for path in paths]

    def state(self, pod: str) -> LinkState:
        return from_text((self.folder / f"state-{pod}.json").read_text())

    def kept(self) -> bool:
        """Whether the ConfigMap was written."""
        return (self.folder / "patched.json").exists()

    def asked(self) -> list[str]:
        """Return all command lines of kubectl."""
        return (self.folder / "asked").read_text().splitlines()


def pretended(folder: Path, pretend: Callable[[str, str], Path]) -> Cluster:
    """Write a release and its fake kubectl into a folder."""
    script = folder / "kubectl.py"
    script.write_text(KUBECTL)
    pretend("kubectl", f'exec {sys.executable} -S {script} {folder} "$@"')
    return Cluster(folder)


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
    monkeypatch.setattr(deploy, "FAILURE_TIME", 0.0)
    yield server
    server.close()


@pytest.fixture
def release(api: FakeApi) -> Release:
    return connect()


@pytest.fixture
def running(api: FakeApi, release: Release) -> FakeApi:
    """The fake API server with a release that is ready to fly."""
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
    """Make a fake program from a shell script; the PATH has it before the real one."""
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
    """A release with a running link, and a fake kubectl for it."""
    return pretended(tmp_path, pretend)
