# SPDX-License-Identifier: Apache-2.0

"""A fake Kubernetes API server with objects in memory, a fake teleop, and fake programs."""

import base64
import itertools
import json
import os
import re
import threading
import uuid
from functools import reduce
from urllib.parse import parse_qs, urlsplit

import pytest
import yaml

from cloudrc.cluster import client, flight, jobs
from cloudrc.cluster.client import connect
from cloudrc.cluster.fleet_mission import ROBOT
from cloudrc.cluster.jobs import UID_LABEL
from cloudrc.cluster.pods import INDEX
from tests.chart.conftest import render
from tests.support.http import serve

PATH = re.compile(r"/(?:api|apis/[^/]+)/v\w+(?:/namespaces/([^/]+))?/(\w+)(?:/([^/]+))?(?:/(\w+))?")
"""Path of a request: namespace, plural, name, subresource."""


def _has_labels(body, selector):
    asked = dict(term.split("=") for term in selector.split(",") if term)
    return asked.items() <= body["metadata"].get("labels", {}).items()


def _has_fields(body, selector):
    terms = (term.split("=") for term in selector.split(",") if term)
    return all(reduce(dict.__getitem__, path.split("."), body) == value for path, value in terms)


class FakeApi:
    """Objects of a namespace by (plural, name); `refuse` maps a method and plural to an error."""

    def __init__(self):
        self.objects = {}
        self.logs = {}
        self.refuse = {}
        self.forbidden = set()  # objects that the user may not create or delete
        self.seen = []
        self.hooks = []  # each gets the path that is read; what it returns is the reply
        self.lock = threading.RLock()
        self._clock = itertools.count()
        self.forgotten = 0  # a watch from an earlier resource version gets error 410
        self.changes = []  # (kind, plural, object) in the order of their resource versions
        self.put("nodes", {"metadata": {"name": "one"}, "spec": {}})
        self.server = serve(lambda request, body: self.answer(request.command, request.path, body))

    def close(self):
        self.server.shutdown()
        self.server.server_close()

    def put(self, plural, body):
        stamp = f"2026-01-01T00:00:{next(self._clock) % 60:02d}Z"
        made = {"uid": str(uuid.uuid4()), "generation": 1, "creationTimestamp": stamp}
        made["namespace"] = "demo"
        body = {"status": {}, **body, "metadata": {**made, **body["metadata"]}}
        with self.lock:
            self.objects[plural, body["metadata"]["name"]] = body
            self._note("MODIFIED", plural, body)
        return body

    def drop(self, plural, name):
        with self.lock:
            body = self.objects.pop((plural, name))
            self._note("DELETED", plural, body)
        return body

    def _note(self, kind, plural, body):
        self.changes.append((kind, plural, body))
        body["metadata"]["resourceVersion"] = str(len(self.changes))

    def get(self, plural, name):
        return self.objects[plural, name]

    def answer(self, method, path, body):
        address = urlsplit(path)
        query = {key: values[0] for key, values in parse_qs(address.query).items()}
        namespace, plural, name, subresource = PATH.match(address.path).groups(default="")
        if plural == "selfsubjectaccessreviews":
            asked = body["spec"]["resourceAttributes"]["resource"]
            return 201, {"spec": {}, "status": {"allowed": asked not in self.forbidden}}
        self.seen.append(f"{method} {plural}{'/' + name if name else ''}")
        if (method, plural) in self.refuse:
            code, message = self.refuse[method, plural]
            return code, {"kind": "Status", "message": message, "code": code}
        with self.lock:
            replies = [hook(path) for hook in self.hooks if method == "GET"]
            if refused := next(filter(None, replies), None):
                return refused
            if method == "POST":
                return 201, body if "dryRun" in query else self.put(plural, body)
            if "watch" in query:
                return 200, self._watch(plural, query)
            if not name:
                found = [
                    body
                    for (kind, _), body in self.objects.items()
                    if kind == plural
                    and namespace in ("", body["metadata"]["namespace"])
                    and _has_labels(body, query.get("labelSelector", ""))
                    and _has_fields(body, query.get("fieldSelector", ""))
                ]
                return 200, {"items": found}
            if (plural, name) not in self.objects:
                return 404, {"message": f'{plural} "{name}" not found', "code": 404}
            if subresource == "log":
                log = self.logs.get(name, "")
                return (403, {"message": "no right", "code": 403}) if log is None else (200, log)
            if method == "DELETE":
                return 200, self.drop(plural, name)
            return 200, self.objects[plural, name]

    def _watch(self, plural, query):
        """Return the changes since a version as lines; the real server waits for more."""
        since = int(query.get("resourceVersion", "0"))
        if 0 < since < self.forgotten:
            status = {"code": 410, "reason": "Expired", "message": "too old"}
            return json.dumps({"type": "ERROR", "object": status}) + "\n"
        return "".join(
            json.dumps({"type": kind, "object": body}) + "\n"
            for kind, changed, body in self.changes[since:]
            if changed == plural and _has_labels(body, query["labelSelector"])
        )

    def jobs(self):
        return [body for (kind, _), body in self.objects.items() if kind == "jobs"]

    def end(self, job, kind, **condition):
        """End a Job: `kind` is "Complete" or "Failed"."""
        ended = {"type": kind, "status": "True", **condition}
        self.get("jobs", job)["status"] = {"conditions": [ended]}

    def start_pod(self, job, **given):
        """Create the pod of a Job as Kubernetes does."""
        uid = self.get("jobs", job)["metadata"]["uid"]
        self.put("pods", pod(f"{job}-x", "mission", labels={UID_LABEL: uid}, **given))

    def end_robot(self, job, robot, code, message):
        """Create the ended pod of a fleet's Job that flies a robot."""
        name, own = f"{job}-{robot}", {UID_LABEL: self.get("jobs", job)["metadata"]["uid"]}
        body = pod(name, "mission", labels=own, state=terminated(code, message))
        body["metadata"]["annotations"] = {ROBOT: str(robot)}
        self.put("pods", body)

    def tell_of(self, plural, name, **event):
        """Put an event about an object."""
        about = {"uid": self.get(plural, name)["metadata"]["uid"], "name": name}
        self.put("events", {"metadata": {"name": "e"}, "involvedObject": about, **event})

    def at_look(self, number, action, plural="jobs"):
        """Call `action` at the n-th request for objects of a kind, by default Jobs."""
        looks = itertools.count(1)

        def look(path):
            if f"/{plural}" in path and next(looks) == number:
                action()

        self.hooks.append(look)

    def away(self, plural, code, times):
        """Refuse `times` read requests; return the list of the refusals still to come."""
        left = [(code, {"message": "etcdserver: leader changed", "code": code})] * times
        self.hooks.append(lambda path: left.pop() if left and f"/{plural}" in path else None)
        return left


