"""`cloudrc link set` in a cluster: the change in the pods and in the ConfigMap, and its answer."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from cloudrc.cli.main import main
from cloudrc.cluster.link import with_files
from cloudrc.errors import BadInputError
from tests.cluster.conftest import PROFILE, TRACE, Cluster, FakeApi


def test_a_change_reaches_both_pods_and_the_configmap(
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


def test_a_local_trace_is_stored_beside_the_profile(tmp_path: Path) -> None:
    (tmp_path / "my trace.csv").write_text(TRACE)
    made, new = with_files(
        {"profile.yaml": PROFILE}, None, [f"uplink.trace={tmp_path / 'my trace.csv'}"]
    )
    assert made.restart
    assert new["uplink-my_trace.csv"] == TRACE
    assert yaml.safe_load(new["profile.yaml"])["uplink"]["trace"] == "uplink-my_trace.csv"
    # The profile now has the name of the file beside it.
    again, newer = with_files({**new, "change.json": "{}"}, None, ["downlink.loss=0.1"])
    assert again.values["uplink"]["trace"] == "uplink-my_trace.csv"
    assert set(newer) == {"profile.yaml"}
    assert not again.restart


def test_a_trace_too_long_for_a_configmap_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "t.csv").write_text(TRACE)
    monkeypatch.setattr("cloudrc.cluster.link.SIZE_MAX", 50)
    with pytest.raises(BadInputError, match="a ConfigMap takes 50"):
        with_files({"profile.yaml": PROFILE}, None, [f"uplink.trace={tmp_path / 't.csv'}"])


def error(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one line of an error message."""
    (line,) = capsys.readouterr().err.splitlines()
    return line


FORBIDDEN = "Error from server (Forbidden): this is forbidden"
LATER = "; the ConfigMap has the change, and the pods apply it within 2 minutes"


@pytest.mark.parametrize(("gone", "count"), [(["cloud-1"], 1), (["world-1", "cloud-1"], 2)])
def test_an_unreachable_container_gets_the_change_later(
    cluster: Cluster, capsys: pytest.CaptureFixture[str], gone: list[str], count: int
) -> None:
    for pod in gone:
        cluster.make("broken", pod)
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    said = error(capsys)
    assert said.count("the pod is gone") == count
    assert said.endswith(LATER)
    assert cluster.kept()


def test_without_the_right_to_write_the_change_does_not_last(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.refuse("patch", FORBIDDEN)
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    said = error(capsys)
    assert "the ConfigMap is unchanged: 'kubectl patch configmap' failed" in said
    for way in ("uplink", "downlink"):
        assert f"the {way} has the change until its pod is replaced" in said


def test_a_change_that_reaches_nobody_says_so(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    for verb in ("patch", "exec"):
        cluster.refuse(verb, FORBIDDEN)
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    said = error(capsys)
    assert said.count("this is forbidden") == 3
    assert "has the change" not in said


def test_a_change_that_one_direction_refuses_does_not_last(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.make("cannot", "cloud-1", "corrupt")
    assert main(["link", "set", "downlink.corrupt=0.5", "uplink.delay_ms=9", "-n", "demo"]) == 2
    assert error(capsys) == (
        "cloudrc: error: the downlink is unchanged: netem cannot do that; the uplink has the "
        "change; the ConfigMap is unchanged, and restarted pods take it"
    )
    assert not cluster.kept()


def test_a_silent_container_is_waited_for_and_named(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.make("deaf", "cloud-1")
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 4
    assert error(capsys) == (
        "cloudrc: error: the downlink did not apply the change within 5 s; see the log of the "
        f"container link of pod cloud-1{LATER}"
    )


def test_a_container_of_another_version_is_reported(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    (cluster.folder / "state-cloud-1.json").write_text("{}")
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    assert "a link container has another version: not the state of a link" in error(capsys)


def test_a_missing_release_is_reported(
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
