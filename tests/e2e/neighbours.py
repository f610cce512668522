# SPDX-License-Identifier: Apache-2.0

"""Pods beside the release: a foreign pod that tries all ports, and an allowed Prometheus."""

import json
from contextlib import contextmanager
from urllib.parse import urlencode

from cloudrc.cluster.client import connect
from cloudrc.cluster.pods import forwarded
from tests.e2e.conftest import MONITORING, NAMESPACE, apply, command, kubectl, pod
from tests.support.http import DIRECT

TRY_PORTS = """\
import json, socket, sys
ports = json.loads(sys.argv[1])
answered = []
for host, port in ports["tcp"]:
    try:
        socket.create_connection((host, port), timeout=2).close()
        answered.append(f"{host}:{port}")
    except ConnectionRefusedError:
        answered.append(f"{host}:{port} (answered)")
    except OSError:
        pass
udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for host, port in ports["udp"]:
    for _ in range(50):
        udp.sendto(b"not a datagram", (host, port))
print(json.dumps(answered))
"""


def stranger(name, ports):
    """Try ports from a pod without the release's labels; return the TCP ports that answer.

    It runs the image of the cloud pod, which has Python and is on the node.
    """
    cloud = pod("cloud")["spec"]
    first = cloud["containers"][0]
    apply(f"""
apiVersion: v1
kind: Pod
metadata: {{name: {name}}}
spec:
  restartPolicy: Never
  automountServiceAccountToken: false
  securityContext: {json.dumps(cloud["securityContext"])}
  containers:
  - name: stranger
    image: {first["image"]}
    command: {json.dumps(["python", "-c", TRY_PORTS, json.dumps(ports)])}
    securityContext: {json.dumps(first["securityContext"])}
""")
    try:
        succeeded = "--for=jsonpath={.status.phase}=Succeeded"
        kubectl("wait", f"pod/{name}", succeeded, "--timeout=60s", timeout=70.0)
        return list(json.loads(kubectl("logs", name)))
    finally:
        kubectl("delete", "pod", name, "--wait=false", "--grace-period=0", "--force")


CONFIG = """\
global: {scrape_interval: 5s}
scrape_configs:
  - job_name: pods
    file_sd_configs: [{files: [/etc/prometheus/pods.json], refresh_interval: 1s}]
"""


def targets():
    """Find the ports whose names end in "metrics", with the labels that a PodMonitor sets.

    Debian builds Prometheus without the discovery of Kubernetes.
    """
    found = []
    for component in ("world", "cloud"):
        one = pod(component)
        spec, labels = one["spec"], {"namespace": NAMESPACE, "pod": one["metadata"]["name"]}
        for container in (*spec["initContainers"], *spec["containers"]):
            for port in container.get("ports", ()):
                if port["name"].endswith("metrics"):
                    target = f"{one['status']['podIP']}:{port['containerPort']}"
                    found.append({"targets": [target], "labels": labels | {"component": component}})
    return json.dumps(found)


def install_prometheus():
    """Start a Prometheus in a namespace of its own, and wait until it is ready."""
    found = command("docker", "images", "--format={{.Repository}}:{{.Tag}}", "cloudrc/prometheus")
    apply(
        f"""
apiVersion: v1
kind: Namespace
metadata: {{name: {MONITORING}}}
---
apiVersion: v1
kind: ConfigMap
metadata: {{name: prometheus}}
data:
  prometheus.yml: {json.dumps(CONFIG)}
  pods.json: {json.dumps(targets())}
---
apiVersion: v1
kind: Pod
metadata: {{name: prometheus}}
spec:
  containers:
  - name: prometheus
    image: {found.split()[0]}
    readinessProbe: {{httpGet: {{path: /-/ready, port: 9090}}, periodSeconds: 1}}
    volumeMounts: [{{name: config, mountPath: /etc/prometheus}}]
  volumes: [{{name: config, configMap: {{name: prometheus}}}}]
""",
        MONITORING,
    )
    ready = ["wait", "pod/prometheus", "--for=condition=Ready", "--timeout=60s"]
    kubectl(f"--namespace={MONITORING}", *ready)


def promtool(*words, given=""):
    """Run promtool in the pod of Prometheus, and return its output."""
    where = ("exec", f"--namespace={MONITORING}", "--stdin", "prometheus", "--container=prometheus")
    return kubectl(*where, "--", "promtool", *words, given=given)


@contextmanager
def queries():
    """Yield a function that sends a PromQL query to Prometheus and returns the result."""
    with forwarded(connect(None, MONITORING), "prometheus", [9090]) as ports:

        def ask(query):
            url = f"http://127.0.0.1:{ports[9090]}/api/v1/query?{urlencode({'query': query})}"
            with DIRECT.open(url, timeout=10) as answer:
                said = json.load(answer)
            assert said["status"] == "success", said
            return list(said["data"]["result"])

        yield ask