class FakeTeleop:
    """The API of a cloud pod, with a record of its requests."""

    def __init__(self):
        self.mission = None
        self.missions = list  # makes the list of all missions
        self.state = None  # answers every GET, if it is set
        self.posted = []
        self.tokens = set()
        self.server = serve(self._answer)

    def _answer(self, request, body):
        self.tokens.add(request.headers["Authorization"])
        if request.command == "GET":
            return 200, self.state or {"missions": self.missions(), "mission": self.mission}
        self.posted.append(request.path)
        return 200, {}

    def forwards(self):
        """Write a fake kubectl that forwards the API's port to this server."""
        here = f"Forwarding from 127.0.0.1:{self.server.server_port} -> 8080"
        return f"echo '{here}'\nexec sleep 60"


def kubeconfig(url):
    """Build a kubeconfig with two contexts: `here`, the current one, and `elsewhere`."""
    return f"""\
apiVersion: v1
kind: Config
current-context: here
clusters: [{{name: fake, cluster: {{server: "{url}"}}}}]
users: [{{name: me, user: {{token: none}}}}]
contexts:
- {{name: here, context: {{cluster: fake, user: me, namespace: demo}}}}
- {{name: elsewhere, context: {{cluster: fake, user: me}}}}
"""


def labels(component):
    return {
        "app.kubernetes.io/name": "cloudrc",
        "app.kubernetes.io/instance": "cloudrc",
        "app.kubernetes.io/component": component,
    }


POD = yaml.safe_load("""
securityContext: {runAsUser: 10001}
containers:
- {name: cloud}
- name: teleop
  image: cloudrc/cloud:0.1.0
  securityContext: {allowPrivilegeEscalation: false}
volumes:
- {name: data, emptyDir: {}}
- {name: tokens, secret: {secretName: cloudrc-tokens}}
""")
"""Pod of a component, as in its Deployment."""


