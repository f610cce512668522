"""Pods beside the release: a stranger who tries every door, and a Prometheus that is let in."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

import yaml

from cloudrc.cluster.client import connect
from cloudrc.cluster.pods import NO_PROXY, forwarded
from tests.e2e.conftest import (
    NAMESPACE,
    CommandFailedError,
    apply,
    command,
    eventually,
    kubectl,
    pod,
)

MONITORING = f"{NAMESPACE}-monitoring"
SECURITY = {
    "allowPrivilegeEscalation": False,
    "readOnlyRootFilesystem": True,
    "capabilities": {"drop": ["ALL"]},
}
KNOCK = """\
import json, socket, sys
doors = json.loads(sys.argv[1])
open_doors = []
for host, port in doors["tcp"]:
    try:
        socket.create_connection((host, port), timeout=2).close()
        open_doors.append(f"{host}:{port}")
    except ConnectionRefusedError:
        open_doors.append(f"{host}:{port} (answered)")
    except OSError:
        pass
udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for host, port in doors["udp"]:
    for _ in range(50):
        udp.sendto(b"knock knock", (host, port))
print(json.dumps(open_doors))
"""


def image() -> str:
    """An image with Python that is on the node: that of the cloud pod."""
    return str(pod("cloud")["spec"]["containers"][0]["image"])


def stranger(name: str, doors: Mapping[str, list[tuple[str, int]]]) -> list[str]:
    """Knock at doors from a pod without our labels in our namespace; those that opened."""
    container = {
        "name": "stranger",
        "image": image(),
        "command": ["python", "-c", KNOCK, json.dumps(doors)],
        "securityContext": SECURITY,
    }
    apply(
        {
            "apiVersion": "v1",
            "kind": "Pod",
            "metadata": {"name": name},
            "spec": {
                "restartPolicy": "Never",
                "automountServiceAccountToken": False,
                "securityContext": {
                    "runAsNonRoot": True,
                    "runAsUser": 10001,
                    "seccompProfile": {"type": "RuntimeDefault"},
                },
                "containers": [container],
            },
        }
    )
    try:
        succeeded = "--for=jsonpath={.status.phase}=Succeeded"
        kubectl("wait", f"pod/{name}", succeeded, "--timeout=60s", timeout=70.0)
        return list(json.loads(kubectl("logs", name)))
    finally:
        kubectl("delete", "pod", name, "--wait=false", "--grace-period=0", "--force")


DISCOVER = """\
import json, os, ssl, sys, time, urllib.request
ACCOUNT = "/var/run/secrets/kubernetes.io/serviceaccount"
trust = ssl.create_default_context(cafile=f"{ACCOUNT}/ca.crt")
url = f"https://{os.environ['KUBERNETES_SERVICE_HOST']}/api/v1/namespaces/{sys.argv[1]}/pods"
while True:
    token = open(f"{ACCOUNT}/token").read()
    request = urllib.request.Request(url, headers={"Authorization": f"Bearer {token}"})
    pods = json.load(urllib.request.urlopen(request, context=trust, timeout=10))["items"]
    found = []
    for pod in pods:
        notes = pod["metadata"].get("annotations", {})
        if notes.get("prometheus.io/scrape") == "true" and "podIP" in pod["status"]:
            labels = {
                "__metrics_path__": notes["prometheus.io/path"],
                "component": pod["metadata"]["labels"]["app.kubernetes.io/component"],
            }
            target = f"{pod['status']['podIP']}:{notes['prometheus.io/port']}"
            found.append({"targets": [target], "labels": labels})
    with open("/targets/new", "w") as file:
        json.dump(found, file)
    os.replace("/targets/new", "/targets/pods.json")
    time.sleep(2)
"""
"""Does what kubernetes_sd_configs does, which Debian builds Prometheus without."""
CONFIG = """\
global: {scrape_interval: 2s}
scrape_configs:
  - job_name: pods
    file_sd_configs: [{files: [/targets/pods.json], refresh_interval: 1s}]
