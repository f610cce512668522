"""`cloudrc link set` in a cluster: the ConfigMap, the way straight to the pods, the read-back."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml
from fake_api import FakeApi

from cloudrc.cli.link_cluster import with_files
from cloudrc.cli.main import main
from cloudrc.errors import BadInputError
from cloudrc.link.state import LinkState

PROFILE = "uplink: {delay_ms: 45, jitter_ms: 25}\ndownlink: {delay_ms: 45, jitter_ms: 25}\n"
TRACE = "time_s,delay_ms\n0,40\n1,60\n"
LABEL = "app.kubernetes.io/component"
KUBECTL = """
import json, pathlib, sys
folder, words = pathlib.Path(sys.argv[1]), sys.argv[2:]
verb = next(word for word in words if word in ("get", "patch", "exec"))
with (folder / "asked").open("a") as asked:
    print(" ".join(words), file=asked)
refused = folder / f"refuse-{verb}"
if refused.exists():
    sys.exit(refused.read_text())
if verb == "get":
    print((folder / "items.json").read_text())
elif verb == "patch":
    (folder / "patched.json").write_text(sys.stdin.read())
else:
    pod = words[words.index("exec") + 2]
    document = json.loads(sys.stdin.read())
    (folder / f"handed-{pod}.json").write_text(json.dumps(document))
    change = json.loads(document["change"])
    state = json.loads((folder / f"state-{pod}.json").read_text())
    if not (folder / f"deaf-{pod}").exists():
        state |= {"change": change["number"], "cause": change["cause"]}
    print(json.dumps(state))
