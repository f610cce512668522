"""A Kubernetes API server that a test can look into: objects in memory, selectors, logs, refusals.

kmock was tried first: it does not select by label, and its pytest plug-in needs a second one that
warns in every run of the suite.
"""

from __future__ import annotations

import itertools
import json
import threading
import uuid
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import yaml

VERSION_KEYS = (
    "buildDate compiler gitCommit gitTreeState gitVersion goVersion major minor platform".split()
)


def _merge(target: dict[str, Any], patch: dict[str, Any]) -> None:
    """Lay a patch over an object, as RFC 7396 says."""
    for key, value in patch.items():
        if isinstance(value, dict):
            _merge(target.setdefault(key, {}), value)
        elif value is None:
            target.pop(key, None)
        else:
            target[key] = value


class FakeApi:
    """Holds objects by (plural, namespace, name); `refuse` answers a verb with a code."""

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
    """A kubeconfig with two contexts: `here`, which is the current one, and `elsewhere`."""
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
    """A pod with one container, in a state as the kubelet writes it."""
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