"""


def install_prometheus(prometheus_image: str) -> None:
    """A Prometheus in a namespace of its own; it finds pods by the usual annotations."""
    subject = {"kind": "ServiceAccount", "name": "prometheus", "namespace": MONITORING}
    rule = {"apiGroups": [""], "resources": ["pods"], "verbs": ["get", "list", "watch"]}
    group = "rbac.authorization.k8s.io"
    role = {"apiGroup": group, "kind": "Role", "name": "prometheus"}
    apply_anywhere(
        [
            {"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": MONITORING}},
            _named("v1", "ServiceAccount", MONITORING),
            {**_named(f"{group}/v1", "Role", NAMESPACE), "rules": [rule]},
            {
                **_named(f"{group}/v1", "RoleBinding", NAMESPACE),
                "subjects": [subject],
                "roleRef": role,
            },
            {**_named("v1", "ConfigMap", MONITORING), "data": {"prometheus.yml": CONFIG}},
            {**_named("v1", "Pod", MONITORING), "spec": _prometheus_pod(prometheus_image)},
        ]
    )


def _named(version: str, kind: str, namespace: str) -> dict[str, Any]:
    metadata = {"name": "prometheus", "namespace": namespace}
    return {"apiVersion": version, "kind": kind, "metadata": metadata}


def _prometheus_pod(prometheus_image: str) -> dict[str, Any]:
    targets = {"name": "targets", "mountPath": "/targets"}
    prometheus = {
        "name": "prometheus",
        "image": prometheus_image,
        "readinessProbe": {"httpGet": {"path": "/-/ready", "port": 9090}, "periodSeconds": 1},
        "volumeMounts": [targets, {"name": "config", "mountPath": "/etc/prometheus"}],
    }
    discovery = {
        "name": "discovery",
        "image": image(),
        "command": ["python", "-c", DISCOVER, NAMESPACE],
        "volumeMounts": [targets],
    }
    volumes = [
        {"name": "config", "configMap": {"name": "prometheus"}},
        {"name": "targets", "emptyDir": {}},
    ]
    return {
        "serviceAccountName": "prometheus",
        "securityContext": {"fsGroup": 10001},
        "containers": [prometheus, discovery],
        "volumes": volumes,
    }


def apply_anywhere(documents: list[dict[str, Any]]) -> None:
    """Apply objects that name their namespaces themselves."""
    command("kubectl", "apply", "--filename=-", given=yaml.safe_dump_all(documents))


def beside_prometheus(*words: str, given: str = "") -> str:
    """What a command in the pod of Prometheus says, and of what it is given on its input."""
    where = ("exec", f"--namespace={MONITORING}", "--stdin", "prometheus", "--container=prometheus")
    return kubectl(*where, "--", *words, given=given)


def promtool(*words: str, given: str) -> str:
    """What the tool of Prometheus says, and of what it is given on its standard input."""
    return beside_prometheus("promtool", *words, given=given)


def rules_tried(rules: str, tests: str) -> str:
    """What `promtool test rules` says; it wants both as files side by side."""
    folder = beside_prometheus("mktemp", "--directory").strip()
    for name, text in {"rules.yaml": rules, "tests.yaml": tests}.items():
        beside_prometheus("tee", f"{folder}/{name}", given=text)
    return beside_prometheus("promtool", "test", "rules", f"{folder}/tests.yaml")


class Prometheus:
    """The Prometheus of the tests, asked by HTTP while the block lasts."""

    def __enter__(self) -> Prometheus:
        self._way = forwarded(connect(None, MONITORING), "prometheus", [9090])

        def way() -> Any:
            try:
                return self._way.__enter__()
            except (AssertionError, CommandFailedError):
                return None

        self._port = eventually(way, "a way to Prometheus")[9090]
        return self

    def __exit__(self, *error: Any) -> None:
        self._way.__exit__(*error)

    def ask(self, query: str) -> list[dict[str, Any]]:
        """What PromQL answers."""
        url = f"http://127.0.0.1:{self._port}/api/v1/query?{urlencode({'query': query})}"
        with NO_PROXY.open(url, timeout=10) as answer:
            said = json.load(answer)
        assert said["status"] == "success", said
        return list(said["data"]["result"])