"""


def item(kind: str, name: str, component: str, **rest: Any) -> dict[str, Any]:
    stamp = "2026-01-01T00:00:00Z"
    metadata = {"name": name, "labels": {LABEL: component}, "creationTimestamp": stamp}
    return {"kind": kind, "metadata": metadata, **rest}


class Cluster:
    """What the pretended kubectl knows, and what it was asked for."""

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

    def handed(self, pod: str) -> dict[str, Any]:
        document: dict[str, Any] = json.loads((self.folder / f"handed-{pod}.json").read_text())
        return document

    def asked(self) -> list[str]:
        return (self.folder / "asked").read_text().splitlines()


@pytest.fixture
def cluster(tmp_path: Path, pretend: Callable[[str, str], Path]) -> Cluster:
    script = tmp_path / "kubectl.py"
    script.write_text(KUBECTL)
    pretend("kubectl", f'exec {sys.executable} -S {script} {tmp_path} "$@"')
    return Cluster(tmp_path)


def test_the_profile_changes_for_good_and_both_pods_get_it_at_once(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo", "--context", "kind"]) == 0
    assert yaml.safe_load(cluster.patched()["profile.yaml"]) == {
        "uplink": {"delay_ms": 45.0, "jitter_ms": 25.0},
        "downlink": {"delay_ms": 120.0, "jitter_ms": 25.0},
    }
    change = json.loads(cluster.patched()["change.json"])
    assert (change["cause"], change["restart"]) == ("downlink.delay_ms=120", False)
    for pod in ("world-1", "cloud-1"):
        handed = cluster.handed(pod)
        assert handed["files"] == {"profile.yaml": cluster.patched()["profile.yaml"]}
        assert (json.loads(handed["change"]), handed["after"]) == (change, "")
    asked = cluster.asked()
    verbs = [word for line in asked for word in line.split() if word in ("get", "exec", "patch")]
    assert verbs == ["get", "exec", "exec", "patch"], "in force first, then for good"
    assert all(line.startswith("--context=kind --namespace=demo ") for line in asked)
    shown = capsys.readouterr().out.splitlines()
    assert shown[2].split()[:4] == ["downlink", "netem", "120", "ms"]


def test_a_trace_goes_to_the_pods_and_the_change_before_is_named(
    cluster: Cluster, tmp_path: Path
) -> None:
    (tmp_path / "t.csv").write_text(TRACE)
    cluster.items[0]["data"] |= {
        "change.json": '{"number": "a1", "cause": "x", "restart": true}',
        "old.csv": "of a profile before",
    }
    cluster.tell()
    assert main(["link", "set", f"uplink.trace={tmp_path / 't.csv'}", "--release", "cloudrc"]) == 0
    handed = cluster.handed("world-1")
    assert handed["after"] == "a1"
    assert set(handed["files"]) == {"profile.yaml", "uplink-t.csv"}
    assert handed["files"]["uplink-t.csv"] == cluster.patched()["uplink-t.csv"] == TRACE


def test_a_trace_of_this_machine_goes_with_the_profile(tmp_path: Path) -> None:
    (tmp_path / "my trace.csv").write_text(TRACE)
    made, new = with_files(
        {"profile.yaml": PROFILE}, None, [f"uplink.trace={tmp_path / 'my trace.csv'}"]
    )
    assert made.restart
    assert new["uplink-my_trace.csv"] == TRACE
    assert yaml.safe_load(new["profile.yaml"])["uplink"]["trace"] == "uplink-my_trace.csv"
    # From now on it lies beside the profile and is named as it lies.
    again, newer = with_files({**new, "change.json": "{}"}, None, ["downlink.loss=0.1"])
    assert again.values["uplink"]["trace"] == "uplink-my_trace.csv"
    assert set(newer) == {"profile.yaml"}
    assert not again.restart


def test_a_trace_that_is_too_long_for_a_config_map_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "t.csv").write_text(TRACE)
    monkeypatch.setattr("cloudrc.cli.link_cluster.SIZE_MAX", 50)
    with pytest.raises(BadInputError, match="a ConfigMap takes 50"):
        with_files({"profile.yaml": PROFILE}, None, [f"uplink.trace={tmp_path / 't.csv'}"])


@pytest.mark.parametrize(
    ("verb", "beside"),
    [
        ("patch", "the link changes, until its containers start again"),
        ("exec", "the ConfigMap has the change, and the pods follow it within 2 minutes"),
    ],
)
def test_where_only_a_part_is_allowed_it_is_said_what_holds(
    cluster: Cluster, capsys: pytest.CaptureFixture[str], verb: str, beside: str
) -> None:
    cluster.refuse(verb, "Error from server (Forbidden): this is forbidden")
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    said = capsys.readouterr().err
    assert "forbidden" in said
    assert beside in said
    assert len(said.splitlines()) == 1


def test_a_refusal_by_the_link_is_the_users_error(
    cluster: Cluster, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("secrets.token_hex", lambda _: "a1")
    path = cluster.folder / "state-cloud-1.json"
    state = json.loads(path.read_text()) | {"refused": "a1", "refusal": "netem cannot do that"}
    path.write_text(json.dumps(state))
    assert main(["link", "set", "downlink.corrupt=0.5", "-n", "demo"]) == 2
    assert "the downlink is as it was: netem cannot do that" in capsys.readouterr().err
    assert not any(" patch " in line for line in cluster.asked()), "it does not last either"


def test_a_container_that_does_not_take_it_over_was_waited_for(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    (cluster.folder / "deaf-cloud-1").touch()
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 4
    assert capsys.readouterr().err == (
        "cloudrc: error: the downlink did not take the change over within 5 s; "
        "see the logs of the link containers\n"
    )


def test_a_container_of_another_version_is_said(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    (cluster.folder / "state-cloud-1.json").write_text("{}")
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert "a link container is of another version: not the state of a link" in line


def test_a_release_that_is_not_there_is_said(
    cluster: Cluster, api: FakeApi, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.items.clear()
    cluster.tell()
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    assert "no release 'cloudrc'" in capsys.readouterr().err


def test_a_pod_that_does_not_run_is_named(
    cluster: Cluster, running: FakeApi, capsys: pytest.CaptureFixture[str]
) -> None:
    running.get("pods", "world-1")["status"]["phase"] = "Pending"
    del cluster.items[2]
    cluster.tell()
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    assert "the world pod of release 'cloudrc' does not run" in capsys.readouterr().err
