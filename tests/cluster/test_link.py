# SPDX-License-Identifier: Apache-2.0

"""`cloudrc link set` in a cluster: pods, ConfigMap, messages and permissions."""

import json
import subprocess
import sys
from dataclasses import asdict
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import yaml

from cloudrc.base.errors import BadInputError
from cloudrc.cluster.client import ClusterError
from cloudrc.cluster.link import CARRIER, with_files
from cloudrc.flight.pod.link_control import ControlServer
from cloudrc.link.control import put_request, read_answer
from cloudrc.link.state import LinkState

PROFILE = "uplink: {delay_ms: 45, jitter_ms: 25}\ndownlink: {delay_ms: 45, jitter_ms: 25}\n"
TRACE = "time_s,delay_ms\n0,40\n1,60\n"
LINE = "link set downlink.delay_ms=120 -n demo"


def item(kind, name, component, **rest):
    labels = {"app.kubernetes.io/component": component}
    metadata = {"name": name, "labels": labels, "creationTimestamp": "2026-01-01T00:00:00Z"}
    return {"kind": kind, "metadata": metadata, **rest}


class Cluster:
    """A release behind a fake kubectl, with a record of its calls."""

    def __init__(self):
        running = {"status": {"phase": "Running"}}
        self.items = [
            item("ConfigMap", "demo-link", "link", data={"profile.yaml": PROFILE}),
            item("ConfigMap", "demo-experiment", "shared", data={"experiment.yaml": "{}"}),
            *(item("Pod", name, name[:5], **running) for name in ("world-1", "cloud-1", "cloud-0")),
        ]
        self.items[-1]["metadata"]["deletionTimestamp"] = "2026-01-01T00:00:01Z"
        self.states = {
            pod: asdict(LinkState("netem", "", "auto", way, {}, "", 1, asked={"delay": 0.12}))
            for pod, way in (("world-1", "uplink"), ("cloud-1", "downlink"))
        }
        self.refused = set()  # verbs of kubectl
        self.broken, self.deaf = set(), set()  # pods that are away, or apply nothing
        self.cannot = {}  # pod -> word in a profile that it refuses
        self.asked, self.handed, self.kept = [], {}, {}

    def run(self, name, words, *, given=""):
        assert name == "kubectl"
        self.asked.append(words)
        verb = next(word for word in words if word in ("get", "patch", "exec"))
        if verb in self.refused:
            raise ClusterError(f"'kubectl {verb}' failed: this is forbidden")
        if verb == "get":
            return json.dumps({"items": self.items})
        if verb == "patch":
            self.kept = json.loads(given)["data"]
            return ""
        pod = words[words.index("exec") + 2]
        if pod in self.broken:
            raise ClusterError("the pod is gone")
        document, state = json.loads(given.partition("\r\n\r\n")[2]), self.states[pod]
        change, self.handed[pod] = json.loads(document["change.json"]), document
        if pod in self.cannot and self.cannot[pod] in document["profile.yaml"]:
            state |= {"refused": change["number"], "refusal": "netem cannot do that"}
        elif pod not in self.deaf:
            state |= {"change": change["number"], "cause": change["cause"]}
        return f"HTTP/1.0 200 OK\r\n\r\n{json.dumps(state)}"


@pytest.fixture
def cluster(monkeypatch):
    found = Cluster()
    monkeypatch.setattr("cloudrc.cluster.link.run", found.run)
    return found


def test_a_change_reaches_both_pods_and_the_configmap(cluster, call):
    out = call(f"{LINE} --context kind").out
    profile = yaml.safe_load(cluster.kept["profile.yaml"])
    assert profile["uplink"] == {"delay_ms": 45.0, "jitter_ms": 25.0}
    assert profile["downlink"] == {"delay_ms": 120.0, "jitter_ms": 25.0}
    change = json.loads(cluster.kept["change.json"])
    assert (change["cause"], change["restart"]) == ("downlink.delay_ms=120", False)
    for name in ("world-1", "cloud-1"):
        handed = cluster.handed[name]
        assert handed == {name: cluster.kept[name] for name in ("profile.yaml", "change.json")}
    asked = cluster.asked
    verbs = [word for line in asked for word in line if word in ("get", "exec", "patch")]
    assert verbs == ["get", "exec", "exec", "patch"], "in force first, then for good"
    assert all(line[:2] == ["--context=kind", "--namespace=demo"] for line in asked)
    assert "downlink   netem" in out