def pod(name, component, *, state=None, ready=True, phase="Running", **more):
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
    return {
        "metadata": {"name": name, "labels": {**labels(component), **more.pop("labels", {})}},
        "spec": POD,
        "status": {"phase": phase, "conditions": conditions, "containerStatuses": [status]},
    }


def deployment(component, **status):
    settled = {"observedGeneration": 1, "replicas": 1, "updatedReplicas": 1}
    return {
        "metadata": {"name": f"cloudrc-{component}", "labels": labels(component)},
        "spec": {
            "replicas": 1,
            "selector": {},
            "serviceName": "",
            "template": {"spec": POD},
        },
        "status": {**settled, **status},
    }


TOKEN = "operator-token-of-the-release"
FAST = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
CONFIG_PLACE = "kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION"
"""Where the client keeps the path of the kubeconfig."""


@pytest.fixture
def api(tmp_path, monkeypatch):
    server = FakeApi()
    server.put("namespaces", {"metadata": {"name": "demo"}})
    path = tmp_path / "kubeconfig"
    path.write_text(kubeconfig(server.server.url))
    monkeypatch.setattr(yaml, "SafeLoader", FAST)  # the client reads the kubeconfig
    monkeypatch.setattr(CONFIG_PLACE, str(path))
    monkeypatch.setattr(jobs, "LOOK_PERIOD", 0.01)
    monkeypatch.setattr(client, "RETRIES", {**client.RETRIES, "backoff_factor": 0.01})
    monkeypatch.setattr(flight, "LOOK_PERIOD", 0.01)
    monkeypatch.setattr(flight, "FAILED_LOOKS", 0)
    yield server
    server.close()


@pytest.fixture
def release(api):
    return connect()


@pytest.fixture
def fleet(api, release):
    """Make a fleet of N robots behind a cell, ready to fly, on the fake API server."""

    def make(robots):
        for component in ("world", "cloud", "cell"):
            count = 1 if component == "cell" else robots
            body = deployment(component, replicas=count, updatedReplicas=count)
            body["spec"]["replicas"] = count
            body["status"]["availableReplicas"] = count
            api.put("statefulsets", body)
            for number in range(count):
                one = pod(f"cloudrc-{component}-{number}", component, labels={INDEX: str(number)})
                api.put("pods", one)
        values = {"robots": robots, "experiment": {"cell": {"rate_kbit": 500}}}
        put_template_and_token(api, values)
        return api

    return make


def put_template_and_token(api, values=None):
    """Put the ConfigMap with the Job of a mission, as the chart makes it, and the API's token."""
    objects = render(values, release="cloudrc")
    (job,) = (each for each in objects if each["metadata"]["name"] == "cloudrc-mission-job")
    api.put("configmaps", job)
    token = base64.b64encode(TOKEN.encode()).decode()
    api.put("secrets", {"metadata": {"name": "cloudrc-tokens"}, "data": {"operator": token}})


@pytest.fixture
def running(api, release):
    """The fake API server with a release that is ready to fly."""
    for component in ("world", "cloud"):
        api.put("deployments", deployment(component))
        api.put("pods", pod(f"{component}-1", component))
    ports = [{"name": "api", "port": 8080, "targetPort": "api"}]
    metadata = {"name": "cloudrc-api", "labels": labels("cloud")}
    api.put("services", {"metadata": metadata, "spec": {"ports": ports}})
    put_template_and_token(api)
    return api


@pytest.fixture
def pretend(tmp_path, monkeypatch):
    """Make a fake program from a shell script; the PATH has it before the real one."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")

    def make(name, script):
        path = folder / name
        path.write_text(f"#!/bin/sh\n{script}\n")
        path.chmod(0o755)
        return path

    return make


@pytest.fixture
def teleop(running, pretend):
    """A fake API of the release, to which the fake kubectl forwards ports."""
    fake = FakeTeleop()
    pretend("kubectl", fake.forwards())
    yield fake
    fake.server.shutdown()
    fake.server.server_close()


def missions_of(api):
    """List a mission under way for each Job of the fake API server."""
    return [{"id": "m4", "key": job["metadata"]["uid"], "verdict": None} for job in api.jobs()]


MISSION = {"name": "short", "start": "spawn", "waypoints": [{"position_m": [0, 0, 1]}]}


def terminated(exit_code, message="", **more):
    return {"terminated": {"exitCode": exit_code, "message": message, **more}}


def waiting(reason, message=""):
    return {"waiting": {"reason": reason, "message": message}}


OUT_OF_MEMORY = terminated(137, reason="OOMKilled")
