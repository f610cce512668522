"""`cloudrc link set` in a cluster: the ConfigMap, the way straight to the pods, the read-back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from cloudrc.cli.main import main
from cloudrc.cluster.link import with_files
from cloudrc.errors import BadInputError
from tests.cluster.conftest import PROFILE, TRACE, Cluster, FakeApi


def test_a_change_is_permanent_and_reaches_both_pods_at_once(
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
        handed = cluster.handed(pod)[-1]
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
    handed = cluster.handed("world-1")[-1]
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
    monkeypatch.setattr("cloudrc.cluster.link.SIZE_MAX", 50)
    with pytest.raises(BadInputError, match="a ConfigMap takes 50"):
        with_files({"profile.yaml": PROFILE}, None, [f"uplink.trace={tmp_path / 't.csv'}"])


@pytest.mark.parametrize(
    ("verb", "beside"),
    [
        ("patch", "the link changes, until its pods are replaced"),
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


def test_a_container_of_another_version_is_said(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    (cluster.folder / "state-cloud-1.json").write_text("{}")
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert "a link container is of another version: not the state of a link" in line
    assert "the uplink had taken the change, and has its old profile back" in line
    assert not cluster.kept()


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