def test_a_local_trace_is_stored_beside_the_profile(cluster, tmp_path, monkeypatch, call):
    (tmp_path / "my trace.csv").write_text(TRACE)
    setting = [f"uplink.trace={tmp_path / 'my trace.csv'}"]
    cluster.items[0]["data"] |= {"old.csv": "of a profile before"}
    call("link set -n demo", *setting)
    handed = cluster.handed["world-1"]
    assert set(handed) == {"profile.yaml", "change.json", "uplink-my_trace.csv"}
    assert handed["uplink-my_trace.csv"] == cluster.kept["uplink-my_trace.csv"] == TRACE
    made, new = with_files({"profile.yaml": PROFILE}, None, setting)
    assert made.restart
    assert yaml.safe_load(new["profile.yaml"])["uplink"]["trace"] == "uplink-my_trace.csv"
    again, newer = with_files({**new, "change.json": "{}"}, None, ["downlink.loss=0.1"])
    assert again.values["uplink"]["trace"] == "uplink-my_trace.csv", "it names the file beside it"
    assert set(newer) == {"profile.yaml"}
    assert not again.restart
    monkeypatch.setattr("cloudrc.cluster.link.SIZE_MAX", 50)
    with pytest.raises(BadInputError, match="a ConfigMap takes 50"):
        with_files({"profile.yaml": PROFILE}, None, setting)


LATER = "; the ConfigMap has the change, and the pods apply it within 2 minutes\n"


def test_an_unreachable_or_silent_container_is_changed_later(cluster, refused):
    cluster.broken.add("cloud-1")
    said = refused(LINE, code=5)
    assert said.count("the pod is gone") == 1
    assert said.endswith(LATER)
    assert cluster.kept
    cluster.broken.clear()
    cluster.deaf.add("cloud-1")
    said = refused(LINE, code=4)
    assert "the downlink did not apply the change within 5 s; see the log" in said
    assert said.endswith(f"container link of pod cloud-1{LATER}")
    cluster.states["cloud-1"].clear()
    said = refused(LINE, code=5)
    assert "a link container has another version: not a LinkState: " in said


def test_a_refused_change_is_not_written_to_the_configmap(cluster, refused):
    cluster.cannot["cloud-1"] = "corrupt"
    assert refused("link set downlink.corrupt=0.5 uplink.delay_ms=9 -n demo") == (
        "cloudrc: error: the downlink is unchanged: netem cannot do that; the uplink has the "
        "change; the ConfigMap is unchanged\n"
    )
    assert not cluster.kept


# The pipe in the link container, with a real Python.

NOTE = json.dumps({"number": "b2", "cause": "zwölf", "restart": False})
LONG = "time_s,delay_ms\n" + "0,40\n" * 20_000
DOCUMENT = json.dumps({"change.json": NOTE, "profile.yaml": "uplink: {trace: t}\n", "t": LONG})


def through_pipe(path, request):
    words = [sys.executable, "-I", "-S", "-c", CARRIER, str(path)]
    return subprocess.run(words, input=request, capture_output=True)


def test_the_pipe_carries_a_change_to_the_socket_and_the_state_back():
    got, state = (
        [],
        LinkState("relay", "", "relay", "uplink", {}, "", 1, change="b2", cause="zwölf"),
    )

    def change(document):
        got.append(document.decode())
        return "b2"

    with TemporaryDirectory(prefix="cloudrc-") as folder:
        server = ControlServer(Path(folder) / "link.sock", change, lambda: state)
        done = through_pipe(server.server_address, put_request(DOCUMENT))
        cut = through_pipe(server.server_address, put_request(DOCUMENT)[:-1])
        server.shutdown()
        server.server_close()
    assert got == [DOCUMENT, DOCUMENT[:-1]]
    assert read_answer(done.stdout) == state
    assert cut.returncode == 0


# The Role among the chart's examples.

ROLE = Path(__file__).parents[2] / "charts" / "cloudrc" / "examples" / "link-set-role.yaml"
KUBECTL_NEEDS = {
    "get": {("configmaps", "list"), ("pods", "list")},  # by selector, not by name
    "patch": {("configmaps", "get"), ("configmaps", "patch")},
    "exec": {("pods", "get"), ("pods/exec", "create")},
}
"""Verb of kubectl -> permissions that it needs, according to an API server's audit log."""


def test_the_role_allows_just_what_its_commands_need(cluster, call):
    call(LINE)
    rules = yaml.safe_load(ROLE.read_text())["rules"]
    (changing,) = (rule for rule in rules if "patch" in rule["verbs"])
    assert changing["resourceNames"] == ["cloudrc-link"], "another one has the guard's limits"
    pairs = (product(rule["resources"], rule["verbs"]) for rule in rules)
    allowed = {pair for found in pairs for pair in found}
    verbs = {word for line in cluster.asked for word in line if word in KUBECTL_NEEDS}
    assert allowed == set.union(*(KUBECTL_NEEDS[verb] for verb in verbs))
