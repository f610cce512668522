"""`cloudrc link set` if one direction refuses: both directions change, or none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from cloudrc.cli.link_run import make_profile_loader
from cloudrc.cli.main import main
from cloudrc.link.follow import HANDED_FILE, HandedProfile, ProfileFile, Profiles
from tests.cluster.conftest import PROFILE, TRACE, Cluster


def set_link(*words: str) -> int:
    return main(["link", "set", *words, "-n", "demo"])


def error(capsys: pytest.CaptureFixture[str]) -> str:
    """Return the one line of an error message."""
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_a_refusal_by_one_direction_rolls_the_other_back(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both directions must have the same profile."""
    cluster.items[0]["data"]["change.json"] = '{"number": "a1", "cause": "x", "restart": true}'
    cluster.tell()
    cluster.make("cannot", "cloud-1", "corrupt")
    assert set_link("downlink.corrupt=0.5", "uplink.delay_ms=9") == 2
    assert error(capsys) == (
        "cloudrc: error: the downlink is unchanged: netem cannot do that; the uplink had the "
        "change for a moment and has its old profile again"
    )
    assert not cluster.kept(), "it does not last either"
    for pod in ("world-1", "cloud-1"):  # a restart must not read the refused files
        asked, back = cluster.handed(pod)
        assert "corrupt" in asked["files"]["profile.yaml"]
        assert back["files"] == {"profile.yaml": PROFILE}
        assert (back["after"], asked["after"]) == ("a1", "a1")
        assert json.loads(back["change"])["restart"] is False
        assert cluster.state(pod).cause == "taken back: downlink.corrupt=0.5, uplink.delay_ms=9"


def test_a_refusing_container_restarts_with_the_old_profile(
    cluster: Cluster, tmp_path: Path
) -> None:
    cluster.make("cannot", "cloud-1", "corrupt")
    assert set_link("downlink.corrupt=0.5") == 2
    (tmp_path / "profile.yaml").write_text(PROFILE)
    (tmp_path / HANDED_FILE).write_text(json.dumps(cluster.handed("cloud-1")[-1]))
    load, said = make_profile_loader("downlink"), list[str]()
    file = ProfileFile(tmp_path / "profile.yaml", load, said.append)
    handed = HandedProfile(tmp_path / HANDED_FILE, load, said.append)
    assert "corrupt" not in Profiles(file, handed).first().values["downlink"]
    assert said == []


def test_a_refusal_by_both_needs_no_further_words(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    for pod in ("world-1", "cloud-1"):
        cluster.make("cannot", pod, "corrupt")
    assert set_link("downlink.corrupt=0.5") == 2
    assert error(capsys).endswith("the uplink is unchanged: netem cannot do that")
    assert not cluster.kept()


def test_a_rollback_restores_traces_and_restarts_the_time_line(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    old = "uplink: {trace: t.csv}\ndownlink: {corrupt: 0.1, delay_ms: 3}\n"
    cluster.items[0]["data"] |= {"profile.yaml": old, "t.csv": TRACE, "older.csv": TRACE}
    cluster.tell()
    cluster.make("cannot", "cloud-1", "reorder")
    assert set_link("--profile", "wifi", "downlink.reorder=0.1") == 2
    assert error(capsys).endswith("has its old profile again; its time line starts again")
    back = cluster.handed("world-1")[-1]
    assert back["files"] == {"profile.yaml": old, "t.csv": TRACE}
    assert json.loads(back["change"])["restart"], "the one that was under way is over"
    assert not json.loads(cluster.handed("cloud-1")[-1]["change"])["restart"], "this one goes on"


def test_a_failed_rollback_is_reported_with_a_command(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.make("cannot", "cloud-1", "corrupt")
    cluster.make("broken", "world-1", "1")
    assert set_link("downlink.corrupt=0.5", "uplink.delay_ms=9") == 2
    said, _, command = error(capsys).rpartition(": ")
    assert (
        "the uplink (pod world-1) keeps the change, because the old profile could not be restored: "
        in said
    )
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
def test_an_unreachable_pod_rolls_the_other_back(
    refused: bool, cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    """The other pod or the ConfigMap refuses, so the change cannot reach both pods."""
    cluster.make("broken", "cloud-1")
    if refused:
        cluster.make("cannot", "world-1", "delay_ms: 120")
    else:
        cluster.refuse("patch", "Error from server (Forbidden): this is forbidden")
    assert set_link("downlink.delay_ms=120") == 5
    said = error(capsys)
    assert ("has its old profile again" in said) is not refused
    assert "the downlink (pod cloud-1) may have the change" in said
    assert not cluster.kept()
    assert cluster.handed("world-1")[-1]["files"] == {"profile.yaml": PROFILE}


def test_a_silent_container_is_waited_for_and_rolled_back(
    cluster: Cluster, capsys: pytest.CaptureFixture[str]
) -> None:
    cluster.make("deaf", "cloud-1")
    assert set_link("downlink.delay_ms=120") == 4
    assert error(capsys) == (
        "cloudrc: error: the downlink did not apply the change within 5 s; see the logs of the "
        "link containers; the uplink had the change for a moment and has its old profile again; "
        "the downlink (pod cloud-1) gets its old profile when it responds"
    )
    assert cluster.handed("cloud-1")[-1]["files"] == {"profile.yaml": PROFILE}
    assert not cluster.kept()
