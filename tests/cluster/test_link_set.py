"""`cloudrc link set` in a cluster: the ConfigMap, the nudge to the kubelets, and the read-back."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from fake_api import FakeApi

from cloudrc.cli import link_set
from cloudrc.cli.link_cluster import with_files
from cloudrc.cli.main import main
from cloudrc.cluster import link as cluster_link
from cloudrc.errors import BadInputError

PROFILE = "uplink: {delay_ms: 45, jitter_ms: 25}\ndownlink: {delay_ms: 45, jitter_ms: 25}\n"
LABELS = {
    "app.kubernetes.io/name": "cloudrc",
    "app.kubernetes.io/instance": "cloudrc",
    "app.kubernetes.io/component": "link",
}
TRACE = "time_s,delay_ms\n0,40\n1,60\n"


@pytest.fixture
def linked(running: FakeApi, monkeypatch: pytest.MonkeyPatch) -> FakeApi:
    """A release whose profile can be changed, and whose commands need not wait."""
    metadata = {"name": "cloudrc-link", "labels": LABELS}
    running.put("configmaps", "demo", {"metadata": metadata, "data": {"profile.yaml": PROFILE}})
    monkeypatch.setattr(cluster_link, "NUDGE_PERIOD", 0.0)
    monkeypatch.setattr(link_set, "sleep", lambda _: None)
    return running


def files(api: FakeApi) -> dict[str, str]:
    data: dict[str, str] = api.get("configmaps", "cloudrc-link")["data"]
    return data


@pytest.fixture
def pods_follow(
    linked: FakeApi, pretend: Callable[[str, str], Path], monkeypatch: pytest.MonkeyPatch
) -> FakeApi:
    """Link containers that have taken over what is in the ConfigMap once they were nudged."""
    pretend("kubectl", "true")

    def states(pods: cluster_link.LinkPods) -> list[str]:
        pods._nudge()
        change = json.loads(files(linked)["change.json"])
        values = yaml.safe_load(files(linked)["profile.yaml"])
        nudged = linked.get("pods", "world-1")["metadata"]["annotations"][cluster_link.ANNOTATION]
        done = change["number"] if nudged.endswith(".3") else ""
        return [
            json.dumps(
                {"shaper": "netem", "reason": "", "mode": "auto", "direction": way,
                 "profile": values, "since": "", "since_ns": 1, "change": done,
                 "cause": change["cause"],
                 "asked": {"delay": values[way]["delay_ms"] * 1e-3, "jitter": 0, "loss": 0}}
            )
            for way in ("uplink", "downlink")
        ]  # fmt: skip

    monkeypatch.setattr(cluster_link.LinkPods, "states", states)
    return linked


def test_the_profile_changes_and_the_pods_are_nudged_until_they_tell_so(
    pods_follow: FakeApi, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 0
    assert yaml.safe_load(files(pods_follow)["profile.yaml"]) == {
        "uplink": {"delay_ms": 45.0, "jitter_ms": 25.0},
        "downlink": {"delay_ms": 120.0, "jitter_ms": 25.0},
    }
    change = json.loads(files(pods_follow)["change.json"])
    assert (change["cause"], change["restart"]) == ("downlink.delay_ms=120", False)
    for pod in ("world-1", "cloud-1"):
        annotations = pods_follow.get("pods", pod)["metadata"]["annotations"]
        assert annotations[cluster_link.ANNOTATION] == f"{change['number']}.3"
    shown = capsys.readouterr().out.splitlines()
    assert shown[2].split()[:4] == ["downlink", "netem", "120", "ms"]


def test_the_state_is_read_from_both_link_containers(
    linked: FakeApi, pretend: Callable[[str, str], Path], tmp_path: Path
) -> None:
    pretend("kubectl", f'echo "$@" >> {tmp_path}/asked; echo "{{}}"')
    from cloudrc.cluster.access import connect

    assert cluster_link.LinkPods(connect(), "a1").states() == ["{}\n", "{}\n"]
    asked = (tmp_path / "asked").read_text().splitlines()
    assert [line.split(" exec ")[1] for line in asked] == [
        f"{pod} --container=link -- cat /run/cloudrc/link.json" for pod in ("world-1", "cloud-1")
    ]


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


def test_what_the_api_server_refuses_is_one_sentence(
    linked: FakeApi, capsys: pytest.CaptureFixture[str]
) -> None:
    linked.refuse["PATCH", "configmaps"] = (403, "configmaps is forbidden")
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    assert "cannot patch configmaps in namespace 'demo'" in capsys.readouterr().err


def test_a_release_that_is_not_there_is_said(
    api: FakeApi, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["link", "set", "downlink.delay_ms=120", "-n", "demo"]) == 5
    assert "no release 'cloudrc'" in capsys.readouterr().err
