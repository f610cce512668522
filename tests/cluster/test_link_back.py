"""`cloudrc link set` where one direction cannot follow: the link is set whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from cloudrc.cli.link_run import loader
from cloudrc.cli.main import main
from cloudrc.link.follow import HANDED_FILE, HandedProfile, ProfileFile, Profiles
from tests.cluster.conftest import PROFILE, TRACE, Cluster


def set_link(*words: str) -> int:
    return main(["link", "set", *words, "-n", "demo"])


def error(capsys: pytest.CaptureFixture[str]) -> str:
    """What is said of an error: one line."""
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_what_one_direction_refuses_the_other_does_not_keep(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each would be judged by a profile that the other one does not have."""
    cluster.items[0]["data"]["change.json"] = '{"number": "a1", "cause": "x", "restart": true}'
    cluster.tell()
    cluster.make("cannot", "cloud-1", "corrupt")
    assert set_link("downlink.corrupt=0.5", "uplink.delay_ms=9") == 2
    assert error(capsys) == (
        "cloudrc: error: the downlink is unchanged: netem cannot do that; the uplink had taken the "
        "change, and has its old profile back"
    )
    assert not cluster.kept(), "it does not last either"
    for pod in ("world-1", "cloud-1"):  # what is refused must not be found by a restart
        asked, back = cluster.handed(pod)
        assert "corrupt" in asked["files"]["profile.yaml"]
        assert back["files"] == {"profile.yaml": PROFILE}
        assert (back["after"], asked["after"]) == ("a1", "a1")
        assert json.loads(back["change"])["restart"] is False
        assert cluster.state(pod).cause == "taken back: downlink.corrupt=0.5, uplink.delay_ms=9"


def test_a_restart_after_a_refusal_uses_the_old_profile(cluster: Cluster, tmp_path: Path) -> None:
    cluster.make("cannot", "cloud-1", "corrupt")
    assert set_link("downlink.corrupt=0.5") == 2
    (tmp_path / "profile.yaml").write_text(PROFILE)
    (tmp_path / HANDED_FILE).write_text(json.dumps(cluster.handed("cloud-1")[-1]))
    load, said = loader("downlink"), list[str]()
    file = ProfileFile(tmp_path / "profile.yaml", load, said.append)
    handed = HandedProfile(tmp_path / HANDED_FILE, load, said.append)
    assert "corrupt" not in Profiles(file, handed).first().values["downlink"]
    assert said == []


def test_a_refusal_by_both_leaves_nothing_to_say(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    for pod in ("world-1", "cloud-1"):
        cluster.make("cannot", pod, "corrupt")
    assert set_link("downlink.corrupt=0.5") == 2
    assert error(capsys).endswith("the uplink is unchanged: netem cannot do that")
    assert not cluster.kept()


def test_the_old_profile_returns_with_traces_and_starts_anew(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    old = "uplink: {trace: t.csv}\ndownlink: {corrupt: 0.1, delay_ms: 3}\n"
    cluster.items[0]["data"] |= {"profile.yaml": old, "t.csv": TRACE, "older.csv": TRACE}
    cluster.tell()
    cluster.make("cannot", "cloud-1", "reorder")
    assert set_link("--profile", "wifi", "downlink.reorder=0.1") == 2
    assert error(capsys).endswith("has its old profile back, its time line begins anew")
    back = cluster.handed("world-1")[-1]
    assert back["files"] == {"profile.yaml": old, "t.csv": TRACE}
    assert json.loads(back["change"])["restart"], "the one that was under way is over"
    assert not json.loads(cluster.handed("cloud-1")[-1]["change"])["restart"], "this one goes on"


def test_a_failed_take_back_names_the_command_that_does_it(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.make("cannot", "cloud-1", "corrupt")
    cluster.make("broken", "world-1", "1")
    assert set_link("downlink.corrupt=0.5", "uplink.delay_ms=9") == 2
    said, _, command = error(capsys).rpartition(": ")
    assert "the uplink (pod world-1) keeps the change, as it could not be taken back: " in said
    assert "the pod is gone" in said
    assert command == (
        "cloudrc link set uplink.keep_order=false --release=cloudrc --namespace=demo"
    )
    assert "corrupt" in cluster.handed("world-1")[-1]["files"]["profile.yaml"]
    (cluster.folder / "broken-world-1").unlink()
    assert main(command.split()[1:]) == 0
    for pod in ("world-1", "cloud-1"):
        given = yaml.safe_load(cluster.handed(pod)[-1]["files"]["profile.yaml"])
        assert given == yaml.safe_load(PROFILE)


@pytest.mark.parametrize("refused", [True, False])
def test_a_pod_that_is_not_reached_keeps_nobody_on_half_a_change(
    refused: bool, cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    """Either the other pod refuses, or the ConfigMap does: nothing brings it to both then."""
    cluster.make("broken", "cloud-1")
    if refused:
        cluster.make("cannot", "world-1", "delay_ms: 120")
    else:
        cluster.refuse("patch", "Error from server (Forbidden): this is forbidden")
    assert set_link("downlink.delay_ms=120") == 5
    said = error(capsys)
    assert ("has its old profile back" in said) is not refused
    assert "the downlink (pod cloud-1) may have the change" in said
    assert not cluster.kept()
    assert cluster.handed("world-1")[-1]["files"] == {"profile.yaml": PROFILE}


def test_a_container_that_does_not_take_it_over_was_waited_for(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.make("deaf", "cloud-1")
    assert set_link("downlink.delay_ms=120") == 4
    assert error(capsys) == (
        "cloudrc: error: the downlink did not apply the change within 5 s; see the logs of the "
        "link containers; the uplink had taken the change, and has its old profile back; the "
        "downlink (pod cloud-1) finds its old profile once it moves again"
    )
    assert cluster.handed("cloud-1")[-1]["files"] == {"profile.yaml": PROFILE}
    assert not cluster.kept()
